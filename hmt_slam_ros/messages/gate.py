"""What a message has to mean before a process sees it, beyond the form of its document.

A stranger, another version or a damaged link may send anything. A document is decoded, its values are checked by
themselves, and those of the chain also against the hypotheses that are alive. What fails is refused by one sentence.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import NO_KEYFRAME
from hmt_slam_ros.messages.ambiguity import NOT_DRIVEN, Ambiguity
from hmt_slam_ros.messages.documents import (
    KeyframeHeader,
    ResetRequest,
    ResetResponse,
    SaveRequest,
    SaveResponse,
    decode,
    decode_with_reset,
)
from hmt_slam_ros.messages.messages import ClosureDecision, Hypotheses, Keyframe
from hmt_slam_ros.messages.statements import check_statement
from hmt_slam_ros.messages.system_name import SystemName
from hmt_slam_ros.messages.team import (
    MAX_LOG_REPETITION,
    MAX_TEAM_AREAS,
    MAX_TEAM_KEYFRAMES,
    JoinedGround,
    SharedArea,
    SharedScan,
    TeamGoal,
    TeamMessage,
    TeamPlacement,
    TeamRendezvous,
    TeamStatus,
    TeamUpdate,
)
from hmt_slam_ros.plain_data import field_names, is_record
from hmt_slam_ros.process_table import participant_names
from hmt_slam_ros.sensors.mark import MarkObservation, check_mark
from hmt_slam_ros.sensors.plausibility import COVARIANCE_FORM, MAX_COORDINATE, check_scan, find_invalid_covariance

Document = TypeVar("Document")

MAX_REACH = 10_000
"""Keyframe events by which a message may be ahead of the next one of its kind."""

MAX_RESET_AHEAD = 86_400_000_000_000
"""Time by which the number of a request, the time of slam's clock, may be ahead of this node's, ns."""

_TOLERANCE = 1e-6
"""Rounding of a sum of probabilities."""

_TEAM_NAME = re.compile(r"[\w.:+-]{1,100}", re.ASCII)
_REMEDY = "look for a second system or a stranger in this ROS domain, and give each system its own"
_COUNTS = frozenset(
    (
        "sequence",
        "number",
        "events",
        "event",
        "scans",
        "scans_in_log",
        "odometry_readings",
        "acknowledged",
        "dropped",
        "scan_index",
        "scans_before",
        "keyframes",
        "scan_poses",
        "received",
        "processed",
        "hypothesis",
        "id",
        "parent",
        "area",
        "into",
        "source",
        "target",
        "previous_area",
        "stamp",
        "newest_stamp",
        "version",
        "map_version",
        "after",
        "until",
    )
)
"""Fields of whole numbers that are never negative."""


def decode_checked(text: str, kind: type[Document], system: SystemName) -> tuple[Document, int]:
    """The message of a JSON document, and the reset number of its sender.

    :param system: of the receiver.
    :raises HmtSlamError: where it is malformed, of another system, or :func:`check_message` refuses it.
    """
    message, reset_number = decode_with_reset(text, kind, system.admit)
    _check_request_number("reset", reset_number)
    check_message(message)
    return message, reset_number


def check_message(message: object) -> None:
    """Check the values of a message by themselves.

    :raises HmtSlamError: names the field, its value and the remedy.
    """
    matrices: list[NDArray[np.float64]] = []
    for name, value in _walk(message):
        if isinstance(value, np.ndarray) and value.shape == (3, 3):
            matrices.append(value)
        elif isinstance(value, np.ndarray) and value.shape == (3,) and value.dtype == np.float64:
            _require(bool((np.abs(value) <= MAX_COORDINATE).all()), name, value.tolist(), "a pose within 1e7 m")
        elif type(value) is int and name == "keyframe":
            _require(value != NO_KEYFRAME, name, value, "a keyframe")
        elif type(value) is int and name in _COUNTS:
            _require(value >= 0, name, value, "0 or more")
    _check_covariances(matrices)
    _check_kind(message)


def _check_kind(message: object) -> None:
    """Check what is particular to a kind of messages."""
    if isinstance(message, Hypotheses):
        _check_hypotheses(message)
    elif isinstance(message, Ambiguity):
        _check_looks(message)
    elif isinstance(message, Keyframe):
        check_scan(message.scan)
        _check_marks(message.marks)
    elif isinstance(message, KeyframeHeader):
        check_scan(message.to_keyframe(np.ones(1, dtype=np.float32)).scan)
        _check_marks(message.marks)
    elif isinstance(message, SaveRequest | ResetRequest):
        _check_request_number("number", message.number)
    elif isinstance(message, SaveResponse | ResetResponse):
        _check_response(message)
    elif isinstance(message, TeamMessage | JoinedGround):
        _check_team_message(message)
    elif isinstance(message, TeamGoal):
        _check_goal(message)


def _check_marks(marks: Iterable[MarkObservation]) -> None:
    names = [check_mark(observation).name for observation in marks]
    _require(len(names) == len(set(names)), "marks", names, "one of each name")


def decode_of_team(text: str, kind: type[Document]) -> Document:
    """The message of a JSON document from any robot, whatever its system.

    :raises HmtSlamError: where it is malformed, or :func:`check_message` refuses it.
    """
    message = decode(text, kind)
    check_message(message)
    return message


def check_belief(belief: PoseGaussian, name: str) -> None:
    """Check that the covariance of a belief is one.

    :raises HmtSlamError: where it is not finite, symmetric, positive semidefinite or is far too large.
    """
    _check_covariances([belief.covariance], f"the covariance of the {name}")


def check_save_folder(folder: Path, process: str) -> None:
    """Check that slam's node made a folder for a save, in which a process has not yet written.

    :raises HmtSlamError: where it is another folder.
    """
    parent = folder.parent.name
    is_made_by_slam = folder.is_absolute() and folder.name == "new" and parent.startswith(".") and ".partial-" in parent
    _require(is_made_by_slam and ".." not in folder.parts, "folder", folder, "a folder that slam made for a save")
    entries = list(folder.iterdir())
    saved = {f"{name}{suffix}" for name in (*participant_names(), *_SLAM_PARTS) for suffix in (".json", ".bin")}
    saved -= {f"{process}.json", f"{process}.bin"}
    strange = [entry.name for entry in entries if entry.name not in saved or entry.is_symlink() or not entry.is_file()]
    _require(not (strange or folder.is_symlink()), "folder", folder, "a folder that holds a save's files alone")


_SLAM_PARTS = ("slam", "chain", "map")
"""Parts of a map that slam's node writes before it asks the others."""


