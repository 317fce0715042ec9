"""The lines that scans show, as certain as stated."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import box, scan_at, scan_in

from benchmark import lines as measured
from benchmark.lines import line_difference, lines_of, true_scan
from benchmark.simulated.worlds import World
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.landmarks.line_extraction import extract_for_map, extract_lines
from hmt_slam_ros.landmarks.line_fit import Beams, fit_line, line_distance2
from hmt_slam_ros.simulation import open_simulated

NOISE = 0.015
FEATURES = FeatureParameters(range_deviation=NOISE)
ROOM = box(-3, -2, 5, 4)


def in_room(lines, pose):
    """Lines in the world, [nx, ny, distance along n]."""
    headings = lines.parameters[:, 0] + pose[2]
    normals = np.stack((np.cos(headings), np.sin(headings)), axis=1)
    return np.column_stack((normals, lines.parameters[:, 1] + normals @ np.asarray(pose[:2])))


@pytest.mark.parametrize(("beams", "field_of_view"), [(91, np.pi), (361, np.pi), (1081, 1.5 * np.pi), (100, 1.0)])
def test_lines_are_as_far_off_as_stated(beams, field_of_view):
    nees = []
    for seed in range(100):
        pose = np.array([np.sin(seed), 0.5 * np.cos(seed), 0.7 * seed])
        scan = scan_in(ROOM, pose, beams=beams, field_of_view=field_of_view, noise=NOISE, seed=seed)
        lines = extract_lines(scan, FEATURES)
        walls = lines_of(se2.transform(se2.inverse(pose), ROOM.reshape(-1, 2)).reshape(-1, 4))
        for line, covariance in zip(lines.parameters, lines.covariances, strict=True):
            errors = line_difference(line, walls)
            nees.append(np.einsum("ni,ij,nj->n", errors, np.linalg.inv(covariance), errors).min())
    assert len(nees) >= 100
    # The mean of so many is within three deviations of its own, and a few percent for beams that were left out.
    assert abs(np.mean(nees) - 2.0) < 3.0 * 2.0 / np.sqrt(len(nees)) + 0.15


def test_all_walls_of_a_room_are_found_with_what_was_seen_of_them():
    pose = (0.5, 0.3, 0.4)
    lines = extract_lines(scan_at(ROOM, pose, beams=720), FEATURES)
    found = in_room(lines, pose)
    np.testing.assert_allclose(sorted(np.abs(found[:, 2])), [2.0, 3.0, 4.0, 5.0], atol=1e-4)
    lengths = (lines.segments[:, 1] - lines.segments[:, 0])[np.argsort(np.abs(found[lines.owners, 2]))]
    seen = np.bincount(lines.owners, lines.segments[:, 1] - lines.segments[:, 0])
    np.testing.assert_allclose(np.sort(seen), [6.0, 6.0, 8.0, 8.0], atol=0.15)
    assert lengths.min() > 0.0
    assert (np.abs(np.bincount(lines.labels[lines.labels >= 0]) - 180) < 60).all()


def test_beams_without_a_return_are_no_gap_and_no_line():
    scan = scan_at(ROOM, (0.5, 0.3, 0.4), beams=720)
    whole = extract_lines(scan, FEATURES)
    ranges = scan.ranges.copy()
    ranges[::3], ranges[1::9] = np.nan, np.inf
    holed = extract_lines(replace(scan, ranges=ranges), FEATURES)
    assert len(holed) == len(whole) == 4
    np.testing.assert_allclose(np.sort(holed.parameters[:, 1]), np.sort(whole.parameters[:, 1]), atol=1e-4)
    nothing = extract_lines(replace(scan, ranges=np.full_like(ranges, np.nan)), FEATURES)
    assert len(nothing) == len(nothing.segments) == len(nothing.labels) == 0


def test_a_wall_behind_a_pillar_is_one_line_in_two_pieces_and_a_niche_another():
    pillar, deep = box(1.9, 0.8, 2.1, 1.0), 3.1
    wall = np.array([[-4, 3, 1, 3], [1, 3, 1, deep], [1, deep, 3, deep], [3, deep, 3, 3], [3, 3, 6, 3]], dtype=float)
    scan = scan_in(np.concatenate((wall, pillar)), (0.0, 0.0, 0.5 * np.pi), beams=541, noise=0.005, seed=2)
    lines = extract_lines(scan, replace(FEATURES, range_deviation=0.005))
    straight = np.argsort(lines.parameters[:, 1])
    np.testing.assert_allclose(lines.parameters[straight, 1], [3.0, deep], atol=0.01)
    assert np.count_nonzero(lines.owners == straight[0]) == 2


def test_two_short_pieces_with_nothing_in_between_are_no_line():
    """One wall is 0.2 m behind the other, and either could be where the other one's line is."""
    walls = np.array([[-4.0, 3.0, -3.4, 3.0], [3.4, 3.2, 4.0, 3.2]])
    scan = scan_in(walls, (0.0, 0.0, 0.5 * np.pi), beams=361, noise=NOISE, seed=4)
    scan = replace(scan, ranges=np.where(scan.ranges < 10.0, scan.ranges, np.float32(np.inf)))
    lines = extract_lines(scan, replace(FEATURES, min_length=0.2))
    assert sorted(np.bincount(lines.owners)) == [1] * len(lines)


