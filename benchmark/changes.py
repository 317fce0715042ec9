"""Maps of changing worlds in mode lifelong: changed and kept surfaces, and ghosts of people."""

from __future__ import annotations

import multiprocessing
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmark.one_drive import JoinedVisits
from benchmark.report import Columns, Report, Requirement, mean, table_of
from benchmark.settings import Settings
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.grids.occupancy_map import OCCUPIED, OccupancyImage, occupancy_image
from hmt_slam_ros.logs.records import Log
from hmt_slam_ros.messages.map_changes import InitialPose
from hmt_slam_ros.messages.messages import PoseReset
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.offline.lock_step import LockStepRun
from hmt_slam_ros.results.final_map import deskewed_scans, final_map
from hmt_slam_ros.results.hmt_map import RunState
from hmt_slam_ros.results.recorder import Recording, keyframe_poses
from hmt_slam_ros.simulation import SimulatedLog, open_simulated
from hmt_slam_ros.simulation.building import furniture_walls
from hmt_slam_ros.simulation.laser import clearance, has_line_of_sight, wall_index

WORLDS = {"quiet": "office", "people": "busy"}
"""The same buildings without and with people in the corridors."""

SEEDS, FIRST_SEED, RETURNS = 3, 1000, 3
"""Number of buildings of each world, seed of the first, and number of returns to one without changes."""

SIZE, RATE = 0.7, 3.0
"""Factor on the lengths of the buildings, and scans per second."""

RECALL, KEPT, GHOSTS, UNEXPLAINED, ERROR, GROWTH = 0.8, 0.98, 0.1, 0.002, 0.1, 0.05
"""Smallest shares of new and remaining surfaces; largest shares of ghosts and unexplained cells, error (m), growth."""

LOCALIZED = 0.1
"""Largest mean error of poses in mode localization, m."""

POLICY = (
    "Every building is mapped at one visit, of two laps, and visited again in mode `lifelong`, from the saved map. "
    "Before each of the two visits, half of the furniture was moved, and half of the doors off the route were closed, "
    "so that doors are also opened between them. Without people, the robot gets an approximate initial pose; with "
    "people, it stayed where it was and turned round. A surface counts if three of every fourth scan of the second "
    "visit had a free view of it within 8 m. New surfaces were 0.2 m or more from any surface of the first visit; they "
    "are in the map if a cell within 0.1 m is occupied. Surfaces that are gone were in the map of the first visit, are "
    "as far from any surface of the second one, and were in free view of as many scans; each is a ghost if a cell "
    "within 0.1 m is still occupied. Surfaces of the first map that remain are kept if such a cell is. Cells at 0.2 m "
    "or more from every true surface of the last visit are unexplained, except for surfaces that were not seen to be "
    "gone. Errors are those of the second visit's final trajectory in the map of the first. The growth is that of "
    f"keyframes from the second to visit {RETURNS + 1} of a building in which nothing changes. In `localization` every "
    "keyframe, pose, scan and arc has to be the same bit for bit afterwards; its errors include poses of a lost robot."
)

# Covariance of an initial pose that is drawn in RViz.
_INITIAL_COVARIANCE = np.diag([0.5, 0.5, np.radians(15.0)]) ** 2

Points = NDArray[np.float64]
_SAMPLE = 0.05  # m, between points of a surface
_REACH, _MIN_SCANS = 8.0, 3  # largest distance of a surface that is seen, m, and smallest number of scans that see it
_NEAR = 0.1  # largest distance of a mapped surface from an occupied cell, m
_APART = 0.2  # m between surfaces of two visits
_SHORT = 0.02  # m, by which a line of sight ends before the surface
_EVERY = 4  # of the scans


@dataclass(frozen=True)
class Visit:
    """The scores of a building that was visited twice.

    :ivar new: share of the new surfaces that are in the map.
    :ivar gone: share of the surfaces that are gone, but still in the map.
    :ivar kept: share of the remaining surfaces that are still in the map.
    :ivar before: share of the occupied cells that are unexplained after the first visit.
    :ivar after: likewise after the second.
    :ivar error: of the second visit's poses, mean, m.
    :ivar worst: largest of them, m.
    :ivar keyframes: of the map after each of the two.
    :ivar lengths: of new surfaces and of surfaces that are gone, m.
    """

    new: float
    gone: float
    kept: float
    before: float
    after: float
    error: float
    worst: float
    keyframes: tuple[int, int]
    lengths: tuple[float, float]


