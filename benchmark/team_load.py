"""Load of the process team where four robots drive on in large maps: share of a core, and memory of foreign ground."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from benchmark.lattice import ARC, FIRST_KEYFRAME, OFFSETS, PER_AREA, SPACING, Lattice, LatticeScans, pose_in_crossing
from benchmark.report import Requirement, table
from benchmark.scale_maps import BEAMS, make_scan, measure_memory
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.documents import decode, encode
from hmt_slam_ros.messages.map_changes import Arc
from hmt_slam_ros.messages.messages import ClosureDecision, HypothesisEstimate, Keyframe, Message
from hmt_slam_ros.messages.replica import FIRST_HYPOTHESIS, Replica
from hmt_slam_ros.registration.consistency import NO_CLUTTER
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.team.team import Team, TeamState

ROBOTS = 4

LATTICES = (Lattice(5, 5), Lattice(10, 10), Lattice(25, 10))
"""The map of each robot: the last ones are a thousand areas together."""

SHARE = 0.2
"""Largest computing time of the process of a robot, as a share of its time."""

FOREIGN = 1.1
"""Largest memory of an area of another robot, as a share of that of an area of its own."""

_EVENTS = 120
"""Keyframe events of each robot, one a second: it drives at 0.5 m/s."""

_FEW = Lattice(2, 2)
"""The map of the robot that receives that of the other one."""

_WEIGHED = Lattice(10, 10)

POLICY = (
    "Each of four robots has such a lattice, and drives on for "
    f"{_EVENTS} s with a keyframe event a second, in lock-step with the others. *Load* is CPU time of its process team "
    "by this time, of all four on average; *event* that of its longest one. Memory is what Python allocates for the "
    f"map, with scans of {BEAMS} beams: own ground as it is mapped and as it is shared, foreign ground as it arrives."
)


class TeamLoad(NamedTuple):
    """The load of a robot's process.

    :ivar areas: of the maps of all robots.
    :ivar share: CPU time, as a share of the time in which it drove.
    :ivar longest: CPU time of its longest event, s.
    """

    areas: int
    share: float
    longest: float


class TeamMemory(NamedTuple):
    """Memory in the process team, kB.

    :ivar own: of an area of the robot's own.
    :ivar foreign: of an area of another robot.
    """

    own: float
    foreign: float


class _Driver:
    """A robot in a lattice with its process, which drives on from the last crossing along new ones."""

    def __init__(self, name: str, lattice: Lattice, configuration: Configuration, make: Callable[[int], Scan]) -> None:
        """:param make: makes the scan of a keyframe."""
        hybrid_map = lattice.hybrid_map()
        scans = {k: make(k) for area in hybrid_map.area_ids() for k in hybrid_map.keyframes(area)}
        maps, probabilities, areas = {FIRST_HYPOTHESIS: hybrid_map}, {FIRST_HYPOTHESIS: 1.0}, {FIRST_HYPOTHESIS: 0}
        state = TeamState(name, "benchmark", Replica(scans, maps, probabilities, areas).state)
        self.team, self._areas = Team(configuration, state), lattice.areas
        self.seconds: list[float] = []
        self.team.handle(ClosureDecision(0, FIRST_HYPOTHESIS))

    def drive_on(self, event: int) -> list[Message]:
        """Handle the next keyframe event, and return what the others get."""
        along, number = divmod(event, PER_AREA)
        area, keyframe = self._areas + along, FIRST_KEYFRAME + PER_AREA * self._areas + event
        quarter, offset = divmod(number, len(OFFSETS))
        pose = pose_in_crossing(OFFSETS[offset], quarter)
        estimate = HypothesisEstimate(
            FIRST_HYPOTHESIS, area, PoseGaussian.from_pose(pose), True, 0.0, 0.0, NO_CLUTTER, 100.0
        )
        scan = replace(LatticeScans()[keyframe], stamp=(event + 1) * NANOSECONDS)
        step = PoseGaussian(np.array([SPACING, 0.0, 0.0]), ARC.copy())
        arcs = (Arc(area - 1, area, step),) if number == 0 else ()
        self.receive(Keyframe(keyframe, scan, float(event), (estimate,)))
        return self.receive(ClosureDecision(keyframe, FIRST_HYPOTHESIS, arcs))

    def receive(self, message: Message) -> list[Message]:
        """Handle a message, and count its CPU time as part of the last event's."""
        begin = time.process_time()
        sent = self.team.handle(message)
        self.seconds[-1] += time.process_time() - begin
        return sent


def measure_load(lattice: Lattice, configuration: Configuration, events: int = _EVENTS) -> TeamLoad:
    """The load where each robot has the same lattice, and drives on.

    :param events: number of keyframe events of each.
    """
    drivers = [_Driver(f"robot {n}", lattice, configuration, LatticeScans().__getitem__) for n in range(1, ROBOTS + 1)]
    for driver in drivers:
        for other in drivers:
            if other is not driver:
                _send_map(driver.team, other.team)
    for event in range(events):
        for driver in drivers:
            driver.seconds.append(0.0)
        for driver in drivers:
            _send_to_all(drivers, driver, driver.drive_on(event))
    seconds = np.array([driver.seconds for driver in drivers])
    return TeamLoad(ROBOTS * lattice.areas, float(seconds.mean()), float(seconds.max()))


def weigh_ground(configuration: Configuration, lattice: Lattice = _WEIGHED) -> TeamMemory:
    """The memory of own and of foreign ground, for each area of a lattice."""
    ann = _Driver("ann", _FEW, configuration, make_scan)
    own, bob = measure_memory(lambda: _Driver("bob", lattice, configuration, make_scan))
    foreign, _ = measure_memory(lambda: _send_map(bob.team, ann.team))
    return TeamMemory(own / lattice.areas, foreign / lattice.areas)


def _send_map(sender: Team, receiver: Team) -> None:
    """Send what a robot shares to another one, as documents."""
    requests = deque(receiver.handle(_copy(sender.status)))
    while requests:
        for update in sender.handle(requests.popleft()):
            requests += receiver.handle(_copy(update))


def _copy(message: Message) -> Message:
    return decode(encode(message), type(message))


def _send_to_all(drivers: Sequence[_Driver], sender: _Driver, messages: Sequence[Message]) -> None:
    """Deliver messages to all others, and what these answer."""
    waiting = deque((sender, message) for message in messages)
    while waiting:
        sender, message = waiting.popleft()
        for driver in drivers:
            if driver is not sender:
                waiting += [(driver, answer) for answer in driver.receive(message)]


def requirements(loads: Sequence[TeamLoad], memory: TeamMemory) -> list[Requirement]:
    """Requirements on maps of any size."""
    return [
        Requirement("load of a robot, most", max(load.share for load in loads), SHARE),
        Requirement("memory of a foreign area, of one's own", memory.foreign / memory.own, FOREIGN),
    ]


def load_table(loads: Sequence[TeamLoad], memory: TeamMemory) -> str:
    """A table with a line for each lattice, and the memory."""
    rows = [[f"{each.areas}", f"{100.0 * each.share:.1f} %", f"{each.longest:.2f} s"] for each in loads]
    text = table(["areas of four robots", "load", "event, longest"], rows)
    return f"{text}\n\nAn own area takes {memory.own:.1f} kB, a foreign one {memory.foreign:.1f} kB."
