"""Commands of people through the live page: who may give them, what they are, and those that wait for the node."""

from __future__ import annotations

import hmac
import secrets
import threading
from collections import deque
from dataclasses import dataclass
from email.message import Message
from typing import Any, Literal, get_args

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.statements import parse_statement
from hmt_slam_ros.sensors.plausibility import MAX_COORDINATE
from hmt_slam_ros.untrusted_input import parse_json, shorten

CommandKind = Literal["save", "pause", "resume", "initial_pose", "goal", "statement"]

TOKEN_HEADER = "X-Hmt-Token"  # noqa: S105  the name of the header, no secret
"""Header of a request that has the token."""

MAX_COMMAND = 1000
"""Bytes of a command."""

_MAX_WAITING = 8
"""Commands that wait; the node takes them five times a second."""

_WITH_POSE = ("initial_pose", "goal")


@dataclass(frozen=True)
class PageCommand:
    """What a person wants.

    :ivar kind: "save" the map, "pause" or "resume" the run, give the "initial_pose" of the robot, send it to a "goal",
        or make a "statement" about two areas.
    :ivar pose: x, y, m, and heading, rad, in the map, of a pose or goal, else None.
    :ivar statement: the text of a statement, else empty.
    """

    kind: CommandKind
    pose: tuple[float, float, float] | None = None
    statement: str = ""


def parse_command(text: str) -> PageCommand:
    """The command of a JSON text.

    :raises HmtSlamError: where it is none; names the value and the remedy.
    """
    content = parse_json(text, "a command")
    kind: Any = content.get("kind") if isinstance(content, dict) else None
    kinds = get_args(CommandKind)
    if not isinstance(content, dict) or kind not in kinds:
        raise HmtSlamError(f"kind = {shorten(kind)} is no command: give one of {', '.join(kinds)}")
    if kind == "statement":
        statement = str(content.get("statement"))
        parse_statement(statement)
        return PageCommand(kind, statement=statement)
    if kind not in _WITH_POSE:
        return PageCommand(kind)
    pose = content.get("pose")
    if not isinstance(pose, list) or len(pose) != 3 or not all(_is_coordinate(value) for value in pose):
        raise HmtSlamError(f"pose = {shorten(pose)} is none: give x and y in m and the heading in rad, in the map")
    x, y, theta = map(float, pose)
    return PageCommand(kind, (x, y, theta))


def _is_coordinate(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= MAX_COORDINATE


class Commands:
    """Commands that browsers gave and the node has not taken yet. Thread-safe.

    :ivar is_allowed: whether the page may give commands.
    :ivar token: what each command has to come with, empty where none is allowed.
    """

    def __init__(self, *, is_allowed: bool = False) -> None:
        self.is_allowed = is_allowed
        self.token = secrets.token_urlsafe(16) if is_allowed else ""
        self._lock = threading.Lock()
        self._waiting: deque[PageCommand] = deque()

    def objection(self, headers: Message) -> str:
        """Why a request may give no command, in a sentence; empty where it may."""
        if not self.is_allowed:
            return "this page only shows: start view with -p controls:=true for buttons"
        if headers.get("Origin") is None:
            return "a command comes from the page itself: the request has no Origin"
        if not hmac.compare_digest(headers.get(TOKEN_HEADER, "").encode(), self.token.encode()):
            return "the token is missing or wrong: open the page by the address that view logged"
        return ""

    def put(self, command: PageCommand) -> None:
        """Let a command wait for the node.

        :raises HmtSlamError: where too many wait.
        """
        with self._lock:
            if len(self._waiting) >= _MAX_WAITING:
                raise HmtSlamError(f"{_MAX_WAITING} commands wait already: try again in a second")
            self._waiting.append(command)

    def take(self) -> list[PageCommand]:
        """The commands that wait, which wait no longer."""
        with self._lock:
            taken = list(self._waiting)
            self._waiting.clear()
            return taken
