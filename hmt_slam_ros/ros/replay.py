"""A whole run of the robot node and the process nodes, each an OS process of its own, into an output folder."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict, deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO

import numpy as np
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.configuration.documents import ros_yaml, yaml_value
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs import Log
from hmt_slam_ros.open_log import is_simulated, open_log
from hmt_slam_ros.process_table import COORDINATOR, consumer_count, node_command, process_names
from hmt_slam_ros.results.final_map import deskewed_scans, final_map
from hmt_slam_ros.results.output_folder import RunMetrics, atomic_output, write_output
from hmt_slam_ros.results.recorder import Recording
from hmt_slam_ros.ros.diagnostics import peak_rss
from hmt_slam_ros.ros.domain import own_domain
from hmt_slam_ros.ros.execution import PARENT_VARIABLE, wait_until_alone
from hmt_slam_ros.ros.recorder_node import RecorderNode
from hmt_slam_ros.ros.transforms import TFMessage
from hmt_slam_ros.sensors import Scan

_STOP_TIMEOUT = 5.0  # s for a node to end when it is told to
# A node that is killed more often within a minute would be so for ever.
_RESTARTS, _RESTART_WINDOW = 3, 60.0
_TAIL = 3  # lines of a node's stderr that go into a message


@dataclass(frozen=True)
class ResourceUsage:
    """What an OS process used so far.

    :ivar peak_rss: largest resident memory, bytes.
    :ivar cpu_seconds: user and system time.
    """

    peak_rss: int
    cpu_seconds: float


class NodeProcesses:
    """Node processes; as a context, all of them are gone at its end.

    :ivar processes: {node: process}.
    """

    def __init__(self, folder: Path, restartable: Collection[str], notify: Callable[[str], None]) -> None:
        """Start nothing yet.

        :param folder: for what the nodes write to stderr.
        :param restartable: nodes that are started again where a signal killed them.
        :param notify: called with one sentence where that is done.
        """
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self._folder, self._restartable, self._notify = folder, restartable, notify
        self._start_arguments: dict[str, tuple[Sequence[str], Mapping[str, str]]] = {}
        self._restart_times: dict[str, deque[float]] = defaultdict(lambda: deque(maxlen=_RESTARTS))

    def start(self, name: str, arguments: Sequence[str], environment: Mapping[str, str]) -> None:
        """Start the node ``name`` with arguments for ROS."""
        self._start_arguments[name] = arguments, environment
        command = [sys.executable, *node_command(name), "--ros-args", *arguments]
        with self._open_log(name, "ab") as stderr:
            self.processes[name] = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=stderr,
                stderr=stderr,
                # A Ctrl-C in the terminal reaches this process alone, which then ends the nodes in good order.
                start_new_session=True,
                env={**environment, PARENT_VARIABLE: str(os.getpid())},
            )

    def _open_log(self, name: str, mode: str) -> IO[bytes]:
        return (self._folder / f"{name}.log").open(mode)

    def restart_killed(self) -> None:
        """See whether all are alive; start those again that were killed.

        :raises HmtSlamError: for one that ended by itself or is killed again and again, with what it said last.
        """
        for name, process in list(self.processes.items()):
            if (status := process.poll()) is None:
                continue
            if status >= 0 or name not in self._restartable:
                raise HmtSlamError(f"the node {name} ended with status {status}, it said: {self.log_tail(name)}")
            self._restart(name, -status)

    def _restart(self, name: str, number: int) -> None:
        now, before = time.monotonic(), self._restart_times[name]
        if len(before) == _RESTARTS and now - before[0] < _RESTART_WINDOW:
            raise HmtSlamError(
                f"the node {name} was killed by signal {number} for the {_RESTARTS + 1}th time within a minute and is "
                f"not started again, it said: {self.log_tail(name)}"
            )
        before.append(now)
        self._notify(f"the node {name} was killed by signal {number}: it is started again and goes on where it was")
        self.start(name, *self._start_arguments[name])

    def log_tail(self, name: str) -> str:
        """The last lines that a node wrote, as one."""
        with self._open_log(name, "rb") as stderr:
            lines = stderr.read().decode(errors="replace").strip().splitlines()
        return " | ".join(line.strip() for line in lines[-_TAIL:]) or "nothing"

    def usage(self) -> dict[str, ResourceUsage]:
        """What each node used so far."""
        return {
            name: ResourceUsage(peak_rss(process.pid), _cpu_seconds(process.pid))
            for name, process in self.processes.items()
        }

    def stop(self) -> None:
        """End all: by SIGINT, and by SIGKILL those that do not hear it."""
        alive = [process for process in self.processes.values() if process.poll() is None]
        for process in alive:
            process.send_signal(signal.SIGINT)
        deadline = time.monotonic() + _STOP_TIMEOUT
        for process in alive:
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def __enter__(self) -> NodeProcesses:
        """Nothing runs yet."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End all, whatever happened."""
        self.stop()