class ChainGate:
    """Checks of the chain against the hypotheses that are alive.

    :ivar alive: ids of the hypotheses, None where they are not known yet.
    """

    def __init__(self, alive: Iterable[int] | None = None) -> None:
        """:param alive: ids of the hypotheses, None where they are not known yet."""
        self.alive = None if alive is None else frozenset(alive)
        self._alive_before = self.alive

    def check(self, message: object) -> None:
        """Check a message whose turn it is.

        :raises HmtSlamError: where it names a hypothesis that is not alive.
        """
        if self.alive is None:
            return
        if isinstance(message, Hypotheses):
            for hypothesis in message.hypotheses:
                _require(hypothesis.parent in self.alive, "parent", hypothesis.parent, "a hypothesis that is alive")
        elif isinstance(message, ClosureDecision) and message.hypothesis is not None:
            _require(message.hypothesis in self.alive, "hypothesis", message.hypothesis, "a hypothesis that is alive")

    def note(self, message: object) -> None:
        """Take note of a message that was received or sent."""
        self._alive_before = self.alive
        if isinstance(message, Hypotheses):
            self.alive = frozenset(hypothesis.id for hypothesis in message.hypotheses)
        elif isinstance(message, ClosureDecision) and message.hypothesis is not None:
            self.alive = frozenset((message.hypothesis,))

    def withdraw(self) -> None:
        """Forget the last message that was noted."""
        self.alive = self._alive_before


def _walk(message: object) -> Iterator[tuple[str, object]]:
    """The fields of a message and of all records in it, by name."""
    pending: list[Any] = [message]
    while pending:
        record = pending.pop()
        kind: type = type(record)
        for name in field_names(kind):
            value = getattr(record, name)
            yield name, value
            items = value if isinstance(value, tuple) and not is_record(type(value)) else (value,)
            pending.extend(item for item in items if is_record(type(item)))


def _check_covariances(matrices: list[NDArray[np.float64]], name: str = "a covariance") -> None:
    if not matrices:
        return
    invalid = find_invalid_covariance(np.array(matrices))
    if invalid is not None:
        _require(False, name, matrices[invalid].tolist(), COVARIANCE_FORM)


