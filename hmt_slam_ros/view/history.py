"""The probabilities of the live hypotheses, one keyframe event after the other."""

from __future__ import annotations

from typing import Any

from hmt_slam_ros.processes.documents import KeyframeHead
from hmt_slam_ros.processes.messages import Hypotheses
from hmt_slam_ros.view.board import HISTORY, Board

_SECOND = 1e9
# Of an event; what is left out has the smallest probabilities, and is shown with what was not examined.
_MOST_BARS = 12


class History:
    """Joins keyframes, which know the time, with the answers to them; the two come on topics of their own."""

    def __init__(self, board: Board) -> None:
        self._board = board
        self._heads: dict[int, KeyframeHead] = {}
        self._answers: dict[int, Hypotheses] = {}
        self._told: dict[int, int] = {}

    def hear(self, message: KeyframeHead | Hypotheses) -> None:
        """Take in one of the two."""
        kept: dict[int, Any] = self._heads if isinstance(message, KeyframeHead) else self._answers
        kept[message.sequence] = message
        while len(kept) > HISTORY:
            del kept[min(kept)]

    def tell(self) -> None:
        """Put what is complete on the board.

        What a node that was started again repeats is passed over; an event that was there before, but at another time,
        begins a new run.
        """
        for sequence in sorted(self._heads.keys() & self._answers.keys()):
            head, answer = self._heads.pop(sequence), self._answers.pop(sequence)
            if self._told.get(sequence) == head.scan.stamp:
                continue
            if self._told and sequence <= max(self._told):
                self._told = {}
                self._board.forget_history()
            self._told[sequence] = head.scan.stamp
            while len(self._told) > HISTORY:
                del self._told[min(self._told)]
            self._board.append(_event(head, answer))


def _event(head: KeyframeHead, answer: Hypotheses) -> dict[str, Any]:
    """Time (s), way (m), and (hypothesis, area, probability, whether it is lost), the most probable first."""
    leaves = sorted(answer.leaves, key=lambda leaf: (-leaf.probability, leaf.hypothesis))[:_MOST_BARS]
    return {
        "event": head.sequence,
        "time": round(head.scan.stamp / _SECOND, 3),
        "way": round(head.travelled, 2),
        "leaves": [[leaf.hypothesis, leaf.area, round(leaf.probability, 5), leaf.lost] for leaf in leaves],
        "live": len(answer.leaves),
    }
