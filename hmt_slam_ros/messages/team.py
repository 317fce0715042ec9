"""The messages between the robots of a team: what each shares of its map, and where it lies in that of another."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.map_changes import Arc, Pose
from hmt_slam_ros.registration.consistency import Clutter
from hmt_slam_ros.sensors import Scan

MAX_TEAM_AREAS, MAX_TEAM_KEYFRAMES = 2**16, 2**32
"""Bounds of the numbers of areas and keyframes in the map of a robot of a team."""

MAX_ROBOTS = 16
"""Other robots of a team: they bound the memory."""

MAX_LOG_REPETITION = 50.0
"""Largest log Bayes factor of a building that repeats itself, nats: its exponential stays finite."""


class Repetition(NamedTuple):
    """What the search of a map in itself shows of a building that repeats itself.

    :ivar log_ratio: log Bayes factor of such a building, nats.
    :ivar persistence: probability that what is alike goes on for one more window.
    """

    log_ratio: float
    persistence: float


NO_REPETITION = Repetition(0.0, 1.0)
"""A map that shows nothing of that: a twin may be as large as the building."""


@dataclass(frozen=True, eq=False, slots=True)
class SharedScan:
    """The scan of a keyframe.

    :ivar version: of the robot's map, at which it became part of it or changed.
    :ivar keyframe: number of the keyframe.
    :ivar scan: the scan.
    """

    version: int
    keyframe: int
    scan: Scan


@dataclass(frozen=True, eq=False, slots=True)
class SharedArea:
    """A definite area; without keyframes, one that was removed.

    :ivar version: of the robot's map, at which it became part of it or changed.
    :ivar area: id of the area.
    :ivar keyframes: numbers of its n keyframes.
    :ivar poses: ``area_T_base`` of each, shape (3,), m and rad.
    :ivar arcs: to areas with smaller ids.
    """

    version: int
    area: int
    keyframes: tuple[int, ...]
    poses: tuple[Pose, ...]
    arcs: tuple[Arc, ...]


SharedItem = SharedScan | SharedArea
"""A part of a map that has a version."""


@dataclass(frozen=True, slots=True)
class TeamStatus:
    """A robot -> all others: the version of the map that it shares.

    :ivar robot: name of the robot.
    :ivar session: of its map; versions of another session are not comparable.
    :ivar map_version: 0 for an empty map.
    :ivar digest: of all items of that version, hexadecimal.
    :ivar repetition: what the map shows in itself.
    """

    robot: str
    session: str
    map_version: int
    digest: str
    repetition: Repetition


@dataclass(frozen=True, slots=True)
class TeamRequest:
    """A robot -> another one: what changed since a version, please.

    :ivar robot: name of the robot that wants it.
    :ivar owner: name of the robot whose map it is.
    :ivar session: of that map.
    :ivar after: version up to which the map is known, 0 for nothing.
    """

    robot: str
    owner: str
    session: str
    after: int


@dataclass(frozen=True, eq=False, slots=True)
class TeamUpdate:
    """A robot -> all others: what changed in its map from a version to a later one.

    :ivar robot: name of the robot.
    :ivar session: of its map.
    :ivar after: version before the changes.
    :ivar until: version with them.
    :ivar scans: by growing version.
    :ivar areas: likewise. The scans of their keyframes are here, or in an earlier update.
    :ivar is_complete: whether there is nothing newer.
    :ivar clutter: usual rate of contradictions of the map.
    """

    robot: str
    session: str
    after: int
    until: int
    scans: tuple[SharedScan, ...]
    areas: tuple[SharedArea, ...]
    is_complete: bool
    clutter: Clutter

    @property
    def items(self) -> tuple[SharedItem, ...]:
        """Scans and areas."""
        return (*self.scans, *self.areas)


class Verdict(StrEnum):
    """What became of two components."""

    JOINED = "joined"
    APART = "apart"
    OPEN = "open"
    CONTRADICTORY = "contradictory"


@dataclass(frozen=True, eq=False, slots=True)
class TeamPlacement:
    """team -> other programs: how the map of one robot lies in that of another, where that has changed.

    :ivar robot: name of the robot that says so.
    :ivar first: name of the robot in whose map the other's lies.
    :ivar second: name of that other robot, after ``first`` in the order of names.
    :ivar verdict: joined; apart, as all placements together are less probable; open, as none is sure; or
        contradictory, as the arcs of a sure placement contradict one another.
    :ivar probability: of the most probable placement, 0 where there is none.
    :ivar apart: probability that they have no common ground, or lie otherwise.
    :ivar pose: shape (3,), ``first_T_second`` of the frames of the robots' maps under that placement, m, rad.
    """

    robot: str
    first: str
    second: str
    verdict: Verdict
    probability: float
    apart: float
    pose: Pose


@dataclass(frozen=True, eq=False, slots=True)
class TeamRendezvous:
    """A robot -> all others: where it observes another one, or that both were at one place.

    :ivar robot: name of the robot that says so.
    :ivar stamp: on its clock, ns.
    :ivar other: name of the other robot.
    :ivar other_stamp: on the clock of that robot, ns; the same where their clocks agree, and both were there at once.
    :ivar pose: belief over ``robot_T_other`` of their bases then.
    """

    robot: str
    stamp: int
    other: str
    other_stamp: int
    pose: PoseGaussian


@dataclass(frozen=True, eq=False, slots=True)
class TeamPlace:
    """A place beside a keyframe that robots of a team share.

    :ivar owner: name of the robot that mapped the keyframe.
    :ivar stamp: of its scan, on the clock of that robot, ns.
    :ivar pose: shape (3,), ``keyframe_T_place``, m and rad.
    """

    owner: str
    stamp: int
    pose: Pose


@dataclass(frozen=True, eq=False, slots=True)
class TeamGoal:
    """An explorer -> the explorers of all other robots: the frontier to which it drives.

    :ivar robot: name of the robot.
    :ivar newest_stamp: of the newest keyframe in its map then, on its clock, ns.
    :ivar reached_last: whether it reached its goal before this one.
    :ivar has_finished: whether its exploration has ended, so that no frontier is left beside its keyframes.
    :ivar place: where the frontier is; None where it drives to none.
    :ivar is_in_hallway: whether the frontier is expected in a hallway; else in a room, or nowhere.
    :ivar remaining: length of the path to it, m; 0 where there is none.
    """

    robot: str
    newest_stamp: int
    reached_last: bool
    has_finished: bool
    place: TeamPlace | None
    is_in_hallway: bool
    remaining: float


@dataclass(frozen=True, eq=False, slots=True)
class JoiningArc:
    """An arc that joins the maps of two robots.

    :ivar own_area: area of the robot's own ground.
    :ivar foreign_area: area of the other robot, in its numbers.
    :ivar pose: belief over ``own_area_T_foreign_area``.
    """

    own_area: int
    foreign_area: int
    pose: PoseGaussian


@dataclass(frozen=True, eq=False, slots=True)
class JoinedGround:
    """team -> tlca: ground of another robot that is joined with the robot's own, or what changed in it.

    :ivar robot: name of the other robot.
    :ivar session: of its map.
    :ivar scans: those that are new or changed, with the numbers of the other robot.
    :ivar areas: likewise.
    :ivar joining_arcs: all of them; none where the join is withdrawn.
    """

    robot: str
    session: str
    scans: tuple[SharedScan, ...]
    areas: tuple[SharedArea, ...]
    joining_arcs: tuple[JoiningArc, ...]


TeamMessage = TeamStatus | TeamRequest | TeamUpdate | TeamPlacement | TeamRendezvous
"""What the processes ``team`` of several robots send one another."""
