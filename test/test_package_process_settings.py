"""The settings that commands and nodes make for their whole process."""

import os
import subprocess
import sys
from functools import cache

import pytest

from hmt_slam_ros.process_table import node_names, node_row

# Modules of the commands and the nodes.
NODES = sorted({node_row(node).node_class.partition(":")[0] for node in node_names()})
ENTRIES = ("hmt_slam_ros.cli.main", *NODES)
WORK = """
import numpy as np, scipy.linalg
scipy.linalg.eigh(np.eye(300) @ np.eye(300))
"""
# A thread of BLAS is one of the process for good, once the library is loaded.
THREADS = "import os; print(len(os.listdir('/proc/self/task')))"
# 20 MB go and come back as less, behind which a small object stays.
HEAP = """
import numpy as np
def resident():
    return int(open("/proc/self/statm").read().split()[1]) * 4096
first = np.ones(20_000_000, np.uint8); del first
second = np.ones(SIZE, np.uint8); small = [np.ones(8) for _ in range(1000)]
before = resident(); del second; print(before - resident())
"""


def run(code, **variables):
    environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    finished = subprocess.run(
        [sys.executable, "-c", code], env=environment | variables, capture_output=True, text=True, check=False
    )
    assert finished.returncode == 0, finished.stderr
    return int(finished.stdout)


@cache
def threads_without_those_of_blas(has_rclpy):
    """Threads of a program where BLAS has but one; rclpy has some of its own."""
    load = "import rclpy\n" if has_rclpy else ""
    return run(load + WORK + THREADS, OPENBLAS_NUM_THREADS="1")


@pytest.mark.parametrize("entry", ENTRIES)
def test_blas_has_one_thread_in_every_program(entry):
    if ".ros." in entry:
        pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")
    assert run(f"import {entry}\n{WORK}{THREADS}") == threads_without_those_of_blas(".ros." in entry)


@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="BLAS has one thread anyway on one core")
def test_blas_has_as_many_threads_as_the_environment_says():
    assert run(WORK + THREADS) > 1
    assert run("import hmt_slam_ros.cli.main\n" + WORK + THREADS, OPENBLAS_NUM_THREADS="2") > 1


@pytest.mark.parametrize("size", [500_000, 10_000_000])
def test_a_large_array_gives_its_memory_back_whatever_was_made_after_it(size):
    heap = HEAP.replace("SIZE", str(size))
    assert run(heap) < 0.1 * size
    assert run("import hmt_slam_ros.cli\n" + heap) > 0.9 * size
