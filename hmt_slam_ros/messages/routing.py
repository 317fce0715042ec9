"""The interface of processes and their subscriptions, the same for both runtimes."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol, get_args

from hmt_slam_ros.messages.messages import Message
from hmt_slam_ros.process_table import RECORDER, node_rows, resolve_class


class Process(Protocol):
    """A value machine, without threads, clocks, files and global random state."""

    def handle(self, message: Message) -> list[Message]:
        """Process a message and return the messages that answer it."""


class Checkpointable(Process, Protocol):
    """A process whose state is a value, from which another process can continue."""

    @property
    def state(self) -> object:
        """The whole state between two messages, or between two keyframe events."""


_KINDS = {kind.__name__: kind for kind in get_args(Message)}


def message_types(names: Iterable[str]) -> tuple[type, ...]:
    """The message classes of some names.

    :param names: names of members of ``Message``, or "module:Class".
    """
    return tuple(resolve_class(name) if ":" in name else _KINDS[name] for name in names)


SUBSCRIPTIONS: dict[str, tuple[type, ...]] = {row.name: message_types(row.consumes) for row in (*node_rows(), RECORDER)}
"""{process or node: classes of the messages that it receives}."""