def _cpu_seconds(pid: int) -> float:
    """User and system time of an OS process; 0 where the system does not tell."""
    try:
        line = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return 0.0
    # Fields 14 and 15; the second, in parentheses, may hold spaces.
    ticks = line.rpartition(")")[2].split()[11:13]
    return sum(map(int, ticks)) / float(os.sysconf("SC_CLK_TCK"))


# On a slow computer the first run compiles for a while before anything is said.
STALL_TIMEOUT = 180.0  # s
_DISCOVERY_TIMEOUT = 60.0  # s
_SPIN = 0.05  # s
_DIAGNOSTICS_TIMEOUT = 3.0  # s
_SHUTDOWN_TIMEOUT = 2.0  # s


@dataclass(frozen=True, eq=False)
class ReplayResult:
    """What a replay came to.

    :ivar recording: the map and the trajectories.
    :ivar wall_seconds: from the start of the nodes to the last answer.
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
    """Run a log through the nodes, in a domain of their own, and write the output folder.

    :param log: any log; ``configuration.robot`` says which part, and how fast.
    :param output: the folder; nothing is left there unless all goes well.
    :param progress: called with the number of scans that are worked off.
    :param stall_timeout: seconds without any message after which the run is given up.
    :param view_port: port on which the live page is served, None for no page.
    :raises HmtSlamError: for a log that cannot be read, a node that dies, or a run that stands still.
    """
    if configuration.robot.drive == "commands":
        raise HmtSlamError("robot.drive = commands is for the robot node alone: set it to log for a replay")
    if configuration.robot.loop:
        raise HmtSlamError("robot.loop = true has no end to wait for: set it to false for a replay into a folder")
    opened = open_log(log, start=configuration.robot.start, duration=configuration.robot.duration or None)
    if not opened.scan_count:
        raise HmtSlamError(f"{log} has no scans in the part asked for: check --start and --duration")
    contents = _read_contents(opened)
    with atomic_output(output) as folder:
        run = _ReplayRun(configuration, progress or (lambda _: None), stall_timeout, view_port)
        run.run(log, _slam_arguments(contents.laser_poses))
        begin = time.process_time()
        recording = run.recorder_node.recorder.finish(contents.stamps)
        final = final_map(recording, deskewed_scans(opened, configuration), configuration)
        refinement = time.process_time() - begin
        figures = RunMetrics(
            log=opened.name,
            runtime="nodes",
            seconds_per_scan=run.recorder_node.seconds_per_scan(contents.stamps),
            peak_rss={name: usage.peak_rss for name, usage in run.usage.items()},
            wall_seconds=run.wall_seconds,
            cpu_seconds=sum(usage.cpu_seconds for usage in run.usage.values()) + refinement,
            refinement_seconds=refinement,
        )
        write_output(folder, final, contents.source_stamps, figures, configuration)
    return ReplayResult(final.recording, run.wall_seconds)


@dataclass(frozen=True, eq=False)
class _LogContents:
    """What has to be known of a log beforehand; finding it out also shows whether the log is whole.

    :ivar stamps: shape (n,), of every scan on the log's running clock, ns.
    :ivar source_stamps: shape (n,), the log's own stamps of them, ns.
    :ivar laser_poses: the different ``base_T_laser`` (3,).
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
    """Where there is no tf2_msgs to say it on /tf_static, a parameter tells slam where the laser is."""
    if TFMessage is not None:
        return []
    if len(laser_poses) > 1:
        raise HmtSlamError("the laser moves on the robot in this log, which only /tf_static can tell: install tf2_msgs")
    return ["-p", f"laser_pose:={laser_poses[0]}"]


