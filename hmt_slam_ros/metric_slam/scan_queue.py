"""Scans that wait for odometry, or for the answer to a keyframe event; what is wrong with them is said once."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace

from hmt_slam_ros.messages.messages import Message, Notice
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.sensors.odometry import OdometryBuffer, SweepCheck, SweepState

# Odometry that has come before may only be late, by more scans than a paced robot runs ahead of its acknowledgements.
_LATE = 4


@dataclass(frozen=True, eq=False)
class ScanQueueState:
    """The queue between two messages.

    :ivar scans: those that wait.
    :ivar last_stamp: of the last scan received, ns, -1 before the first.
    :ivar sweeps: what is known of the times between scans.
    :ivar reported_faults: the faults of which something was said.
    :ivar waits_for_odometry: whether scans wait for odometry.
    """

    scans: tuple[Scan, ...] = ()
    last_stamp: int = -1
    sweeps: SweepState = field(default_factory=SweepState)
    reported_faults: frozenset[str] = frozenset()
    waits_for_odometry: bool = True


class ScanQueue:
    """The queue of metric SLAM."""

    def __init__(self, max_waiting: int, odometry: OdometryBuffer, state: ScanQueueState) -> None:
        """:param max_waiting: scans that may wait for the first odometry.

        :param odometry: what the scans wait for.
        :param state: to go on from.
        """
        self._max_waiting = max_waiting
        self._odometry = odometry
        self._scans = deque(state.scans)
        self._sweeps = SweepCheck(state.sweeps)
        # All but the scans and what their times tell, which are beside it.
        self._state = replace(state, scans=(), sweeps=SweepState())

    def __len__(self) -> int:
        return len(self._scans)

    @property
    def state(self) -> ScanQueueState:
        """All that the queue knows."""
        return replace(self._state, scans=tuple(self._scans), sweeps=self._sweeps.state)

    def empty_copy(self, odometry: OdometryBuffer) -> ScanQueue:
        """A queue for scans of any other time, of whose faults nothing is said twice.

        :param odometry: what these wait for.
        """
        return ScanQueue(self._max_waiting, odometry, ScanQueueState(reported_faults=self._state.reported_faults))

    def add_odometry(self, odometry: Odometry) -> None:
        """Take in a reading."""
        self._odometry.add(odometry)
        if not self._state.waits_for_odometry:
            self._state = replace(self._state, waits_for_odometry=True)

    def add_scan(self, scan: Scan) -> list[Message]:
        """Take in a scan; say, once for each fault, what is wrong with it."""
        said: list[Message] = []
        scan, fault = self._sweeps.check(scan)
        if fault is not None:
            said += self._notice("sweep", fault)
        if scan.stamp <= self._state.last_stamp:
            said += self._notice(
                "order",
                f"A scan is stamped {scan.stamp / 1e9:.6f} s, not after its predecessor "
                f"({self._state.last_stamp / 1e9:.6f} s); scans are taken in the order of their arrival: check the "
                "clocks or the order of the log.",
            )
        if not scan.valid.any():
            said += self._notice(
                "empty",
                f"The scan at {scan.stamp / 1e9:.6f} s has no return between {scan.range_min:g} and {scan.range_max:g} "
                "m; such scans are placed by odometry alone: check the laser and its range limits.",
            )
        self._scans.append(scan)
        self._state = replace(self._state, last_stamp=scan.stamp)
        return said + self._stop_waiting()

    def is_ready(self, *, ended: bool) -> bool:
        """Whether the next scan can be taken: its odometry is known, or not waited for.

        :param ended: whether no more odometry will come.
        """
        return bool(self._scans) and (
            ended or not self._state.waits_for_odometry or self._odometry.covers(self._scans[0].end_stamp)
        )

    def pop(self) -> Scan:
        """The next scan."""
        return self._scans.popleft()

    def _stop_waiting(self) -> list[Message]:
        """Where enough scans wait for odometry, go on without until there is more."""
        first = self._scans[0]
        patience = self._max_waiting * (1 if self._odometry.is_empty else _LATE)
        waited = len(self._scans) > patience
        if not waited or not self._state.waits_for_odometry or self._odometry.covers(first.end_stamp):
            return []
        self._state = replace(self._state, waits_for_odometry=False)
        return self._notice(
            "odometry",
            f"{len(self._scans)} scans wait for odometry at {first.stamp / 1e9:.6f} s and are matched without from "
            "here on, until there is a reading: check the odometry topic and its stamps.",
        )

    def _notice(self, fault: str, text: str) -> list[Message]:
        if fault in self._state.reported_faults:
            return []
        self._state = replace(self._state, reported_faults=self._state.reported_faults | {fault})
        return [Notice("slam", text)]
