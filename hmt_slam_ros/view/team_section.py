"""The robots of a team on the live page: what is known of how their maps lie, and where they are."""

from __future__ import annotations

from typing import Any

import numpy as np

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.messages.map_changes import Pose
from hmt_slam_ros.messages.team import MAX_ROBOTS, TeamPlacement
from hmt_slam_ros.team.team_frame import team_poses


class TeamSection:
    """The section ``team`` of the page, for one robot of the team.

    :ivar robot: name of that robot, empty while it is unknown.
    :ivar robot_poses: {other robot: its ``map_T_base`` in its own map, shape (3,)}.
    :ivar maps: {other robot: lower left corner, size and tag of its map}.
    """

    def __init__(self) -> None:
        self.robot = ""
        self.robot_poses: dict[str, Pose] = {}
        self.maps: dict[str, dict[str, Any]] = {}
        self._placements: dict[tuple[str, str, str], TeamPlacement] = {}

    def note_placement(self, placement: TeamPlacement) -> None:
        """Remember the last answer of a robot for a pair."""
        known = {name for key in self._placements for name in key} | {self.robot}
        if len(known | {placement.robot, placement.first, placement.second}) <= MAX_ROBOTS + 1:
            self._placements[placement.robot, placement.first, placement.second] = placement

    @property
    def others(self) -> list[str]:
        """The other robots, by name."""
        return sorted({name for key in self._placements for name in key} - {self.robot, ""})

    @property
    def map_poses(self) -> dict[str, Pose]:
        """{other robot that is joined: ``map_T_map`` of its map in that of this robot, shape (3,)}."""
        poses = team_poses(self.robot, self._placements.values())
        own = poses.pop(self.robot)
        return {name: se2.between(own, pose) for name, pose in poses.items()}

    def content(self) -> list[dict[str, Any]]:
        """A row for every other robot; poses are in the map of this one, m and rad."""
        if not self.robot:
            return []
        poses = self.map_poses
        return [self._row(name, poses.get(name)) for name in self.others]

    def _row(self, name: str, pose: Pose | None) -> dict[str, Any]:
        row: dict[str, Any] = {"name": name, **self._verdict(name), "joined": pose is not None}
        if pose is None:
            return row
        row |= {"frame": _round_pose(pose), "map": self.maps.get(name)}
        robot_pose = self.robot_poses.get(name)
        return row if robot_pose is None else {**row, "robot": _round_pose(se2.compose(pose, robot_pose))}

    def _verdict(self, name: str) -> dict[str, Any]:
        """The last answer for this robot and another one: its own, or that of the other."""
        first, second = sorted((self.robot, name))
        answers = [self._placements.get((robot, first, second)) for robot in (self.robot, name)]
        answer = next(filter(None, answers), None)
        if answer is None:
            return {"verdict": None}
        return {
            "verdict": answer.verdict.value,
            "probability": round(answer.probability, 3),
            "apart": round(answer.apart, 3),
        }


def _round_pose(pose: Pose) -> list[float]:
    return np.round(pose, 4).tolist()
