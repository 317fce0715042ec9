"""Robots of a team on hosts of their own, between which a link loses, repeats and reorders frames, and breaks."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmark.logs import ROOT
from benchmark.lossy_link import FrameCounts, LinkFaults, LossyLink, linked_hosts
from benchmark.report import Report, Requirement, table
from benchmark.settings import Settings
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2

OFFICE, OTHER = "sim:office,size=0.7,seed=51", "sim:office,size=0.7,seed=50"
ROBOTS: Mapping[str, tuple[str, int]] = {"ann": (OFFICE, 0), "bob": (OFFICE, 1), "cid": (OTHER, 1)}
"""{robot: world, and which of two laps it drives}."""

FAULTS = LinkFaults(lost=0.3, repeated=0.05, late=0.1)
PARTITION = 600.0
"""Time for which one robot is alone, s."""

PROFILE = ROOT / "config" / "small_datagrams.xml"

_BEFORE, _DURING = 0.4, 0.8
"""Shares of the chain that are played until the partition, and until its end."""

_TIMEOUT = 600.0
"""Longest time until nothing changes any more, s."""

_CALM = 20.0
"""Time without a change after which an answer is the last one, s."""

POLICY = (
    "Three robots, each on a host of its own, a network namespace, with the node team as an OS process. The link is "
    "an Ethernet switch. Two robots drive in one office, one in another. Their chains were recorded in lock-step and "
    "are played, 50 messages a second. *Disturbed*: all along, 30 % of the frames are lost, 5 % come twice and 10 % up "
    f"to 0.2 s late; robot 2 is cut off for {PARTITION / 60.0:g} minutes, in which its node team is killed and started "
    "again, and in which half of the rest is played. Fast DDS sends datagrams of up to 1,400 bytes "
    "(config/small_datagrams.xml)."
)


@dataclass
class _HostedRobot:
    """A robot on its host.

    :ivar share: of the chain that is to be played.
    :ivar report: the newest.
    :ivar changed_at: time of the last change, s.
    """

    name: str
    process: subprocess.Popen[str]
    share: float = 0.0
    report: dict[str, Any] = field(default_factory=dict)
    changed_at: float = 0.0

    def command(self, words: str) -> None:
        """Give a command."""
        assert self.process.stdin is not None
        print(words, file=self.process.stdin, flush=True)

    def play(self, share: float) -> None:
        """Play the chain up to a share of it."""
        self.share = share
        self.command(f"play {share:g}")

    def read_reports(self) -> None:
        """Read what it prints until it ends."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            report = json.loads(line)
            if report != self.report:
                self.changed_at = time.monotonic()
            self.report = report


@dataclass(frozen=True)
class TeamOutcome:
    """What the robots had in the end.

    :ivar seconds: from the last message of the chain until nothing changed any more.
    :ivar missing: maps of others that a robot does not have whole.
    :ivar answers: {robot and other: verdict, probability, and pose, m, rad}.
    :ivar frames: of the link.
    :ivar sent: of the map, by each robot.
    """

    seconds: float
    missing: int
    answers: Mapping[str, tuple[str, float, Sequence[float]]]
    frames: FrameCounts
    sent: Mapping[str, str]


def measure_team_link(_settings: Settings) -> Report:
    """Run the team with a link without faults, and with one that has all of them."""
    clean = _run_team(disturbed=False)
    disturbed = _run_team(disturbed=True)
    report = Report("team_link", "A team of robots over a link that loses frames and breaks", seeds=(0,))
    report.requirements = requirements(clean, disturbed)
    report.body = [outcome_table({"undisturbed": clean, "disturbed": disturbed}), POLICY]
    return report


def _run_team(*, disturbed: bool) -> TeamOutcome:
    with ExitStack() as stack:
        link, hosts = stack.enter_context(linked_hosts(len(ROBOTS), seed=0))
        scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="hmt_slam_team_link_")))
        robots = []
        for name, before in zip(ROBOTS, hosts, strict=True):
            robots.append(_start_robot(name, before, scratch))
            stack.callback(robots[-1].process.wait)
            stack.callback(robots[-1].command, "end")
        if disturbed:
            link.faults = FAULTS
        for robot in robots:
            robot.command("start")
            robot.play(_BEFORE)
        _wait(robots, lambda: _is_played(robots))
        if disturbed:
            _part(link, robots)
        for robot in robots:
            robot.play(1.0)
        _wait(robots, lambda: _is_played(robots))
        begin = time.monotonic()
        _wait(robots, lambda: _missing(robots) == 0 and _is_calm(robots), _TIMEOUT, may_fail=True)
        return _outcome(link, robots, begin)