class LocalizationVisit(NamedTuple):
    """A second visit in mode localization.

    :ivar same: whether the map is as it was.
    :ivar error: of the poses, mean, m.
    :ivar worst: largest of them, m.
    """

    same: bool
    error: float
    worst: float


@dataclass(frozen=True, eq=False)
class MapAfterVisit:
    """A building after a visit.

    :ivar recording: the refined map.
    :ivar state: of the run.
    :ivar image: of the map.
    """

    recording: Recording
    state: RunState
    image: OccupancyImage

    @property
    def keyframes(self) -> int:
        """Of the map."""
        hybrid_map = self.recording.hybrid_map
        return sum(len(hybrid_map.keyframes(area)) for area in hybrid_map.area_ids())


def measure_changes(settings: Settings) -> Report:
    """Visit the buildings, and score their maps."""
    seeds = tuple(FIRST_SEED + seed for seed in settings.seeds_or(SEEDS))
    report = Report("changes", "A world that changes", seeds=seeds)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(settings.runner.jobs, context) as pool:
        visits = {name: list(pool.map(partial(visit_twice, world), seeds)) for name, world in WORLDS.items()}
        sizes = {name: pool.submit(visit_often, world, seeds[0]) for name, world in WORLDS.items()}
        localized = {name: list(pool.map(partial(localize_again, world), seeds)) for name, world in WORLDS.items()}
    rows = []
    for name, found in visits.items():
        sizes_of_world = sizes[name].result()
        report.requirements += requirements(name, found, sizes_of_world, localized[name])
        scores = [visit._asdict() for visit in localized[name]]
        report.data[name] = {"visits": list(map(asdict, found)), "keyframes": sizes_of_world, "localization": scores}
        rows += [(f"{name}, {seed}", visit) for seed, visit in zip(seeds, found, strict=True)]
        report.body.append(
            f"{name}, nothing changes: {', '.join(map(str, sizes_of_world))} keyframes after the visits."
        )
    report.body += [_describe_localization(name, seeds, scores) for name, scores in localized.items()]
    report.body = [table_of(_COLUMNS, rows), *report.body, POLICY]
    return report


def requirements(
    name: str, found: Sequence[Visit], sizes: Sequence[int], localized: Sequence[LocalizationVisit]
) -> list[Requirement]:
    """Requirements on a world.

    :param sizes: keyframes after each visit in which nothing changed.
    :param localized: second visits in mode localization.
    """
    return [
        Requirement(f"{name}: new surfaces in the map", mean([visit.new for visit in found]), 1.0, least=RECALL),
        Requirement(f"{name}: surfaces that stay, kept", mean([visit.kept for visit in found]), 1.0, least=KEPT),
        Requirement(f"{name}: ghosts of what is gone", mean([visit.gone for visit in found]), GHOSTS),
        Requirement(f"{name}: unexplained cells, mapping", mean([visit.before for visit in found]), UNEXPLAINED),
        Requirement(f"{name}: unexplained cells, lifelong", mean([visit.after for visit in found]), UNEXPLAINED),
        Requirement(f"{name}: worst error of the second visit", max(visit.worst for visit in found), ERROR, "m"),
        Requirement(f"{name}: growth where nothing changes", sizes[-1] / sizes[1] - 1.0, GROWTH),
        Requirement(f"{name}: maps that localization changed", float(sum(not visit.same for visit in localized)), 0.0),
        Requirement(f"{name}: error of localization, mean", mean([visit.error for visit in localized]), LOCALIZED, "m"),
        Requirement(f"{name}: worst error of localization", max(visit.worst for visit in localized), ERROR, "m"),
    ]


