"""The order in which a process hears the chain, whatever the order in which DDS delivers its topics.

DDS keeps the order within a topic, not across topics: Keyframe(k+1) may overtake Accepted(k). Every process gets
Keyframe(k), AreaEvents(k), Hypotheses(k), Accepted(k), Keyframe(k+1), ... as far as it listens to them, so that a run
of the nodes takes the same decisions as the lock-step run, and a node that starts late catches up.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from hmt_slam_ros.processes.messages import Accepted, AreaEvents, Hypotheses, Keyframe

ChainMessage = Keyframe | AreaEvents | Hypotheses | Accepted

CHAIN: tuple[type, ...] = (Keyframe, AreaEvents, Hypotheses, Accepted)


class ChainOrder:
    """Holds messages back until their turn; notices repetitions and gaps.

    :ivar repeated: messages that came a second time and were put aside.
    :ivar fault: one sentence about the first gap, None where nothing is missing.
    """

    def __init__(self, heard: Iterable[type], first: int = 0) -> None:
        """Take the message types that the process listens to; those outside the chain are ignored.

        :param first: keyframe event with which the chain begins.
        """
        heard = tuple(heard)
        self._kinds = tuple(kind for kind in CHAIN if kind in heard)
        self._waiting: dict[type, deque[ChainMessage]] = {kind: deque() for kind in self._kinds}
        self._arrived = dict.fromkeys(self._kinds, first)
        self._delivered = first * len(self._kinds)
        self.repeated = 0
        self.fault: str | None = None

    @property
    def waiting(self) -> int:
        """Messages held back."""
        return sum(len(queue) for queue in self._waiting.values())

    @property
    def events(self) -> int | None:
        """Keyframe events that were delivered to the end, None amid one."""
        events, begun = divmod(self._delivered, len(self._kinds))
        return None if begun else events

    def arrive(self, message: ChainMessage) -> list[ChainMessage]:
        """Take in a message; return those whose turn has come, in their order."""
        kind, sequence = type(message), message.sequence
        if sequence < self._arrived[kind]:
            self.repeated += 1
            return []
        if sequence > self._arrived[kind] and self.fault is None:
            self.fault = (
                f"{kind.__name__} {self._arrived[kind]} never came, {sequence} did: the node started too late or lost "
                "messages, restart all nodes"
            )
        self._arrived[kind] = sequence + 1
        self._waiting[kind].append(message)
        return list(self._due())

    def _due(self) -> Iterable[ChainMessage]:
        while True:
            sequence, turn = divmod(self._delivered, len(self._kinds))
            queue = self._waiting[self._kinds[turn]]
            if not queue or queue[0].sequence != sequence:
                return
            self._delivered += 1
            yield queue.popleft()
