"""Who hears what: the same for the lock-step run and for the nodes."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol, get_args

from hmt_slam_ros.messages.messages import Message
from hmt_slam_ros.process_table import COMPANIONS, PROCESSES, RECORDER, resolve_class


class Process(Protocol):
    """A value machine: no thread, clock, file or global random state inside."""

    def handle(self, message: Message) -> list[Message]:
        """Take in one message and return what there is to say."""


class Checkpointable(Process, Protocol):
    """A process whose memory is a value, from which another one can go on."""

    @property
    def state(self) -> object:
        """All that it knows between two messages, or between two keyframe events."""


_KINDS = {kind.__name__: kind for kind in get_args(Message)}


def message_types(names: Iterable[str]) -> tuple[type, ...]:
    """Classes of messages.

    :param names: of members of ``Message``, or "module:Class".
    """
    return tuple(resolve_class(name) if ":" in name else _KINDS[name] for name in names)


SUBSCRIPTIONS: dict[str, tuple[type, ...]] = {
    row.name: message_types(row.consumes) for row in (*PROCESSES, *COMPANIONS, RECORDER)
}
"""{process or node: classes of the messages that it receives}."""
