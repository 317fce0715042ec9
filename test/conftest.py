"""Fixtures for tests with real nodes over real DDS, each in a domain of its own."""

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress

import hypothesis
import preloaded
import pytest

from hmt_slam_ros.process_table import RUN_NODE, node_command

# The same examples at every run, however long one takes where the machine is busy.
hypothesis.settings.register_profile("repeatable", deadline=None, derandomize=True)
hypothesis.settings.load_profile("repeatable")

# Messages check the names and types of their fields, which they do not by default.
os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"

# A shell that runs the tests in the background has SIGINT ignored, and all programs that they start would inherit it.
signal.signal(signal.SIGINT, signal.default_int_handler)

WAIT = 60.0  # s, for what normally takes less than one; a machine may be busy
ANSWER = 10.0  # s, for the answer of a service that only reads or sets parameters, before it is requested again
POLL = 0.05  # s, between two looks at what no message tells
# Files in which nodes run.
NODES = ("test_ros_", "test_view_page", "test_package_compilation", "test_process_table", "test_benchmark_live")
# Files that take longest begin first, so that no worker is left alone with one.
LONG = (
    *("test_docs_site", "test_exploration.py", "test_offline_", "test_write_faults", "test_benchmark_", "test_fuzzing"),
    *("test_ros_replay", "test_ros_hostile", "test_ros_faults", "test_ros_localization", "test_ros_saving"),
    *("test_ros_explorer", "test_ros_two_systems", "test_ros_services", "test_package_compilation"),
)


def pytest_configure(config):
    """What only computes leaves the processor to nodes, which have to react within a time."""
    if os.environ.get("PYTEST_XDIST_WORKER", "gw0") not in ("gw0", "gw1"):
        os.nice(10)


def pytest_collection_modifyitems(items):
    """Mark the tests in which nodes run."""
    for item in items:
        if item.path.name.startswith(NODES):
            item.add_marker("nodes")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """The first two workers take the files in which nodes run, the others what only computes.

    Nodes mostly wait for each other, so that the others have the rest of the processor. No more than two workers run
    nodes, which have to react within a time: the others end where nothing else is left.
    """
    from xdist.scheduler import LoadFileScheduling  # noqa: PLC0415  only where it is installed

    class NodesInTurn(LoadFileScheduling):
        def _assign_work_unit(self, node):
            # A worker that dies gives back the files that it has completed, too. One without tests would be waited for.
            for file in [file for file, tests in self.workqueue.items() if all(tests.values())]:
                del self.workqueue[file]
            if not self.workqueue:
                node.shutdown()
                return
            runs_nodes = node in self.nodes[:2]
            for file in sorted(self.workqueue, key=lambda file: not name_of(file).startswith(LONG)):
                if name_of(file).startswith(NODES) == runs_nodes:
                    self.workqueue.move_to_end(file, last=False)
                    break
            super()._assign_work_unit(node)

        def _reschedule(self, node):
            if node in self.nodes[2:] and all(name_of(file).startswith(NODES) for file in self.workqueue):
                node.shutdown()
            else:
                super()._reschedule(node)

    def name_of(file):
        return file.rpartition("/")[2]

    return NodesInTurn(config, log)


@pytest.fixture
def domain(monkeypatch):
    """A ROS domain in which nobody else is; set for this process and its children."""
    pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")
    from hmt_slam_ros.ros.node_processes import own_domain  # noqa: PLC0415  only where there is ROS

    with own_domain() as number:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
        monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        yield number


@pytest.fixture(scope="session")
def corridor(tmp_path_factory):
    """The log of the drive along the corridor, and the folder of its map by the command line; nothing changes them."""
    from logs_for_nodes import MAPPED_SCANS, corridor_bag  # noqa: PLC0415  only where it is needed

    folder = tmp_path_factory.mktemp("corridor")
    log = corridor_bag(folder, scans=MAPPED_SCANS)
    preloaded.hmt_slam("map", log, "--out", folder / "out", check=True)
    return log, folder / "out"


@pytest.fixture(scope="session")
def fuzz_seeds(tmp_path_factory):
    """The folder of the valid files that the fuzzer changes; they stay as they are."""
    from benchmark.fuzz.seeds import write_seeds  # noqa: PLC0415  only where it is needed

    folder = tmp_path_factory.mktemp("fuzz") / "seeds"
    write_seeds(folder)
    return folder


class Listener:
    """A node of the test's own, and what it received."""

    def __init__(self, domain):
        from rclpy.context import Context  # noqa: PLC0415  only where there is ROS
        from rclpy.executors import SingleThreadedExecutor  # noqa: PLC0415
        from rclpy.node import Node  # noqa: PLC0415

        self.context = Context()
        self.context.init(domain_id=domain)
        self.node = Node("listener", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)

    def subscribe(self, kind, topic, profile):
        """Subscribe; the list that is returned fills up."""
        received = []
        self.node.create_subscription(kind, topic, received.append, profile)
        return received

    def until(self, condition, seconds=WAIT, alive=()):
        """Spin until a condition holds; fail where it does not, or where one of the processes ends before."""
        deadline = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < deadline, "waited in vain"
            for process in alive:
                assert process.poll() is None, process.communicate()[1]
            self.executor.spin_once(timeout_sec=POLL)

    def spin(self, seconds):
        """Listen for a while in which nothing in particular is awaited."""
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0.0:
            self.executor.spin_once(timeout_sec=left)

    def call(self, kind, name, request):
        """The answer of a service."""
        client = self.node.create_client(kind, name)
        self.until(client.service_is_ready)
        future = client.call_async(request)
        if kind.__module__.startswith("rcl_interfaces"):
            # A server that does not know the client yet drops its answer, and says so on stderr.
            with suppress(AssertionError):
                self.until(future.done, seconds=ANSWER)
            future = future if future.done() else client.call_async(request)
        self.until(future.done)
        return future.result()

    def close(self):
        from hmt_slam_ros.ros.execution import wait_until_alone  # noqa: PLC0415  only where there is ROS

        self.executor.shutdown()
        wait_until_alone(self.node, 2.0)
        self.node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture
def listener(domain):
    listener = Listener(domain)
    yield listener
    listener.close()


@pytest.fixture
def start(domain):
    """Starts nodes as OS processes, behind words such as of a command that runs them elsewhere.

    Their libraries are loaded before, unless that is not wanted, or other words come before.
    At the end, each that is left has to end well on request.
    """
    started = []

    def start(name, *arguments, before=(), preload=True, **parameters):
        words = [word for key, value in parameters.items() for word in ("-p", f"{key.replace('__', '.')}:={value}")]
        outputs = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        if preload and not before:
            process = preloaded.start(RUN_NODE, name, "--ros-args", *words, *arguments, **outputs)
        else:
            command = [*before, sys.executable, *node_command(name), "--ros-args", *words, *arguments]
            process = subprocess.Popen(command, **outputs)
        started.append(process)
        return process

    yield start
    left = [process for process in started if process.poll() is None]
    for process in left:
        process.send_signal(signal.SIGINT)
    try:
        for process in left:
            error = process.communicate(timeout=WAIT)[1]
            print(process.args, error)  # shown where the test failed
            assert process.returncode == 0, error
            assert "Traceback" not in error, error
    finally:
        for process in left:
            process.kill()
