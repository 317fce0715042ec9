"""How a node ends on request at an awkward moment."""

import ctypes
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from functools import partial

import pytest
import rclpy
from rclpy.node import Node

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.ros.chain_writer import RCLError
from hmt_slam_ros.ros.execution import run
from hmt_slam_ros.ros.process_node import ProcessNode


def shut_down_while_made():
    """Make a node as if SIGTERM had come: rclpy's handler shuts the context down."""
    rclpy.shutdown()
    return Node("late")


class ToldAtTheBeginning(Node):
    """A node that has to end before it is spun, whether its map is then to be saved or not."""

    def __init__(self, save_on_shutdown):
        super().__init__("early")
        self.save_on_shutdown = save_on_shutdown

    def enter_startup_states(self):
        rclpy.shutdown()

    def discard_recovery(self):
        assert not rclpy.ok()


def fail_in_rcl():
    raise RCLError("the middleware is broken")


def status_of(make):
    raise SystemExit(run(make, ProcessNode.spin))


@pytest.mark.parametrize(
    ("make", "status"),
    [
        (shut_down_while_made, 0),
        (partial(ToldAtTheBeginning, False), 0),
        (partial(ToldAtTheBeginning, True), 0),
        (fail_in_rcl, 1),
    ],
)
def test_a_signal_amid_the_making_of_a_node_is_no_fault_but_a_broken_middleware_is(make, status):
    process = multiprocessing.get_context("spawn").Process(target=status_of, args=(make,))
    process.start()
    process.join(20)
    assert process.exitcode == status


def compile_for_a_minute(begun):
    """Make a node as a cold cache of kernels makes it: for long nothing looks at signals."""
    begun.set()
    time.sleep(60.0)


def test_what_takes_long_is_broken_off_after_a_while_without_a_fault():
    context = multiprocessing.get_context("spawn")
    begun = context.Event()
    process = context.Process(target=status_of, args=(partial(compile_for_a_minute, begun),))
    process.start()
    assert begun.wait(20)
    os.kill(process.pid, signal.SIGTERM)
    process.join(20)
    assert process.exitcode == 0


class Clinging(Node):
    """A node whose destruction never ends, as that of a participant of Fast DDS at times."""

    def destroy_node(self):
        ctypes.PyDLL(None).sleep(60)


@pytest.mark.parametrize(("sentence", "status"), [(None, 0), ("nothing to do", 2)])
def test_a_node_that_cannot_leave_ends_with_the_status_of_what_it_did(sentence, status):
    process = multiprocessing.get_context("spawn").Process(target=cling, args=(sentence,))
    process.start()
    process.join(20)
    assert process.exitcode == status


def cling(sentence):
    def spin(_node):
        if sentence:
            raise HmtSlamError(sentence)

    raise SystemExit(run(partial(Clinging, "clinging"), spin))


def test_a_signal_while_an_executor_is_made_leaves_no_traceback():
    program = (
        "import sys, rclpy\n"
        "from rclpy.executors import SingleThreadedExecutor\n"
        "from hmt_slam_ros.ros.execution import run\n"
        "sys.exit(run(lambda: (rclpy.shutdown(), SingleThreadedExecutor())[1], lambda node: None))\n"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (0, "")