def _check_hypotheses(message: Hypotheses) -> None:
    ids = [hypothesis.id for hypothesis in message.hypotheses]
    _require(0 < len(ids) == len(set(ids)), "hypotheses", len(ids), "one or more, with different ids")
    probabilities = [hypothesis.probability for hypothesis in message.hypotheses]
    for probability in (*probabilities, message.unexamined, sum(probabilities)):
        is_one = -_TOLERANCE <= probability <= 1.0 + _TOLERANCE
        _require(is_one, "probability", probability, "between 0 and 1, as their sum")
    for weighed in message.statements:
        check_statement(weighed.statement)
        _require(0.0 <= weighed.probability <= 1.0, "probability", weighed.probability, "between 0 and 1")
        for keyframe in (weighed.first_keyframe, weighed.second_keyframe):
            _require(keyframe != NO_KEYFRAME, "keyframe", keyframe, "a keyframe")


def _check_looks(message: Ambiguity) -> None:
    for number, look in enumerate(message.looks):
        _require(NOT_DRIVEN <= look.previous < number, "previous", look.previous, "the number of an earlier look")
        _require(look.path_length >= 0.0, "path_length", look.path_length, "0 or more")


def _check_request_number(name: str, number: int) -> None:
    _require(0 <= number <= time.time_ns() + MAX_RESET_AHEAD, name, number, "the time of a request on slam's clock, ns")


def _check_response(response: SaveResponse | ResetResponse) -> None:
    _require(response.process in participant_names(), "process", response.process, "a process that takes part")
    if isinstance(response, SaveResponse):
        names = {f"{response.process}.json", f"{response.process}.bin"}
        for file in response.files:
            _require(file.name in names and file.size >= 0, "file", file.name, "a file of that process")


def _check_team_message(message: TeamMessage | JoinedGround) -> None:
    """Check the names, and what an update or a placement holds."""
    for name in ("robot", "session", "owner", "first", "second", "other", "digest"):
        _check_team_name(name, getattr(message, name, "-"))
    if isinstance(message, TeamUpdate):
        for item in message.items:
            _require(message.after < item.version <= message.until, "version", item.version, "one of the update")
        for rate in message.clutter:
            _require(0.0 <= rate <= 1.0, "clutter", rate, "between 0 and 1")
    if isinstance(message, TeamStatus):
        (ratio, persistence), most = message.repetition, MAX_LOG_REPETITION
        _require(abs(ratio) <= most, "repetition", ratio, f"within {most:g}")
        _require(0.0 < persistence <= 1.0, "repetition", persistence, "above 0 and at most 1")
    elif isinstance(message, TeamUpdate | JoinedGround):
        _check_items(message.scans, message.areas)
    elif isinstance(message, TeamRendezvous):
        _require(message.other != message.robot, "other", message.other, "another robot")
    elif isinstance(message, TeamPlacement):
        _require(message.first < message.second, "second", message.second, f"a name after {message.first}")
        _require(message.robot in (message.first, message.second), "robot", message.robot, "a robot of the pair")
        for probability in (message.probability, message.apart):
            _require(0.0 <= probability <= 1.0, "probability", probability, "between 0 and 1")


def _check_goal(goal: TeamGoal) -> None:
    _check_team_name("robot", goal.robot)
    _require(0.0 <= goal.remaining <= MAX_COORDINATE, "remaining", goal.remaining, "0 to 1e7 m")
    if goal.place is not None:
        _check_team_name("owner", goal.place.owner)


def _check_team_name(name: str, value: str) -> None:
    _require(bool(_TEAM_NAME.fullmatch(value)), name, value, "a name of 100 letters, digits and '_-.:+' at most")


def _check_items(scans: Iterable[SharedScan], areas: Iterable[SharedArea]) -> None:
    for scan in scans:
        _require(0 <= scan.keyframe < MAX_TEAM_KEYFRAMES, "keyframe", scan.keyframe, f"0 to {MAX_TEAM_KEYFRAMES}")
        check_scan(scan.scan)
    for area in areas:
        _require(len(area.poses) == len(set(area.keyframes)), "poses", len(area.poses), "one for each keyframe")
        for arc in area.arcs:
            _require(arc.source < arc.target == area.area, "source", arc.source, "an area before that of the arc")
        _require(area.area < MAX_TEAM_AREAS, "area", area.area, f"below {MAX_TEAM_AREAS}")
        for keyframe in area.keyframes:
            _require(0 <= keyframe < MAX_TEAM_KEYFRAMES, "keyframe", keyframe, f"0 to {MAX_TEAM_KEYFRAMES}")


def _require(holds: bool, name: str, value: object, wanted: str) -> None:
    if not holds:
        raise HmtSlamError(f"{name} = {str(value)[:80]} is not {wanted}: {_REMEDY}")
