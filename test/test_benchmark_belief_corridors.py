"""Random corridors, and the buildings that they are maps of."""

import numpy as np

from benchmark.belief_world import draw_building, random_corridors


def test_a_building_has_what_its_map_has_where_that_is_certain_and_less_where_it_is_not():
    random = np.random.default_rng(0)
    known = random_corridors(random, 2, 2, 0.2)
    there = draw_building(random, known)
    listed = sum(len(way.landmarks.tracks) for way in known.edges_one_way)
    standing = sum(len(way.landmarks.tracks) for way in there.edges_one_way)
    expected = sum(float(way.landmarks.probabilities.sum()) for way in known.edges_one_way)
    assert standing < listed
    assert abs(standing - expected) < 4.0 * np.sqrt(0.2 * listed)
    ratios = [
        one.distance[0] / other.distance[0] for one, other in zip(there.edges_one_way, known.edges_one_way, strict=True)
    ]
    assert 0.01 < np.std(ratios) < 0.06