def _start_robot(name: str, before: Sequence[str], scratch: Path) -> _HostedRobot:
    world, lap = ROBOTS[name]
    process = subprocess.Popen(
        [*before, sys.executable, "-m", "benchmark.team_host", name, world, f"{lap}", str(scratch / name)],
        cwd=ROOT,
        env=os.environ | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "FASTRTPS_DEFAULT_PROFILES_FILE": str(PROFILE)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    robot = _HostedRobot(name, process)
    threading.Thread(target=robot.read_reports, daemon=True).start()
    return robot


def _part(link: LossyLink, robots: Sequence[_HostedRobot]) -> None:
    """Cut a robot off, kill its node and start it again, and let all drive on meanwhile."""
    begin = time.monotonic()
    link.cut_off = frozenset([1])
    robots[1].command("kill")
    for robot in robots:
        robot.play(_DURING)
    robots[1].command("start")
    _wait(robots, lambda: time.monotonic() - begin > PARTITION, PARTITION + _TIMEOUT)
    link.cut_off = frozenset()


def _wait(
    robots: Sequence[_HostedRobot], condition: Callable[[], bool], timeout: float = _TIMEOUT, *, may_fail: bool = False
) -> None:
    deadline = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > deadline:
            if may_fail:
                return
            reports = {robot.name: robot.report for robot in robots}
            raise HmtSlamError(f"the robots did not get on within {timeout:g} s, they are at {reports}")
        if any(robot.process.poll() is not None for robot in robots):
            raise HmtSlamError("a robot ended: see what it printed above")
        time.sleep(0.1)


def _is_played(robots: Sequence[_HostedRobot]) -> bool:
    return all(robot.report.get("share") == robot.share for robot in robots)


def _missing(robots: Sequence[_HostedRobot]) -> int:
    """Number of maps of others that a robot does not have whole."""
    return sum(
        not robot.report["maps"].get(f"map of {other.name}", "").startswith(f"version {version} of {version}, ")
        for other in robots
        for version in [other.report["version"]]
        for robot in robots
        if other is not robot
    )


def _is_calm(robots: Sequence[_HostedRobot]) -> bool:
    return time.monotonic() - max(robot.changed_at for robot in robots) > _CALM


def _outcome(link: LossyLink, robots: Sequence[_HostedRobot], begin: float) -> TeamOutcome:
    answers = {
        f"{robot.name}, {other}": (verdict, probability, pose)
        for robot in robots
        for other, (verdict, probability, *pose) in sorted(robot.report["placements"].items())
    }
    seconds = max(robot.changed_at for robot in robots) - begin
    sent = {robot.name: robot.report["sent"] for robot in robots}
    return TeamOutcome(max(seconds, 0.0), _missing(robots), answers, link.counts, sent)


def largest_difference(one: TeamOutcome, other: TeamOutcome) -> float:
    """Largest distance between two answers of a pair, m; a radian counts as a meter, another verdict as infinite."""
    if one.answers.keys() != other.answers.keys():
        return float("inf")
    largest = 0.0
    for pair, (verdict, _, pose) in one.answers.items():
        if other.answers[pair][0] != verdict:
            return float("inf")
        if verdict == "joined":
            largest = max(largest, float(np.abs(se2.between(np.array(pose), np.array(other.answers[pair][2]))).max()))
    return largest


def requirements(clean: TeamOutcome, disturbed: TeamOutcome) -> list[Requirement]:
    """Requirements on the robots after all faults."""
    return [
        Requirement("maps of others that are not whole, undisturbed", clean.missing, 0.0),
        Requirement("the same, disturbed", disturbed.missing, 0.0),
        Requirement("answers that differ, largest distance of joins", largest_difference(clean, disturbed), 0.01, "m"),
        Requirement("time after the last keyframe until all is known, disturbed", disturbed.seconds, 120.0, "s"),
    ]


def outcome_table(outcomes: Mapping[str, TeamOutcome]) -> str:
    """A table with a line for each run."""
    rows = [
        [
            name,
            f"{100.0 * own.frames.lost / max(1, own.frames.sent):.1f} % of {own.frames.sent}",
            f"{own.missing}",
            "; ".join(f"{pair}: {verdict} ({p:.3f})" for pair, (verdict, p, _) in own.answers.items()),
            ", ".join(own.sent.values()),
            f"{own.seconds:.0f} s",
        ]
        for name, own in outcomes.items()
    ]
    return table(["link", "frames lost", "maps not whole", "answers", "sent", "time until all is known"], rows)
