"""How a node ends when it is told to at an awkward moment."""

import multiprocessing

import pytest
import rclpy
from rclpy.node import Node

from hmt_slam_ros.nodes.outbox import RCLError
from hmt_slam_ros.nodes.running import run


def shut_down_while_made():
    """Make a node as if SIGTERM had come: rclpy's handler shuts the context down."""
    rclpy.shutdown()
    return Node("late")


def fail_in_rcl():
    raise RCLError("the middleware is broken")


def status_of(make):
    raise SystemExit(run(make))


@pytest.mark.parametrize(("make", "status"), [(shut_down_while_made, 0), (fail_in_rcl, 1)])
def test_a_signal_amid_the_making_of_a_node_is_no_fault_but_a_broken_middleware_is(make, status):
    process = multiprocessing.get_context("spawn").Process(target=status_of, args=(make,))
    process.start()
    process.join(20)
    assert process.exitcode == status
