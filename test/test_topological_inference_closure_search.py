"""Areas in which keyframes surely do not lie: which are tried, and when their maps are made."""

import numpy as np
import pytest

from benchmark.lattice import Lattice, LatticeScans
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map import surroundings
from hmt_slam_ros.topological_inference.admission import Query
from hmt_slam_ros.topological_inference.closure_search import ClosureSearch

HERE = 210  # in the middle of the lattice
SPREAD = np.diag([3.0, 3.0, 0.05]) ** 2


@pytest.fixture
def lattice():
    return Lattice(20, 20).hybrid_map()


def query(hybrid_map):
    keyframes = list(hybrid_map.keyframes(HERE).items())[:5]
    return Query(PoseGaussian(keyframes[0][1], SPREAD), dict(keyframes))


def places_tried(search, hybrid_map, excluded):
    return search.gating.classify_areas(hybrid_map, HERE, query(hybrid_map), excluded)[2]


def test_the_places_tried_are_spread_over_the_map_and_most_stay_the_same(lattice):
    search = ClosureSearch(Configuration(), LatticeScans())
    places = places_tried(search, lattice, {HERE})
    assert np.diff(sorted([0, *places, 400])).max() < 150
    for excluded in ({HERE, places[0]}, {HERE, places[3], places[4]}):
        others = places_tried(search, lattice, excluded)
        assert len(others) == len(places)
        assert set(places) - set(others) == excluded - {HERE}


def test_their_maps_are_made_ahead_one_at_a_time(lattice, monkeypatch):
    built = []
    build = surroundings.build_area_grid
    monkeypatch.setattr(surroundings, "build_area_grid", lambda *args: built.append(len(args[0])) or build(*args))

    def maps_of(looks):
        """How many maps a comparison needs after some looks ahead from one before it, and what it finds."""
        search = ClosureSearch(Configuration(), LatticeScans())
        excluded = {HERE}
        requested = query(lattice)
        search.compare(lattice, HERE, requested, dict.fromkeys(range(400), requested.poses), excluded, 8)
        for _ in range(looks):
            before = len(built)
            search.look_ahead(lattice)
            assert len(built) - before <= 1
        before = len(built)
        found = search.compare(lattice, HERE, requested, {}, excluded, 8)
        return len(built) - before, [fit.log_weight for fit in found.fits]

    without, plain = maps_of(0)
    halfway, _ = maps_of(3)
    ahead, same = maps_of(9)
    assert (without - halfway, without - ahead) == (3, 6)
    assert same == plain
    assert plain
