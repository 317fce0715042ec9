"""What places look like, whatever the robot's heading there, and which of a building's areas look most like it."""

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
def looks():
    scans = {k: make_scan(SMALL, 0.1 * k, 0.0, 0.0) for k in range(3)}
    scans |= {k: make_scan(LARGE, 0.1 * k, 0.0, 0.0) for k in range(3, 9)}
    scans[9] = make_scan(SMALL, 0.25, 0.05, 2.0)
    return ScanDescriptors(scans)


def test_the_place_itself_looks_most_alike(looks):
    likeness = looks.similarity([9], [(3, 4, 5), (0, 1, 2), (6, 7, 8)])
    assert likeness.argmax() == 1
    assert likeness[1] > 1.0
    assert np.median(likeness) == 0.0


def test_no_area_has_no_likeness(looks):
    assert looks.similarity([9], []).shape == (0,)
    assert looks.area_probabilities([9], {}) == {}


def test_the_looks_share_the_probability_among_areas(looks):
    shares = looks.area_probabilities([9], {4: (3, 4, 5), 7: (0, 1, 2)})
    assert sum(shares.values()) == pytest.approx(1.0)
    assert shares[7] > 0.6


def test_what_looks_more_alike_than_the_median_speaks_for_the_place():
    ratios = descriptor_log_ratio(np.array([-1.0, 0.0, 1.0]))
    assert ratios[0] < ratios[1] == RATIO_AT_MEDIAN < 0.0 < ratios[2]