class _ReplayRun:
    """One run of the nodes, and the recorder that listens.

    :ivar recorder_node: the recorder's node.
    :ivar usage: {node: what it used}.
    :ivar wall_seconds: from the start of the nodes to the last answer.
    """

    recorder_node: RecorderNode
    usage: dict[str, ResourceUsage]
    wall_seconds: float

    def __init__(
        self, configuration: Configuration, progress: Callable[[int], None], stall_timeout: float, view_port: int | None
    ) -> None:
        self._configuration, self._progress, self._stall_timeout, self._view_port = (
            configuration,
            progress,
            stall_timeout,
            view_port,
        )

    def run(self, log: Path, slam_settings: list[str]) -> None:
        """Start the nodes, listen until the end, stop them.

        :param slam_settings: arguments for the node slam.
        :raises HmtSlamError: where a node dies or nothing happens any more.
        """
        with (
            tempfile.TemporaryDirectory(prefix="hmt_slam_replay_") as scratch,
            own_domain() as domain,
            self._recorder_executor(domain) as executor,
            NodeProcesses(Path(scratch), (*process_names(), "view"), _print_notice) as children,
        ):
            begin = time.monotonic()
            self._start_nodes(children, log, slam_settings, domain, Path(scratch))
            self._record(executor, children)
            self.wall_seconds = time.monotonic() - begin
            self._await_diagnostics(executor)
            self.usage = {name: used for name, used in children.usage().items() if name != "view"}

    @contextmanager
    def _recorder_executor(self, domain: int) -> Iterator[SingleThreadedExecutor]:
        """The recorder's node, in a context of its own: the signals stay with whoever called."""
        with _local_discovery():
            context = Context()
            context.init(domain_id=domain)
        try:
            self.recorder_node = RecorderNode(self._configuration, context)
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

    def _start_nodes(
        self, children: NodeProcesses, log: Path, slam_settings: list[str], domain: int, scratch: Path
    ) -> None:
        parameters = scratch / "parameters.yaml"
        parameters.write_text(ros_yaml(self._configuration), encoding="utf-8")
        environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        if self._view_port is not None:
            children.start("view", ["-p", f"port:={self._view_port}"], environment)
        shared = ["--params-file", str(parameters)]
        recovery = ["-p", f"recovery:={scratch / 'recovery'}"]
        for name in process_names():
            children.start(name, shared + recovery + (slam_settings if name == COORDINATOR else []), environment)
        own = {
            "log": yaml_value(str(log if is_simulated(log) else log.absolute())),
            "robot.odometry_listeners": consumer_count("Odometry"),
            "robot.discovery_timeout": _DISCOVERY_TIMEOUT,
        }
        settings = [word for name, value in own.items() for word in ("-p", f"{name}:={value}")]
        children.start("robot", [*shared, *settings], environment)

    def _record(self, executor: SingleThreadedExecutor, children: NodeProcesses) -> None:
        heard, last = 0, time.monotonic()
        checked = last
        while not self.recorder_node.is_complete:
            executor.spin_once(timeout_sec=_SPIN)
            now = time.monotonic()
            if self.recorder_node.message_count > heard:
                heard, last = self.recorder_node.message_count, now
            if now - checked > _SPIN:
                checked = now
                self._progress(len(self.recorder_node.recorder.estimates))
                self._check_progress(children, now - last)
        self._progress(len(self.recorder_node.recorder.estimates))

    def _check_progress(self, children: NodeProcesses, silence: float) -> None:
        children.restart_killed()
        if self.recorder_node.fault is not None:
            raise HmtSlamError(self.recorder_node.fault)
        if silence > self._stall_timeout:
            name = self.recorder_node.awaited_node()
            raise HmtSlamError(
                f"nothing happened for {self._stall_timeout:g} s, the run waits for the node {name}, which last said: "
                f"{children.log_tail(name)}"
            )

    def _await_diagnostics(self, executor: SingleThreadedExecutor) -> None:
        """Hear once more from every process what it cost, which each tells every second."""
        asked, deadline = time.time_ns(), time.monotonic() + _DIAGNOSTICS_TIMEOUT
        while time.monotonic() < deadline and any(
            self.recorder_node.diagnostics_stamps.get(name, 0) < asked for name in process_names()
        ):
            executor.spin_once(timeout_sec=_SPIN)


def _print_notice(sentence: str) -> None:
    print(sentence, file=sys.stderr, flush=True)


@contextmanager
def _local_discovery() -> Iterator[None]:
    """Nodes made inside find only those on this computer."""
    name = "ROS_AUTOMATIC_DISCOVERY_RANGE"
    before = os.environ.get(name)
    os.environ[name] = "LOCALHOST"
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before