def visit_twice(world: str, seed: int, size: float = SIZE, rate: float = RATE) -> Visit:
    """Map a building, let it change, and visit it again.

    :param size: of the building.
    :param rate: scans a second.
    """
    logs = [_simulate_visit(world, seed, number, changed=0.5, size=size, rate=rate) for number in (1, 2)]
    first = map_visits(logs[:1], "mapping")
    second = map_visits(logs, "lifelong", first)
    surfaces = [Surfaces.at_visit(log) for log in logs]
    frames = [_frame(after.recording, logs[0]) for after in (first, second)]
    images = [after.image for after in (first, second)]
    scores = score_changes(images, frames, surfaces)
    return Visit(
        scores.new,
        scores.gone,
        scores.kept,
        unexplained_share(images[0], frames[0], surfaces[0].walls),
        unexplained_share(images[1], frames[1], np.concatenate((surfaces[1].walls, scores.hidden))),
        *_errors(second.recording, logs),
        (first.keyframes, second.keyframes),
        scores.lengths,
    )


def visit_often(world: str, seed: int, size: float = SIZE, rate: float = RATE, returns: int = RETURNS) -> list[int]:
    """Keyframes of a building's map after each visit, where nothing changes."""
    found: list[int] = []
    logs: list[SimulatedLog] = []
    after: MapAfterVisit | None = None
    for number in range(1, returns + 2):
        logs.append(_simulate_visit(world, seed, number, changed=0.0, size=size, rate=rate))
        after = map_visits(logs, "mapping" if after is None else "lifelong", after)
        found.append(after.keyframes)
    return found


def localize_again(world: str, seed: int, size: float = SIZE, rate: float = RATE) -> LocalizationVisit:
    """A second visit in mode localization, in a world that changes."""
    logs = [_simulate_visit(world, seed, number, changed=0.5, size=size, rate=rate) for number in (1, 2)]
    first = map_visits(logs[:1], "mapping")
    second = map_visits(logs, "localization", first)
    return LocalizationVisit(_is_same_map(first.state, second.state), *_errors(second.recording, logs))


def _errors(recording: Recording, logs: Sequence[SimulatedLog]) -> tuple[float, float]:
    """Mean and worst error of the second visit's final poses, m, in the map of the first."""
    poses = se2.compose(_frame(recording, logs[0]), recording.trajectory[-logs[1].scan_count :])
    errors = np.hypot(*(poses - logs[1].true_poses(logs[1].scenario.scan_stamps))[:, :2].T)
    return float(errors.mean()), float(errors.max())


def map_visits(visits: Sequence[SimulatedLog], mode: str, before: MapAfterVisit | None = None) -> MapAfterVisit:
    """Map the last of some visits.

    :param before: the map after the visit before.
    """
    stays = visits[0].scenario.settings.people > 0
    log: Log = JoinedVisits(visits) if stays else visits[-1]
    configuration = replace(Configuration(), mode=mode)
    run = LockStepRun(configuration, state=None if before is None else before.state)
    records = run.unread_records(log)
    if before is not None and not stays:
        run.lock_step.feed(PoseReset(_initial_pose(before.recording)))
    for record in records:
        run.process_record(record)
    state = run.state
    result = run.finish()
    recording = result.recorder.finish(result.log_progress.stamps, result.log_progress.first_scans)
    recording = final_map(recording, partial(deskewed_scans, log, configuration), configuration).recording
    placed = keyframe_poses(recording.hybrid_map, recording.area_poses)
    scans, settings = [recording.replica.scans[k] for k in placed], configuration.local_map
    image = occupancy_image(scans, np.array(list(placed.values())), settings.cell, settings.max_range)
    return MapAfterVisit(recording, state, image)


def _initial_pose(recording: Recording) -> InitialPose:
    """The initial pose of every visit, the origin of the map, with the accuracy of RViz."""
    placed = keyframe_poses(recording.hybrid_map, recording.area_poses)
    nearest = min(placed, key=lambda keyframe: float(np.hypot(*placed[keyframe][:2])))
    area = next(a for a in recording.hybrid_map.area_ids() if nearest in recording.hybrid_map.keyframes(a))
    pose = se2.inverse(recording.area_poses[area].mean)
    return InitialPose(area, PoseGaussian(pose, _INITIAL_COVARIANCE))


