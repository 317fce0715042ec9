"""Replay of a log by the nodes, each an OS process, with a recorder that fills an output folder."""

from __future__ import annotations

import os
import secrets
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Event

import numpy as np
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.configuration.documents import ros_yaml, yaml_value
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs import Log
from hmt_slam_ros.messages.team import TeamPlacement
from hmt_slam_ros.open_log import is_simulated, open_configured
from hmt_slam_ros.process_memory import ResourceUsage
from hmt_slam_ros.process_table import COORDINATOR, TEAM, consumer_count, process_names
from hmt_slam_ros.results.final_map import deskewed_scans, final_map
from hmt_slam_ros.results.output_folder import RunMetrics, atomic_output, write_output
from hmt_slam_ros.results.recorder import Recording
from hmt_slam_ros.ros.execution import wait_until_alone
from hmt_slam_ros.ros.node_processes import NodeProcesses, own_domain
from hmt_slam_ros.ros.recorder_node import RecorderNode
from hmt_slam_ros.ros.topics import SCAN, TFMessage
from hmt_slam_ros.sensors import Scan

STALL_TIMEOUT = 180.0
"""Time without any message after which a run is given up, s; a first run may compile kernels that long."""
_FAULT_TIMEOUT = 5.0
"""Time without any message after which a run with a fault is given up, s; a stranger may report faults, too."""
_DISCOVERY_TIMEOUT = 60.0
"""Time in which the nodes must find each other, s."""
_DIAGNOSTICS_TIMEOUT = 3.0
"""Time to wait for the last diagnostics, which come once a second, s."""
_SHUTDOWN_TIMEOUT = 2.0
"""Time to wait for the end of the nodes, s."""
_SPIN = 0.05  # s
_DISCOVERY_RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"  # environment variable


@dataclass(frozen=True, eq=False)
class ReplayResult:
    """Result of a replay.

    :ivar recording: the map and the trajectories.
    :ivar wall_seconds: from the start of the nodes to their last message.
    """

    recording: Recording
    wall_seconds: float


def replay(
    log: Path,
    output: Path,
    configuration: Configuration,
    progress: Callable[[int], None] | None = None,
    stall_timeout: float = STALL_TIMEOUT,
    view_port: int | None = None,
) -> ReplayResult:
    """Replay a log by the nodes, in a domain of their own, and write the output folder.

    :param log: any log; ``configuration.robot`` has its part and the rate.
    :param output: the folder, which is written only where the run succeeds.
    :param progress: called with the number of processed scans.
    :param stall_timeout: time without any message after which the run is given up, s.
    :param view_port: port of the live page, None for no page.
    :raises HmtSlamError: for an unreadable log, a node that ends, or a run that stalls.
    """
    run = ReplayRun(log, configuration, progress, stall_timeout=stall_timeout, view_port=view_port)
    with atomic_output(output) as folder, own_domain() as domain:
        run.run(domain)
        return run.write(folder)


@dataclass(frozen=True, eq=False)
class _LogContents:
    """Contents of a log, from a pass that also shows whether it can be read.

    :ivar stamps: of the scans on the log's running clock, shape (n,), ns.
    :ivar source_stamps: of the scans in the log, shape (n,), ns.
    :ivar laser_poses: the distinct ``base_T_laser`` (3,).
    """

    stamps: NDArray[np.int64]
    source_stamps: NDArray[np.int64]
    laser_poses: list[list[float]]


def _read_contents(log: Log) -> _LogContents:
    stamps: list[tuple[int, int]] = []
    lasers: dict[bytes, list[float]] = {}
    for record in log.records():
        if isinstance(scan := record.measurement, Scan):
            stamps.append((scan.stamp, record.source_stamp))
            lasers.setdefault(scan.laser_pose.tobytes(), scan.laser_pose.tolist())
    running, source = np.array(stamps, dtype=np.int64).T
    return _LogContents(running, source, list(lasers.values()))


def _slam_arguments(laser_poses: list[list[float]]) -> list[str]:
    """Arguments of slam: the laser's pose, where tf2_msgs is not installed for /tf_static."""
    if TFMessage is not None:
        return []
    if len(laser_poses) > 1:
        raise HmtSlamError("the laser moves on the robot in this log, which only /tf_static can tell: install tf2_msgs")
    return ["-p", f"laser_pose:={laser_poses[0]}"]


