"""Scans of several topics in one order: that of their stamps."""

from __future__ import annotations

from bisect import insort
from collections.abc import Sequence
from dataclasses import replace

from hmt_slam_ros.sensors import Scan

_LONGEST_LAG = 500_000_000
"""Time by which a topic may be behind the newest scan, ns; one that is farther behind is not waited for."""

_STEP = 1_000
"""Time between the stamps of two scans that were taken at one time, ns, as in a log."""


class ScanMerge:
    """Passes the scans of several topics in the order of their stamps.

    A scan waits until every other topic has sent a scan of its time or later, unless that topic is silent. Those of a
    single topic pass at once.
    """

    def __init__(self, topics: Sequence[str], newest_stamp: int | None = None) -> None:
        """:param newest_stamp: stamp of the last scan before, ns, None without."""
        self._topics = {topic: number for number, topic in enumerate(topics)}
        self._newest: dict[str, int] = {}
        self._waiting: list[tuple[int, int, Scan]] = []
        # Stamps of the last scan that passed: its own, and that with which it did.
        self._last_source, self._last = newest_stamp, newest_stamp

    def reset(self) -> None:
        """Drop the scans that wait, and accept any stamp of the next ones."""
        self._newest, self._waiting = {}, []
        self._last_source = self._last = None

    @property
    def waiting_count(self) -> int:
        """Number of scans that wait for those of other topics."""
        return len(self._waiting)

    @property
    def silent_topics(self) -> list[str]:
        """The topics that are not waited for, since nothing came on them yet, or nothing for half a second."""
        newest = max(self._newest.values(), default=0)
        return [t for t in self._topics if (own := self._newest.get(t)) is None or newest - own > _LONGEST_LAG]

    def push(self, topic: str, scan: Scan) -> list[Scan] | None:
        """The scans that pass now, in order; None where this one came too late.

        :param scan: stamped after the last one of its topic, unless time went back.
        """
        if len(self._topics) == 1:
            self._newest[topic] = scan.stamp
            return [scan]
        due: list[Scan] = []
        if scan.stamp <= self._newest.get(topic, scan.stamp - 1):  # time went back
            due = [self._pass_on(waiting) for _, _, waiting in self._waiting]
            self.reset()
        if self._last_source is not None and scan.stamp < self._last_source:
            return None
        self._newest[topic] = scan.stamp
        insort(self._waiting, (scan.stamp, self._topics[topic], scan), key=lambda entry: entry[:2])
        while self._waiting and self._is_due(self._waiting[0][0]):
            due.append(self._pass_on(self._waiting.pop(0)[2]))
        return due

    def _is_due(self, stamp: int) -> bool:
        """Whether no topic that is not silent may still send an earlier scan."""
        silent = self.silent_topics
        return all(topic in silent or self._newest[topic] >= stamp for topic in self._topics)

    def _pass_on(self, scan: Scan) -> Scan:
        """A scan that passes; of two that were taken at one time, the stamp of the second is the next one."""
        self._last_source = scan.stamp
        self._last = scan.stamp if self._last is None else max(scan.stamp, self._last + _STEP)
        return scan if self._last == scan.stamp else replace(scan, stamp=self._last)
