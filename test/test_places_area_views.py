"""What areas show, kept while their keyframes are where they were."""

import math
from dataclasses import replace

import numpy as np
import pytest
from small_floor import CONFIGURATION, make_map

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.landmarks.area_landmarks import GrowingArea
from hmt_slam_ros.places.area_views import AreaViewCache
from hmt_slam_ros.submap.local_mapping import LocalMapping


def front_scan(scan):
    first = scan.angle_min + 180 * scan.angle_increment
    return replace(scan, ranges=scan.ranges[180:540], angle_min=first)


@pytest.fixture(scope="module")
def area():
    """An area's keyframes, and their scans, every other one of which sees only what is ahead."""
    hybrid_map, scans = make_map(crossing_driven=False)
    keyframes = dict(list(hybrid_map.keyframes(0).items())[:8])
    return keyframes, {k: front_scan(scans[k]) if k % 2 else scans[k] for k in keyframes}


@pytest.fixture
def looked_up(monkeypatch):
    """The scans that were looked up."""
    scans, sighting = [], GrowingArea.observe_keyframe

    def make_sighting(own, scan, pose):
        scans.append(scan)
        return sighting(own, scan, pose)

    monkeypatch.setattr(GrowingArea, "observe_keyframe", make_sighting)
    return scans


def views(scans):
    return AreaViewCache(LocalMapping(CONFIGURATION), scans)


def assert_same(one, other):
    for name in ("keyframes", "poses", "sector_distances", "hallway_lengths"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert [landmark.kind for landmark in one.landmarks] == [landmark.kind for landmark in other.landmarks]
    for mine, its in zip(one.landmarks, other.landmarks, strict=True):
        np.testing.assert_array_equal(mine.pose.mean, its.pose.mean)
        np.testing.assert_array_equal(mine.pose.covariance, its.pose.covariance)
        assert mine.existence == its.existence


def test_an_area_that_grew_shows_what_it_would_if_it_were_looked_up_at_once(area, looked_up):
    keyframes, scans = area
    grown = views(scans)
    grown.area_view(0, dict(list(keyframes.items())[:5]))
    before = len(looked_up)
    found = grown.area_view(0, keyframes)
    assert (before, len(looked_up)) == (5, 8)
    assert grown.area_view(0, keyframes) is found
    assert_same(found, views(scans).area_view(0, keyframes))


def test_areas_are_looked_at_ahead_so_many_keyframes_at_a_time(looked_up):
    hybrid_map, scans = make_map(crossing_driven=False)
    areas = [(area, hybrid_map.keyframes(area)) for area in hybrid_map.area_ids()]
    own, counts, every = views(scans), [], sum(len(keyframes) for _, keyframes in areas)
    while len(counts) < 2 or counts[-1] > counts[-2]:
        own.prefetch(areas, 7)
        counts.append(len(looked_up))
    assert counts == [*range(7, every, 7), every, every]
    found = own.views_of_map(hybrid_map)
    assert len(looked_up) == every
    for area, keyframes in areas:
        assert_same(found[area], views(scans).area_view(area, keyframes))


def test_what_an_area_shows_in_two_maps_is_kept_for_both(area, looked_up):
    keyframes, scans = area
    own, other = views(scans), {k: se2.compose(np.array([0.5, 0.0, 0.0]), pose) for k, pose in keyframes.items()}
    first = [own.area_view(0, each) for each in (keyframes, other)]
    assert [own.area_view(0, each) for each in (keyframes, other)] == first
    assert len(looked_up) == 2 * len(keyframes)


def test_where_keyframes_moved_or_were_taken_out_it_is_looked_up_again(area, looked_up):
    keyframes, scans = area
    own = views(scans)
    own.area_view(0, keyframes)
    moved = {k: se2.compose(np.array([1.0, 2.0, math.pi]), pose) for k, pose in keyframes.items()}
    assert_same(own.area_view(0, moved), views(scans).area_view(0, moved))
    without = dict(list(moved.items())[2:])
    assert_same(own.area_view(0, without), views(scans).area_view(0, without))
    own.clear()
    before = len(looked_up)
    own.area_view(0, without)
    assert len(looked_up) - before == len(without)