def _simulate_visit(world: str, seed: int, number: int, *, changed: float, size: float, rate: float) -> SimulatedLog:
    # Two laps of the first visit close its loop. Furniture is moved between visits only, so that each has one truth.
    return open_simulated(
        f"sim:{world},seed={seed},laps={2 if number == 1 else 1},moved=0,visit={number},changed={changed:g},"
        f"size={size:g},rate={rate:g}"
    )


def _frame(recording: Recording, first: SimulatedLog) -> NDArray[np.float64]:
    """``world_T_map``, shape (3,), by all poses of the first visit."""
    truth = first.true_poses(first.scenario.scan_stamps)
    poses = recording.trajectory[: len(truth)]
    turn = np.angle(np.exp(1j * (truth[:, 2] - poses[:, 2])).mean())
    turned = se2.transform(np.array([0.0, 0.0, turn]), poses[:, :2])
    return np.array([*(truth[:, :2] - turned).mean(axis=0), turn])


def _is_same_map(before: RunState, after: RunState) -> bool:
    """Whether another state contains the best map of a state unchanged."""
    old_replica, new_replica = (Replica.from_state(state.processes["slam"].replica) for state in (before, after))
    old_map, new_map = old_replica.maps[old_replica.best_hypothesis], new_replica.maps[new_replica.best_hypothesis]
    areas = old_map.area_ids()
    arcs = {(a, b): arc for a, b, arc in new_map.all_arcs()}
    return (
        all(_are_equal(old_map.keyframes(area), new_map.keyframes(area)) for area in areas)
        and all(_are_equal({0: arc.pose.mean}, {0: arcs[a, b].pose.mean}) for a, b, arc in old_map.all_arcs())
        and all(old_replica.scans[k] is new_replica.scans[k] for area in areas for k in old_map.keyframes(area))
    )


def _are_equal(poses: Mapping[int, NDArray[np.float64]], other_poses: Mapping[int, NDArray[np.float64]]) -> bool:
    return poses.keys() == other_poses.keys() and all((poses[k] == other_poses[k]).all() for k in poses)


def _describe_localization(name: str, seeds: Sequence[int], localized: Sequence[LocalizationVisit]) -> str:
    texts = (f"{seed} {visit.error:.3f} ({visit.worst:.3f})" for seed, visit in zip(seeds, localized, strict=True))
    return f"{name}, localization, error and worst [m]: {', '.join(texts)}."


_COLUMNS: Columns[tuple[str, Visit]] = [
    ("world, seed", lambda row: row[0]),
    ("new [m]", lambda row: f"{row[1].lengths[0]:.0f}"),
    ("in the map", lambda row: f"{100.0 * row[1].new:.0f} %"),
    ("gone [m]", lambda row: f"{row[1].lengths[1]:.0f}"),
    ("ghosts", lambda row: f"{100.0 * row[1].gone:.0f} %"),
    ("kept", lambda row: f"{100.0 * row[1].kept:.1f} %"),
    ("unexplained before", lambda row: f"{100.0 * row[1].before:.2f} %"),
    ("after", lambda row: f"{100.0 * row[1].after:.2f} %"),
    ("error [m]", lambda row: f"{row[1].error:.3f}"),
    ("worst [m]", lambda row: f"{row[1].worst:.3f}"),
    ("keyframes", lambda row: ", ".join(map(str, row[1].keyframes))),
]


