"""The output folder of maps that were merged: the map of the team, and how it came about."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.arrays import Int64
from hmt_slam_ros.configuration import Configuration, as_flat, as_nested
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.evaluation import StampedPoses, read_tum, write_tum
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.grids.occupancy_map import occupancy_image, write_map
from hmt_slam_ros.hybrid_map.hybrid_map import NO_KEYFRAME, HybridMap, has_foreign_keyframes
from hmt_slam_ros.hybrid_map.pose_graph import consistent_map
from hmt_slam_ros.messages.messages import LocalEstimate
from hmt_slam_ros.messages.replica import FIRST_HYPOTHESIS, Replica
from hmt_slam_ros.messages.team import Verdict
from hmt_slam_ros.results.export import export_topology
from hmt_slam_ros.results.hmt_map import SavedMap, read_clutter, read_saved_map
from hmt_slam_ros.results.log_reading import FIXED_PARAMETERS, map_folder
from hmt_slam_ros.results.output_folder import MERGE_REPORT, TEAM_PICTURE, TRAJECTORY, map_writer
from hmt_slam_ros.results.recorder import keyframe_poses
from hmt_slam_ros.results.trajectories import RelativeTrajectory, Trajectory, trajectory_in_map
from hmt_slam_ros.team.components import Component
from hmt_slam_ros.team.own_ground import own_ground
from hmt_slam_ros.team.placement import Placement
from hmt_slam_ros.team.team_map import Piece, PieceMeeting, TeamMap, split_component

_REPORTED = 10
"""Most placements of two pieces in the report, the most probable."""


@dataclass(frozen=True, eq=False)
class RobotMap:
    """The map of a robot.

    :ivar name: of its folder.
    :ivar saved: the map.
    :ivar hybrid_map: of its most probable hypothesis, without ground of other robots.
    :ivar relative_trajectory: of the scans, relative to keyframes of that ground.
    :ivar stamps: of the scans in the log, shape (n,), ns; empty where no output folder is around the map.
    :ivar components: {name: piece of it that arcs hold together}.
    """

    name: str
    saved: SavedMap
    hybrid_map: HybridMap
    relative_trajectory: RelativeTrajectory
    stamps: Int64
    components: dict[str, Component]


def read_team(paths: Sequence[Path]) -> list[RobotMap]:
    """The maps in output folders, or in hmt_maps.

    :raises HmtSlamError: for fewer than two, for a map that is given twice or is empty, and where maps were made with
        other parameters than the first.
    """
    if len(paths) < 2:
        raise HmtSlamError(f"merge joins two maps or more, and {len(paths)} is given: name another one")
    robots: list[RobotMap] = []
    for path, name in zip(paths, _names(paths), strict=True):
        robot = _read_robot(path, name)
        for other in robots:
            _check_pair(other, robot)
        robots.append(robot)
    return robots


def _names(paths: Sequence[Path]) -> list[str]:
    """A name of each map: that of its output folder, or its path where two have the same."""
    folders = [map_folder(path).resolve() for path in paths]
    names = [folder.parent.name if folder.name == "hmt_map" else folder.name for folder in folders]
    return names if len(set(names)) == len(names) else [str(path) for path in paths]


def _read_robot(path: Path, name: str) -> RobotMap:
    saved = read_saved_map(map_folder(path))
    whole = saved.replica.maps[saved.replica.best_hypothesis]
    relative = saved.relative_trajectory
    if has_foreign_keyframes(saved.replica.scans):
        hybrid_map = own_ground(whole)
        relative = relative.relative_to(_keyframes(hybrid_map), keyframe_poses(whole, consistent_map(whole).poses))
    else:
        hybrid_map = whole
    if not _keyframes(hybrid_map):
        raise HmtSlamError(f"{path} has no keyframes to join another map by: leave it out")
    component = Component.of_map(hybrid_map, saved.replica.scans, read_clutter(map_folder(path)))
    return RobotMap(name, saved, hybrid_map, relative, _read_stamps(path), split_component(name, component))


def _read_stamps(path: Path) -> Int64:
    file = map_folder(path).absolute().parent / TRAJECTORY
    return read_tum(file).stamps if file.is_file() else np.zeros(0, np.int64)


def _keyframes(hybrid_map: HybridMap) -> list[int]:
    return [keyframe for area in hybrid_map.area_ids() for keyframe in hybrid_map.keyframes(area)]


def _check_pair(one: RobotMap, other: RobotMap) -> None:
    if _scan_keys(other) <= _scan_keys(one):
        raise HmtSlamError(f"all scans of {other.name} are in {one.name}, too: leave it out")
    before, now = as_flat(one.saved.configuration), as_flat(other.saved.configuration)
    changed = [key for key in FIXED_PARAMETERS if key.startswith("local_map.") and before[key] != now[key]]
    if changed:
        raise HmtSlamError(
            f"{one.name} was made with {changed[0]} = {before[changed[0]]}, and {other.name} with {now[changed[0]]}: "
            "map one of them again with the other's parameters"
        )


def _scan_keys(robot: RobotMap) -> set[tuple[int, bytes]]:
    scans = [scan for component in robot.components.values() for scan in component.scans.values()]
    return {(scan.stamp, scan.ranges.tobytes()) for scan in scans}


def write_merged(directory: Path, robots: Sequence[RobotMap], team: TeamMap, configuration: Configuration) -> None:
    """Write hmt_map, map.pgm, map.yaml, map.png, team.png, topology.graphml with its tables, and merge.json.

    The map has no state of a run. Pieces whose places are unknown stand beside one another. Where all is in one piece,
    and the robots drove one after another, trajectory.tum has their scans.

    :param directory: an empty folder.
    """
    whole = team.whole()
    hybrid_map = whole.component.hybrid_map
    area_poses = consistent_map(hybrid_map).poses
    relative, starts = _trajectories(robots, whole)
    _write_grid(directory, whole, area_poses, configuration)
    writer = map_writer(directory)
    replica = _replica(robots[0], whole)
    estimate = _last_estimate(replica)
    writer.write_map(replica, area_poses, estimate, relative)
    writer.finish(configuration)
    export_topology(directory)
    report = json.dumps(merge_report(robots, team, configuration), indent=1, allow_nan=False)
    (directory / MERGE_REPORT).write_text(report + "\n", encoding="utf-8")
    from hmt_slam_ros.results.plots import draw_map, draw_team  # noqa: PLC0415  matplotlib takes long to load

    draw_team(directory / TEAM_PICTURE, _surfaces(robots, whole, keyframe_poses(hybrid_map, area_poses)))
    path = _path(relative, hybrid_map, area_poses)
    if len(team.pieces) == 1:
        _write_trajectory(directory, robots, path)
    path[[start for start in starts if start < len(path)]] = np.nan
    draw_map(directory, read_saved_map(map_folder(directory)), path)


def _write_grid(
    directory: Path, whole: Piece, area_poses: dict[int, PoseGaussian], configuration: Configuration
) -> None:
    poses = keyframe_poses(whole.component.hybrid_map, area_poses)
    scans, settings = [whole.component.scans[keyframe] for keyframe in poses], configuration.local_map
    write_map(directory, occupancy_image(scans, np.array(list(poses.values())), settings.cell, settings.max_range))


def _surfaces(
    robots: Sequence[RobotMap], whole: Piece, poses: Mapping[int, NDArray[np.float64]]
) -> dict[str, NDArray[np.float64]]:
    """{robot: end points of its beams in the map, shape (n, 2), m}.

    :param poses: {keyframe of the whole map: ``map_T_base``, shape (3,)}.
    """
    surfaces = {}
    for robot in robots:
        points = [np.zeros((0, 2))]
        for name, component in robot.components.items():
            shift = whole.shifts[name].keyframes
            points += [
                se2.transform(poses[keyframe + shift], scan.points)
                for keyframe, scan in component.scans.items()
                if keyframe + shift in poses
            ]
        surfaces[robot.name] = np.concatenate(points)
    return surfaces


def _trajectories(robots: Sequence[RobotMap], whole: Piece) -> tuple[RelativeTrajectory, list[int]]:
    """The scans of all robots relative to the keyframes of the whole map, and the first of each robot."""
    keyframes, poses, starts = [np.zeros(0, np.int64)], [np.zeros((0, 3))], list[int]()
    for robot in robots:
        own = robot.relative_trajectory
        starts.append(sum(map(len, keyframes)))
        numbers = own.keyframes.copy()
        for name, component in robot.components.items():
            numbers[np.isin(own.keyframes, list(component.scans))] += whole.shifts[name].keyframes
        keyframes.append(numbers)
        poses.append(own.poses)
    return RelativeTrajectory(np.concatenate(keyframes), np.concatenate(poses)), starts


def _path(relative: RelativeTrajectory, hybrid_map: HybridMap, area_poses: dict[int, PoseGaussian]) -> Trajectory:
    """``map_T_base`` of all scans, shape (n, 3)."""
    if not (relative.keyframes != NO_KEYFRAME).any():
        return np.full(relative.poses.shape, np.nan)
    return trajectory_in_map(relative, keyframe_poses(hybrid_map, area_poses))


def _write_trajectory(directory: Path, robots: Sequence[RobotMap], path: Trajectory) -> None:
    """Write the trajectory of all robots, if it is one drive after another.

    :param path: shape (n, 3), of all scans.
    """
    drives = sorted((robot.stamps for robot in robots), key=lambda stamps: stamps[:1].tolist())
    if sum(map(len, drives)) != len(path) or any(a[-1] > b[0] for a, b in pairwise(drives)):
        return
    # A scan at which a log is cut in two may be in both parts.
    stamps, first = np.unique(np.concatenate([robot.stamps for robot in robots]), return_index=True)
    write_tum(directory / TRAJECTORY, StampedPoses(stamps, path[first]))


def _replica(robot: RobotMap, whole: Piece) -> Replica:
    """The whole map as the only hypothesis, with a robot in the area where the first one was at last."""
    area = robot.saved.replica.robot_areas[robot.saved.replica.best_hypothesis]
    if not robot.hybrid_map.has_area(area):  # of another robot
        area = max(robot.hybrid_map.area_ids(), key=lambda own: max(robot.hybrid_map.keyframes(own), default=-1))
    own = next(name for name, component in robot.components.items() if component.hybrid_map.has_area(area))
    return Replica(
        dict(whole.component.scans),
        {FIRST_HYPOTHESIS: whole.component.hybrid_map},
        {FIRST_HYPOTHESIS: 1.0},
        {FIRST_HYPOTHESIS: area + whole.shifts[own].areas},
    )


def _last_estimate(replica: Replica) -> LocalEstimate:
    """The pose of the newest keyframe in the robot's area."""
    area = replica.robot_areas[FIRST_HYPOTHESIS]
    keyframes = replica.maps[FIRST_HYPOTHESIS].keyframes(area)
    newest = max(keyframes)
    pose = PoseGaussian.from_pose(keyframes[newest])
    return LocalEstimate(replica.scans[newest].stamp, 0, area, pose, np.zeros(3), 0)