@dataclass(frozen=True, eq=False)
class ReplayTeam:
    """What the runs of a team share.

    :ivar is_given_up: set where one of them failed.
    :ivar on_placement: called with each new answer of a robot for itself and another one.
    """

    is_given_up: Event
    on_placement: Callable[[TeamPlacement], None]


class ReplayRun:
    """One run of the nodes of a robot with the recorder.

    :ivar recorder_node: the recorder's node.
    :ivar usage: {node: resources}.
    :ivar wall_seconds: from the start of the nodes to their last message.
    """

    recorder_node: RecorderNode
    usage: dict[str, ResourceUsage]
    wall_seconds: float

    def __init__(
        self,
        log: Path,
        configuration: Configuration,
        progress: Callable[[int], None] | None = None,
        stall_timeout: float = STALL_TIMEOUT,
        view_port: int | None = None,
        robot: str = "",
        team: ReplayTeam | None = None,
    ) -> None:
        """Read the log.

        :param progress: called with the number of processed scans.
        :param stall_timeout: time without any message after which the run is given up, s.
        :param view_port: port of the live page, None for no page.
        :param robot: namespace of the nodes, and name of the robot in its team.
        :param team: the other robots; None for one alone.
        :raises HmtSlamError: for an unreadable log, or a configuration without an end.
        """
        if configuration.robot.drive == "commands":
            raise HmtSlamError("robot.drive = commands is for the robot node alone: set it to log for a replay")
        if configuration.robot.loop:
            raise HmtSlamError("robot.loop = true has no end to wait for: set it to false for a replay into a folder")
        self._opened = open_configured(log, configuration)
        self._log, self._contents = log, _read_contents(self._opened)
        self._configuration, self._progress = configuration, progress or (lambda _: None)
        self._stall_timeout, self._view_port = stall_timeout, view_port
        self._robot, self._team = robot, team
        self._nodes = process_names() if team is None else (*process_names(), TEAM.name)
        self._system = f"replay-{secrets.token_hex(8)}"

    def run(self, domain: int) -> None:
        """Start the nodes, record until the end, stop them.

        :param domain: id of the DDS domain.
        :raises HmtSlamError: where a node ends or the run stalls.
        """
        with (
            tempfile.TemporaryDirectory(prefix="hmt_slam_replay_") as scratch,
            self._recorder_executor(domain) as executor,
            NodeProcesses(Path(scratch), (*self._nodes, "view"), _print_notice) as children,
        ):
            begin = time.monotonic()
            self._start_nodes(children, domain, Path(scratch))
            self._record(executor, children)
            self.wall_seconds = time.monotonic() - begin
            self._await_diagnostics(executor)
            self.usage = {name: used for name, used in children.usage().items() if name != "view"}

    def write(self, folder: Path) -> ReplayResult:
        """Write the output folder of a run that has ended."""
        begin = time.process_time()
        recording = self.recorder_node.recorder.finish(self._contents.stamps)
        scans = partial(deskewed_scans, self._opened, self._configuration)
        final = final_map(recording, scans, self._configuration)
        refinement = time.process_time() - begin
        metrics = RunMetrics(
            log=self._opened.name,
            runtime="nodes",
            seconds_per_scan=self.recorder_node.seconds_per_scan(self._contents.stamps),
            peak_rss={name: usage.peak_rss for name, usage in self.usage.items()},
            pss={name: usage.pss for name, usage in self.usage.items()},
            wall_seconds=self.wall_seconds,
            cpu_seconds=sum(usage.cpu_seconds for usage in self.usage.values()) + refinement,
            refinement_seconds=refinement,
        )
        write_output(folder, final, self._contents.source_stamps, metrics, self._configuration)
        return ReplayResult(final.recording, self.wall_seconds)

    @contextmanager
    def _recorder_executor(self, domain: int) -> Iterator[SingleThreadedExecutor]:
        """Executor of the recorder's node, in a context of its own without signal handlers."""
        with local_discovery():
            context = Context()
            context.init(domain_id=domain)
        try:
            self.recorder_node = RecorderNode(self._configuration, context, self._system, self._robot)
            if self._team is not None:
                self.recorder_node.note_placements(self._robot, self._team.on_placement)
            executor = SingleThreadedExecutor(context=context)
            executor.add_node(self.recorder_node)
            try:
                yield executor
            finally:
                executor.shutdown()
                wait_until_alone(self.recorder_node, _SHUTDOWN_TIMEOUT)
                self.recorder_node.destroy_node()
        finally:
            context.try_shutdown()

    def _start_nodes(self, children: NodeProcesses, domain: int, scratch: Path) -> None:
        parameters = scratch / "parameters.yaml"
        parameters.write_text(ros_yaml(self._configuration), encoding="utf-8")
        environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), _DISCOVERY_RANGE: "LOCALHOST"}
        system = ["-p", f"system:={self._system}", *(["-r", f"__ns:=/{self._robot}"] if self._robot else [])]
        if self._view_port is not None:
            children.start("view", ["-p", f"port:={self._view_port}", *system], environment)
        shared = ["--params-file", str(parameters), *system]
        recovery = ["-p", f"recovery:={scratch / 'recovery'}"]
        # The robot node publishes the scans of all lasers on one topic, in their order in the log.
        one_topic = ["-p", f"sensors.scan_topics:={SCAN}"]
        own = {COORDINATOR: [*_slam_arguments(self._contents.laser_poses), *one_topic]}
        for name in self._nodes:
            children.start(name, shared + recovery + own.get(name, []), environment)
        values = {
            "log": yaml_value(str(self._log if is_simulated(self._log) else self._log.absolute())),
            "robot.odometry_listeners": consumer_count("Odometry"),
            "robot.discovery_timeout": _DISCOVERY_TIMEOUT,
        }
        settings = [word for name, value in values.items() for word in ("-p", f"{name}:={value}")]
        children.start("robot", [*shared, *settings], environment)

    def _record(self, executor: SingleThreadedExecutor, children: NodeProcesses) -> None:
        count, last = 0, time.monotonic()
        checked = last
        while not self.recorder_node.is_complete:
            executor.spin_once(timeout_sec=_SPIN)
            now = time.monotonic()
            if self.recorder_node.message_count > count:
                count, last = self.recorder_node.message_count, now
                self.recorder_node.fault = None
            if now - checked > _SPIN:
                checked = now
                self._progress(len(self.recorder_node.recorder.estimates))
                self._check_progress(children, now - last)
        self._progress(len(self.recorder_node.recorder.estimates))

    def _check_progress(self, children: NodeProcesses, silence: float) -> None:
        children.restart_killed()
        if self._team is not None and self._team.is_given_up.is_set():
            raise HmtSlamError(f"{self._robot} is given up, as another robot of the team was")
        if self.recorder_node.fault is not None and silence > _FAULT_TIMEOUT:
            raise HmtSlamError(self.recorder_node.fault)
        if silence > self._stall_timeout:
            name = self.recorder_node.awaited_node()
            raise HmtSlamError(
                f"nothing happened for {self._stall_timeout:g} s, the run waits for the node {name}, which last said: "
                f"{children.log_tail(name)}"
            )

    def _await_diagnostics(self, executor: SingleThreadedExecutor) -> None:
        """Wait for diagnostics of every process from now on, with the costs of its last messages."""
        begin, deadline = time.time_ns(), time.monotonic() + _DIAGNOSTICS_TIMEOUT
        while time.monotonic() < deadline and any(
            self.recorder_node.diagnostics_stamps.get(name, 0) < begin for name in self._nodes
        ):
            executor.spin_once(timeout_sec=_SPIN)


def _print_notice(sentence: str) -> None:
    print(sentence, file=sys.stderr, flush=True)


@contextmanager
def local_discovery() -> Iterator[None]:
    """Let contexts that are made inside discover only this computer."""
    before = os.environ.get(_DISCOVERY_RANGE)
    os.environ[_DISCOVERY_RANGE] = "LOCALHOST"
    try:
        yield
    finally:
        if before is None:
            del os.environ[_DISCOVERY_RANGE]
        else:
            os.environ[_DISCOVERY_RANGE] = before