def test_whoever_stands_in_the_way_is_no_line():
    scan = scan_at(ROOM, (0.0, 0.0, 0.0), NOISE, np.random.default_rng(1), beams=720)
    angles = scan.angle_min + scan.angle_increment * np.arange(720)
    away = 1.2 * np.cos(angles - 0.3)
    inside = 0.2**2 - (1.2 * np.sin(angles - 0.3)) ** 2
    person = np.where((inside > 0.0) & (away > 0.0), away - np.sqrt(np.maximum(inside, 0.0)), np.inf)
    lines = extract_lines(replace(scan, ranges=np.minimum(scan.ranges, person.astype(np.float32))), FEATURES)
    # What is left of the wall behind may be two lines, where the one cannot tell that the other is its own.
    assert set(np.round(lines.parameters[:, 1])) == {2.0, 3.0, 4.0, 5.0}
    np.testing.assert_allclose(lines.parameters[:, 1], np.round(lines.parameters[:, 1]), atol=0.03)


def test_the_covariance_is_what_the_ranges_propagate():
    """Arras: C = sum of var(range) times the outer product of the derivatives by that range, here by differences."""
    scan = scan_in(ROOM, (0.0, 0.0, 0.3), beams=61, field_of_view=0.6, noise=0.01, laser_pose=(0.2, 0.1, 0.05))
    labels, line = np.zeros(61, np.int32), np.empty(5)
    directions = scan.beams / np.hypot(*scan.beams.T)[:, None]
    deviations = 0.01 * (1.0 + np.arange(61) / 30.0)
    assert fit_line(Beams(scan.points, directions, deviations), labels, 0, line) == 61
    covariance = np.zeros((2, 2))
    for k in range(61):
        sides = []
        for step in (1e-5, -1e-5):
            points, moved = scan.points.copy(), np.empty(5)
            points[k] += step * directions[k]
            fit_line(Beams(points, directions, deviations), labels, 0, moved)
            sides.append(moved[:2])
        slope = deviations[k] * (sides[0] - sides[1]) / 2e-5
        covariance += np.outer(slope, slope)
    np.testing.assert_allclose(line[[2, 3, 3, 4]].reshape(2, 2), covariance, rtol=0.05)


def test_a_line_near_the_origin_is_itself_on_its_other_side():
    a = np.array([0.1, 0.002, 1e-4, 1e-5, 1e-4])
    b = np.array([0.1 - np.pi, 0.003, 1e-4, -1e-5, 1e-4])
    same = np.array([0.1, -0.003, 1e-4, 1e-5, 1e-4])
    assert line_distance2(a, b) == pytest.approx(line_distance2(a, same))
    assert line_distance2(a, b) < 1.0


def test_lines_of_a_simulated_drive_are_measured_against_its_walls(monkeypatch):
    monkeypatch.setattr(measured, "_SCANS", 12)
    scans = list(measured.extract_scans(World("twins", 3), "field_of_view=360,beams=720,people=2", FEATURES))
    assert len(scans) == 12
    assert 0.8 < sum(scan.found_length for scan in scans) / sum(scan.visible_length for scan in scans) <= 1.0
    assert measured.stray_share([scans]) < 0.05
    assert 1.0 < measured.mean_nees([scans]) < 4.0
    assert 0.0 < measured.mean_milliseconds([scans]) < 1000.0
    scenario = open_simulated("sim:twins,seed=3,people=2,sweep=0.1").scenario
    seen = true_scan(scenario, 40)
    assert np.hypot(*(seen.scan.points - seen.ends).T).max() < 0.1
    assert set(np.unique(seen.hit_lines)) <= set(range(-1, len(seen.lines)))


def test_a_map_is_given_apart_what_a_scan_joins_on_little_evidence():
    # The first and the last beams of the circle are on one wall; those of the shorter piece are few.
    scan = scan_at(ROOM, (0.5, 0.3, 0.4), beams=720)
    ranges = scan.ranges.copy()
    ranges[::3], ranges[1::9] = np.nan, np.inf
    holed = replace(scan, ranges=ranges)
    assert len(extract_lines(holed, FEATURES)) == 4
    lines = extract_for_map(holed, FEATURES)
    assert sorted(np.round(lines.parameters[:, 1], 1)) == [2.3, 3.5, 3.5, 3.7, 4.5]