def merge_report(robots: Sequence[RobotMap], team: TeamMap, configuration: Configuration) -> dict[str, Any]:
    """The content of merge.json: poses x, y in m and theta in rad, of frames of the first areas."""
    return {
        "maps": [
            {
                "name": robot.name,
                "areas": len(robot.hybrid_map.area_ids()),
                "keyframes": sum(len(component.scans) for component in robot.components.values()),
                "pieces": list(robot.components),
            }
            for robot in robots
        ],
        "pieces": [
            {
                "components": {name: {"areas": s.areas, "keyframes": s.keyframes} for name, s in piece.shifts.items()},
                "areas": len(piece.component.hybrid_map.area_ids()),
            }
            for piece in team.pieces
        ],
        "meetings": [_meeting_entry(meeting) for meeting in team.meetings],
        "configuration": as_nested(configuration),
    }


def _meeting_entry(met: PieceMeeting) -> dict[str, Any]:
    found = met.meeting
    return {
        "first": met.first,
        "second": met.second,
        "verdict": found.verdict.value,
        "windows": len(found.windows),
        "apart": found.distribution.apart,
        "placements": [_placement_entry(met, placement) for placement in found.distribution.placements[:_REPORTED]],
    }


def _placement_entry(met: PieceMeeting, placement: Placement) -> dict[str, Any]:
    pair, windows = met.meeting.pair, met.meeting.windows
    return {
        **dict(zip(("x", "y", "theta"), placement.pose.tolist(), strict=True)),
        "probability": placement.probability,
        "best_window": placement.evidence.best,
        "other_windows": placement.evidence.agreement,
        "agreeing": [
            {
                "window": number,
                "area": windows[number].area - pair.area_shift,
                "keyframes": [k - pair.first_keyframe for k in windows[number].poses],
                "known_area": match.area,
                "log_ratio": match.log_ratio,
            }
            for number, match in placement.matches.items()
        ],
    }


def describe_meeting(met: PieceMeeting) -> str:
    """A sentence on two pieces, for the user."""
    found, names = met.meeting.distribution, f"{met.second} and {met.first}"
    best = found.best
    if best is None:
        return f"{names} stay apart: no place of one looks like one of the other"
    count = len(best.matches)
    places = f"{count} place{'' if count == 1 else 's'}"
    sure = f"the most probable placement has {best.probability:.3f}, by {places}; apart has {found.apart:.3f}"
    match met.meeting.verdict:
        case Verdict.JOINED:
            return (
                f"{met.second} joins {met.first} with probability {best.probability:.3f}, by {places}; apart has "
                f"{found.apart:.3f}"
            )
        case Verdict.APART:
            return f"{names} stay apart: {sure}"
        case Verdict.CONTRADICTORY:
            return f"{names} stay apart: the places by which they would be joined contradict one another; {sure}"
        case _:
            return f"{names} stay apart, no placement is sure: {sure}"
