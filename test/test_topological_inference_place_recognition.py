"""The appearance of places at any heading, and the most similar areas of a building."""

import numpy as np
import pytest
from worlds import box, scan_in, two_rooms

from hmt_slam_ros.topological_inference.place_recognition import (
    DESCRIPTOR_SIZE,
    RATIO_AT_MEDIAN,
    ScanDescriptors,
    describe_scan,
    descriptor_log_ratio,
)

SMALL, LARGE = box(-1.0, -1.0, 1.0, 1.0), box(-8.0, -8.0, 8.0, 8.0)


def make_scan(walls, x, y, heading, beams=720):
    return scan_in(walls, np.array([x, y, heading]), beams=beams, field_of_view=2 * np.pi)


def test_a_look_does_not_depend_on_heading_nor_on_the_number_of_beams():
    one = describe_scan(make_scan(two_rooms(), 2.0, 2.0, 0.0))
    assert one.shape == (DESCRIPTOR_SIZE,)
    np.testing.assert_allclose(describe_scan(make_scan(two_rooms(), 2.0, 2.0, 2.3)), one, atol=0.02)
    np.testing.assert_allclose(describe_scan(make_scan(two_rooms(), 2.0, 2.0, 0.0, beams=181)), one, atol=0.05)


def test_a_scan_without_a_return_has_a_look():
    walls = box(-200.0, -200.0, 200.0, 200.0)
    np.testing.assert_allclose(describe_scan(make_scan(walls, 0.0, 0.0, 0.0)), np.log(20.0))


@pytest.fixture
def descriptors():
    scans = {k: make_scan(SMALL, 0.1 * k, 0.0, 0.0) for k in range(3)}
    scans |= {k: make_scan(LARGE, 0.1 * k, 0.0, 0.0) for k in range(3, 9)}
    scans[9] = make_scan(SMALL, 0.25, 0.05, 2.0)
    return ScanDescriptors(scans)


def test_the_place_itself_is_the_most_similar(descriptors):
    similarity = descriptors.similarity([9], [(3, 4, 5), (0, 1, 2), (6, 7, 8)])
    assert similarity.argmax() == 1
    assert similarity[1] > 1.0
    assert np.median(similarity) == 0.0


def test_descriptors_are_the_same_however_many_there_are_and_after_scans_changed():
    scans = {k: make_scan(box(-1.0 - 0.02 * k, -1.0, 1.0, 1.0), 0.0, 0.0, 0.0, beams=45) for k in range(600)}
    many, few = ScanDescriptors(scans), ScanDescriptors(scans)
    areas = [tuple(range(k, k + 10)) for k in range(0, 600, 10)]
    all_at_once = many.similarity([311], areas)
    for area in areas:
        few.similarity(area, areas[:1])
    np.testing.assert_array_equal(few.similarity([311], areas), all_at_once)
    scans[311] = scans[0]
    many.clear()
    assert many.similarity([311], areas).argmax() == 0


def test_without_areas_there_is_no_similarity(descriptors):
    assert descriptors.similarity([9], []).shape == (0,)
    assert descriptors.area_probabilities([9], {}) == {}


def test_descriptors_share_the_probability_among_areas(descriptors):
    probabilities = descriptors.area_probabilities([9], {4: (3, 4, 5), 7: (0, 1, 2)})
    assert sum(probabilities.values()) == pytest.approx(1.0)
    assert probabilities[7] > 0.6


def test_more_similarity_than_the_median_is_evidence_for_an_area():
    ratios = descriptor_log_ratio(np.array([-1.0, 0.0, 1.0]))
    assert ratios[0] < ratios[1] == RATIO_AT_MEDIAN < 0.0 < ratios[2]


def test_the_similarity_is_that_of_the_mean_distance_to_the_nearest_descriptor(descriptors):
    query, areas = [2, 9, 4], [(3, 5), (0, 1), (6, 7, 8), (1, 8)]
    known = {k: describe_scan(descriptors._scans[k]) for k in range(10)}
    distances = [np.mean([min(np.abs(known[q] - known[k]).mean() for k in area) for q in query]) for area in areas]
    np.testing.assert_allclose(
        descriptors.similarity(query, areas), np.median(np.log(distances)) - np.log(distances), rtol=1e-9
    )