class Surfaces(NamedTuple):
    """The surfaces of a building at a visit, and the poses that saw them.

    :ivar walls: shape (n, 4), m, x and y of both ends: walls, closed doors and furniture.
    :ivar lasers: shape (k, 3), ``world_T_laser`` of some of the scans, m and rad.
    :ivar half_field: largest angle to either side at which the laser sees, rad.
    """

    walls: NDArray[np.float64]
    lasers: NDArray[np.float64]
    half_field: float

    @classmethod
    def at_visit(cls, log: SimulatedLog) -> Surfaces:
        """The surfaces of a visit during which nothing is moved."""
        scenario = log.scenario
        poses = log.true_poses(scenario.scan_stamps[::_EVERY])
        walls = np.concatenate((scenario.walls.walls, furniture_walls(scenario.building.furniture)))
        return cls(walls, se2.compose(poses, scenario.laser.pose), scenario.laser.half_field)

    def points(self) -> Points:
        """Points of all surfaces, shape (m, 2)."""
        parts = []
        for x0, y0, x1, y1 in self.walls:
            steps = np.linspace(0.0, 1.0, 2 + int(np.hypot(x1 - x0, y1 - y0) / _SAMPLE))[:, None]
            parts.append(np.array([x0, y0]) + steps * np.array([x1 - x0, y1 - y0]))
        return np.concatenate(parts)

    def in_view(self, points: Points) -> NDArray[np.bool_]:
        """Which points (m, 2) have a free line of sight to enough scans, shape (m,)."""
        index, counts = wall_index(self.walls), np.zeros(len(points), dtype=np.int64)
        for laser in self.lasers:
            local = se2.transform(se2.inverse(laser), points)
            near = np.flatnonzero(
                (np.hypot(*local.T) <= _REACH) & (np.abs(np.arctan2(local[:, 1], local[:, 0])) <= self.half_field)
            )
            directions = points[near] - laser[:2]
            ends = laser[:2] + directions * (1.0 - _SHORT / np.hypot(*directions.T))[:, None]
            counts[near] += has_line_of_sight(index, np.broadcast_to(laser[:2], ends.shape).copy(), ends)
        return counts >= _MIN_SCANS


class ChangeScores(NamedTuple):
    """The scores of a map after a change.

    :ivar new: share of the visible new surfaces that are in the map.
    :ivar gone: share of the surfaces that are visibly gone, but still in the map.
    :ivar kept: share of the remaining surfaces of the first map that are in the second.
    :ivar lengths: of visible new surfaces and of those that are visibly gone, m.
    :ivar hidden: shape (k, 4), the surfaces that are gone without being seen, as short pieces, m.
    """

    new: float
    gone: float
    kept: float
    lengths: tuple[float, float]
    hidden: NDArray[np.float64]


def score_changes(
    images: Sequence[OccupancyImage], frames: Sequence[Points], visits: Sequence[Surfaces]
) -> ChangeScores:
    """Score the second of two maps by the changes between their visits.

    :param frames: ``world_T_map`` of each, shape (3,).
    """
    before, after = visits
    points = after.points()
    new = points[clearance(before.walls, points) > _APART]
    new = new[after.in_view(new)]
    points = before.points()
    points = points[_is_occupied_near(images[0], frames[0], points)]
    apart = clearance(after.walls, points)
    gone, remaining = points[apart > _APART], points[apart < _SHORT]
    is_seen_gone = after.in_view(gone)
    lengths = _SAMPLE * len(new), _SAMPLE * int(is_seen_gone.sum())
    found, ghosts, kept = (
        _is_occupied_near(images[1], frames[1], part) for part in (new, gone[is_seen_gone], remaining)
    )
    hidden = np.concatenate((gone[~is_seen_gone], gone[~is_seen_gone] + 1e-3), axis=1)
    return ChangeScores(mean(found), mean(ghosts), mean(kept), lengths, hidden)


def unexplained_share(image: OccupancyImage, frame: Points, walls: NDArray[np.float64]) -> float:
    """Share of the occupied cells that are far from all surfaces.

    :param frame: ``world_T_map``, shape (3,).
    """
    return float(np.mean(clearance(np.ascontiguousarray(walls), _occupied_cells(image, frame)) > _APART))


def _occupied_cells(image: OccupancyImage, frame: Points) -> Points:
    """The centers of the occupied cells, shape (n, 2), world frame, m."""
    row, column = np.nonzero(image.pixels[::-1] == OCCUPIED)
    cells = image.origin + image.resolution * (np.stack((column, row), axis=1) + 0.5)
    return np.ascontiguousarray(se2.transform(frame, cells))


def _is_occupied_near(image: OccupancyImage, frame: Points, points: Points) -> NDArray[np.bool_]:
    """Which points (n, 2), world frame, have an occupied cell near them, shape (n,)."""
    cells = _occupied_cells(image, frame)
    return np.asarray(clearance(np.concatenate((cells, cells), axis=1), points) <= _NEAR, dtype=np.bool_)
