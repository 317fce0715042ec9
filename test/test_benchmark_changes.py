"""A world that changes: the requirements, and a measurement of two visits."""

import numpy as np
import pytest

from benchmark.changes import (
    LocalizationVisit,
    Surfaces,
    Visit,
    localize_again,
    requirements,
    score_changes,
    unexplained_share,
    visit_twice,
)
from benchmark.report import VALIDATION, document_marks
from hmt_slam_ros.grids.occupancy_map import FREE, OCCUPIED, OccupancyImage

FRAME = np.zeros(3)
BEFORE = np.array([[0.0, 0.0, 4.0, 0.0], [1.0, 2.0, 2.0, 2.0]])
AFTER = np.array([[0.0, 0.0, 4.0, 0.0], [3.0, 2.0, 4.0, 2.0]])
LASERS = np.array([[2.0, 1.0, np.pi / 2]] * 3)


def image_of(*walls):
    """Walls along x as cells of 0.1 m."""
    pixels = np.full((40, 60), FREE)
    for x0, y0, x1, _ in walls:
        pixels[39 - round((y0 + 1.0) / 0.1), round((x0 + 1.0) / 0.1) : round((x1 + 1.0) / 0.1)] = OCCUPIED
    return OccupancyImage(pixels, 0.1, np.array([-1.0, -1.0]))


def visits(lasers=LASERS):
    return [Surfaces(walls, lasers, np.pi / 2) for walls in (BEFORE, AFTER)]


@pytest.mark.parametrize(
    ("after", "new", "gone"), [(AFTER, 1.0, 0.0), (BEFORE, 0.0, 1.0), ([*BEFORE, AFTER[1]], 1.0, 1.0)]
)
def test_a_map_is_scored_by_what_is_new_and_what_is_gone(after, new, gone):
    found = score_changes([image_of(*BEFORE), image_of(*after)], [FRAME, FRAME], visits())
    assert (found.new, found.gone, found.kept) == (new, gone, 1.0)
    assert found.lengths == pytest.approx((1.05, 1.05), abs=0.11)


def test_hidden_surfaces_do_not_count():
    lasers_turned = LASERS + np.array([0.0, 0.0, np.pi])
    found = score_changes([image_of(*BEFORE), image_of(*BEFORE)], [FRAME, FRAME], visits(lasers_turned))
    assert np.isnan(found.gone)
    assert unexplained_share(image_of(*BEFORE), FRAME, np.concatenate((AFTER, found.hidden))) == 0.0


def test_cells_far_from_all_walls_are_unexplained():
    person = [2.0, 1.0, 2.5, 1.0]
    assert unexplained_share(image_of(*BEFORE, person), FRAME, BEFORE) == pytest.approx(5 / 55)


def test_what_falls_short_is_reported():
    good = Visit(0.9, 0.05, 0.99, 0.0, 0.001, 0.02, 0.08, (100, 120), (5.0, 5.0))
    assert all(
        requirement.is_met
        for requirement in requirements("quiet", [good], [100, 110, 112], [LocalizationVisit(True, 0.03, 0.09)])
    )
    bad = Visit(0.7, 0.2, 0.9, 0.003, 0.01, 0.05, 0.2, (100, 120), (5.0, 5.0))
    assert not any(
        requirement.is_met
        for requirement in requirements("quiet", [bad], [100, 110, 120], [LocalizationVisit(False, 0.2, 0.3)])
    )


@pytest.mark.long
def test_two_visits_are_measured():
    found = visit_twice("office", 1000, size=0.7, rate=1.5)
    assert found.new > 0.5
    assert found.gone < 0.4
    assert found.kept > 0.98
    assert found.keyframes[1] < 1.3 * found.keyframes[0]
    assert found.error < 0.1


@pytest.mark.long
def test_localization_leaves_the_map_as_it_was_and_follows_the_robot_through_all_of_it():
    found = localize_again("busy", 0, size=0.7, rate=3.0)
    assert found.same
    assert found.error < 0.1
    assert found.worst < 0.5


def test_a_robot_does_not_take_moved_furniture_for_another_place():
    found = localize_again("office", 3, size=0.7, rate=1.5)
    assert found.same
    assert found.error < 0.08
    assert found.worst < 0.3


def test_the_document_has_a_place_for_the_tables():
    text = VALIDATION.read_text()
    assert all(text.count(mark) == 1 for mark in document_marks("changes"))
