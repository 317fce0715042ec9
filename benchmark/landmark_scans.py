"""What is found of landmarks in single scans of simulated drives, real and virtual ones, and how far off it is."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmark.landmark_truth import Truth, World, alike
from benchmark.simulated.worlds import World as Drive
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.grids.virtual_scan import VirtualScan, virtual_scan
from hmt_slam_ros.landmarks.beam_labels import rays_of
from hmt_slam_ros.landmarks.corners import Corners, corners_of
from hmt_slam_ros.landmarks.line_extraction import extract_lines
from hmt_slam_ros.landmarks.openings import Openings, openings_and_evidence
from hmt_slam_ros.landmarks.virtual_lines import lines_of_map, rays_of_map
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.simulation.scenario import Scenario
from hmt_slam_ros.submap.local_mapping import LocalMapping

Array = NDArray[np.float64]

CORNERS, OPENINGS = "corners", "openings"

REAL, VIRTUAL = "360°, 720 beams, 10 mm", "virtual, from 180°, 361 beams, 15 mm"
LASERS = {REAL: "field_of_view=360,beams=720,range_noise=0.01", VIRTUAL: ""}
"""{name: settings of the simulated robot}."""

SCANS = 30
"""Of every drive."""

BEAMS, FAR, AROUND = 720, 10.0, 12.0
"""Beams of a virtual scan; how far they go, m; within which distance keyframes are in the map that it is cast in, m."""

UNKNOWN = 0.25
"""Share of the beams to a landmark that may come into unknown ground before it."""

POSES = np.array([0.01, 0.01, math.radians(0.2)])  # deviations of the keyframes' poses, m, m, rad
_TURN = 0.5  # rad, of a landmark that is a true one, at most
_WITHIN = {CORNERS: 0.3, OPENINGS: 0.5}  # m, likewise


class Landmark(NamedTuple):
    """A landmark that was found.

    :ivar confidence: as said.
    :ivar is_true: whether there is one.
    :ivar nees: of its pose, NaN where there is none.
    :ivar error: of its position, m, likewise.
    :ivar turn: of its heading, rad, likewise.
    :ivar evidence: what the confidence in an opening follows from; nothing for a corner.
    """

    confidence: float
    is_true: bool
    nees: float
    error: float
    turn: float
    evidence: tuple[float, ...]


class Found(NamedTuple):
    """What was found of one kind in one scan.

    :ivar landmarks: all.
    :ivar due: number of those that had to be found.
    :ivar met: how many of these were.
    :ivar cast: CPU time of the virtual scan, s.
    :ivar seconds: CPU time of lines and landmarks, s.
    """

    landmarks: tuple[Landmark, ...]
    due: int
    met: int
    cast: float
    seconds: float


Scanned = dict[str, Found]
"""{kind: what was found of it}."""


def scans_of(drive: Drive, laser: str, configuration: Configuration) -> Iterator[Scanned]:
    """What is found in scans of a drive."""
    scenario = open_simulated(",".join(filter(None, (drive.log, LASERS[laser])))).scenario
    noise = scenario.settings.range_noise
    configuration = replace(configuration, features=replace(configuration.features, range_deviation=noise))
    _warm_up(scenario, configuration)
    numbers = np.unique(np.linspace(0, len(scenario.scan_stamps) - 1, SCANS).astype(np.int64)).tolist()
    for number in numbers:
        stamp = int(scenario.scan_stamps[number])
        world = World(scenario, stamp, scenario.true_poses(np.array([stamp]))[0])
        look = _in_map if laser == VIRTUAL else _in_scan
        yield look(scenario, number, world, configuration)


def _warm_up(scenario: Scenario, configuration: Configuration) -> None:
    """Have the kernels compiled."""
    _extracted(scenario, 0, configuration)
    _extracted_from_map(cast_in_map(scenario, 0, configuration)[0], configuration)


class Extracted(NamedTuple):
    """The landmarks of a scan, and what the confidences of its openings follow from."""

    corners: Corners
    openings: Openings
    evidence: Array


def _extracted(scenario: Scenario, number: int, configuration: Configuration) -> Extracted:
    features, scan = configuration.features, scenario.scan(number)
    lines = extract_lines(scan, features)
    return Extracted(corners_of(lines, features), *openings_and_evidence(lines, rays_of(scan, features), features))


def _extracted_from_map(virtual: VirtualScan, configuration: Configuration) -> Extracted:
    features = configuration.features
    lines = lines_of_map(virtual, features)
    openings = openings_and_evidence(lines, rays_of_map(virtual, features), features)
    return Extracted(corners_of(lines, features), *openings)


def _in_scan(scenario: Scenario, number: int, world: World, configuration: Configuration) -> Scanned:
    begin = time.process_time()
    found = _extracted(scenario, number, configuration)
    return _judged(found, world, configuration, None, 0.0, time.process_time() - begin)


def _in_map(scenario: Scenario, number: int, world: World, configuration: Configuration) -> Scanned:
    virtual, seconds = cast_in_map(scenario, number, configuration)
    begin = time.process_time()
    found = _extracted_from_map(virtual, configuration)
    return _judged(found, world, configuration, virtual, seconds, time.process_time() - begin)


def cast_in_map(scenario: Scenario, number: int, configuration: Configuration) -> tuple[VirtualScan, float]:
    """The virtual scan where the robot is at a scan, and the time that it took."""
    poses = scenario.true_poses(scenario.scan_stamps[: number + 1])
    placed = se2.between(poses[-1], poses)
    keyframes = [k for k in keyframes_of(poses, configuration) if math.hypot(*placed[k, :2]) <= AROUND]
    draw = np.random.default_rng([scenario.settings.seed, number])
    mapping = LocalMapping(configuration)
    table_of_patches = mapping.pool.empty_table()
    for k in keyframes:
        pose = placed[k] + POSES * draw.standard_normal(3)
        mapping.insert(table_of_patches[None], pose[None], scenario.scan(k))
    begin = time.process_time()
    virtual = virtual_scan(mapping.pool.view(table_of_patches), np.zeros(3), BEAMS, FAR)
    return virtual, time.process_time() - begin


def keyframes_of(poses: Array, configuration: Configuration) -> list[int]:
    """Numbers of the scans of a drive that are keyframes, by the distances of metric SLAM."""
    options, found = configuration.filter, [0]
    for k in range(1, len(poses)):
        away = se2.between(poses[found[-1]], poses[k])
        turned = abs(away[2]) > math.radians(options.keyframe_angle)
        if turned or math.hypot(away[0], away[1]) > options.keyframe_distance:
            found.append(k)
    return found


def _judged(
    found: Extracted,
    world: World,
    configuration: Configuration,
    virtual: VirtualScan | None,
    cast: float,
    seconds: float,
) -> Scanned:
    corners, openings, evidence = found
    features = configuration.features
    true_corners, true_openings = world.corners(features), world.openings(features)
    parts: Scanned = {}
    any_width = true_openings._replace(kinds=0.0 * true_openings.kinds)
    for kind, own, kinds, said, truth in (
        (CORNERS, corners, corners.convex.astype(np.float64), np.empty((len(corners.poses), 0)), true_corners),
        (OPENINGS, openings, np.zeros(len(openings.poses)), evidence, any_width),
    ):
        within = _WITHIN[kind]
        landmarks = tuple(
            _compared(own, k, kinds[k], truth, within)._replace(evidence=tuple(said[k].tolist()))
            for k in range(len(own.poses))
        )
        halves = np.full(len(truth.due), 0.5) if kind == CORNERS else 0.5 * true_openings.kinds
        due = [k for k in np.flatnonzero(truth.due) if virtual is None or _known(virtual, truth.poses[k], halves[k])]
        met = sum(bool(np.any(_same(own.poses, kinds, truth.poses[k], truth.kinds[k], within))) for k in due)
        parts[kind] = Found(landmarks, len(due), met, cast, seconds)
    return parts


def _same(poses: Array, kinds: Array, pose: Array, kind: float, within: float) -> NDArray[np.bool_]:
    """Which landmarks (n,) may be another one."""
    return np.asarray(alike(poses, pose, within, _TURN) & (kinds == kind))


def _compared(own: Corners | Openings, k: int, kind: float, truth: Truth, within: float) -> Landmark:
    pose, confidence = own.poses[k], float(own.confidences[k])
    there = _same(truth.poses, truth.kinds, pose, kind, within)
    if not there.any():
        return Landmark(confidence, False, math.nan, math.nan, math.nan, ())
    away = np.where(there, np.hypot(*(truth.poses[:, :2] - pose[:2]).T), np.inf)
    error = se2.log(se2.between(pose, truth.poses[int(np.argmin(away))]))
    nees = float(error @ np.linalg.solve(own.covariances[k], error))
    return Landmark(confidence, True, nees, math.hypot(error[0], error[1]), abs(float(error[2])), ())


def _known(virtual: VirtualScan, pose: Array, half: float) -> bool:
    """Whether the map knows what is between the robot and a landmark that reaches so far, m, to both sides."""
    beside = half * np.array([-math.sin(pose[2]), math.cos(pose[2])])
    first, last = (math.atan2(y, x) for x, y in (pose[:2] - beside, pose[:2] + beside))
    beams = virtual.free.size
    turn = float(se2.wrap(last - first))
    count = 1 + int(abs(turn) / (2.0 * math.pi) * beams)
    numbers = ((first + math.pi) / (2.0 * math.pi) * beams + math.copysign(1.0, turn) * np.arange(count)).astype(int)
    unknown = virtual.unknown[numbers % beams] & (virtual.free[numbers % beams] < math.hypot(pose[0], pose[1]))
    return bool(unknown.mean() <= UNKNOWN)
