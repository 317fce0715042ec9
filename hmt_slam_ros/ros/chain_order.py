"""The order of the messages of keyframe events, over all topics.

DDS keeps the order within a topic, not across topics: Keyframe(k+1) may overtake ClosureDecision(k). Every process gets
Keyframe(k), AreaEvents(k), Hypotheses(k), ClosureDecision(k), Keyframe(k+1), ... as far as it subscribes to them. So
the nodes take the same decisions as the lock-step run, and a late node catches up.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.messages import (
    AreaEvents,
    ClosureDecision,
    Hypotheses,
    Keyframe,
)

ChainMessage = Keyframe | AreaEvents | Hypotheses | ClosureDecision

CHAIN: tuple[type, ...] = (Keyframe, AreaEvents, Hypotheses, ClosureDecision)
"""Messages of a keyframe event in their order."""


_MAX_CANDIDATES = 4
"""Messages of one kind and sequence number that are kept, in case the first one is refused."""
_GAP_MESSAGES = 3
"""Messages that follow each other beyond a gap, by which it is known for one."""


class ChainOrder:
    """The order of the chain over all topics, and gaps within a topic.

    DDS keeps the order within a topic. So a message that is ahead of the next one of its kind shows a loss, or is a
    stranger's; it is refused, as nothing could fill the gap. A message that is refused in its turn leaves its place to
    the next one of its sequence number.

    :ivar repeated_count: number of repeated messages, which are dropped.
    """

    def __init__(
        self,
        message_types: Iterable[type],
        first_event: int = 0,
        is_admitted: Callable[[ChainMessage], bool] = lambda _: True,
    ) -> None:
        """Start with a keyframe event.

        :param message_types: of the process; those outside the chain are ignored.
        :param first_event: number of the first keyframe event.
        :param is_admitted: whether a message whose turn it is may be delivered.
        """
        message_types = tuple(message_types)
        self._kinds = tuple(kind for kind in CHAIN if kind in message_types)
        self._waiting: dict[type, dict[int, list[ChainMessage]]] = {kind: {} for kind in self._kinds}
        self._next_sequences = dict.fromkeys(self._kinds, first_event)
        self._ahead: dict[type, list[int]] = {kind: [] for kind in self._kinds}
        self._delivered_count = first_event * len(self._kinds)
        self.repeated_count = 0
        self._is_admitted = is_admitted

    @property
    def fault(self) -> str | None:
        """Sentence about a gap, None without.

        Strangers are refused, and may be many; after a loss the next messages follow one on the other.
        """
        for kind, expected in self._next_sequences.items():
            ahead = self._ahead[kind]
            if len(ahead) == _GAP_MESSAGES and ahead[-1] - ahead[0] == _GAP_MESSAGES - 1:
                return (
                    f"{kind.__name__} {expected} never came, {ahead[0]} did: the node started too late "
                    "or lost messages, restart all nodes"
                )
        return None

    @property
    def waiting_count(self) -> int:
        """Number of messages that wait for their turn."""
        return sum(len(candidates) for queue in self._waiting.values() for candidates in queue.values())

    @property
    def events(self) -> int | None:
        """Number of complete keyframe events, None within one."""
        events, begun = divmod(self._delivered_count, len(self._kinds))
        return None if begun else events

    def push(self, message: ChainMessage) -> None:
        """Take a message.

        :raises HmtSlamError: where it is ahead of the next one of its kind.
        """
        kind, sequence = type(message), message.sequence
        expected, waiting = self._next_sequences[kind], self._waiting[kind]
        if sequence > expected:
            self._ahead[kind] = [*self._ahead[kind], sequence][-_GAP_MESSAGES:]
            raise HmtSlamError(
                f"{kind.__name__} {sequence} came before {expected}: the node started too late or lost messages, or a "
                "second system speaks in this ROS domain"
            )
        candidates = waiting.get(sequence, [])
        if sequence < expected:
            self.repeated_count += 1
        if sequence == expected or (candidates and len(candidates) < _MAX_CANDIDATES):
            waiting.setdefault(sequence, []).append(message)
        while self._next_sequences[kind] in waiting:
            self._next_sequences[kind] += 1
            self._ahead[kind] = []

    def pop_due(self) -> Iterator[ChainMessage]:
        """The messages whose turn it is, in order; each is admitted when the one before was handled."""
        while True:
            sequence, turn = divmod(self._delivered_count, len(self._kinds))
            kind = self._kinds[turn]
            candidates = self._waiting[kind].pop(sequence, [])
            message = next(filter(self._is_admitted, candidates), None)
            if message is None:
                if candidates:
                    self.reopen(kind, sequence)
                return
            self._delivered_count += 1
            yield message

    def reopen(self, kind: type, sequence: int) -> None:
        """Accept another message in the place of one that was refused."""
        self._next_sequences[kind] = sequence

    def withdraw(self, message: ChainMessage) -> None:
        """Take back the last message that was delivered."""
        self._delivered_count -= 1
        self.reopen(type(message), message.sequence)
