"""Memory by part: what report.json tells of it is what the parts take."""

import subprocess
import sys

import numpy as np
from worlds import box, scan_in

from hmt_slam_ros.results.output_folder import code_bytes, scan_bytes

COMPILED = """
from hmt_slam_ros.results.output_folder import code_bytes
before = code_bytes()
from numba import njit
njit(lambda x: x + 1)(1)
ballast = bytearray(300_000_000)
after = code_bytes()
print(before["libraries"], before["kernels"], after["libraries"], after["kernels"])
"""


def test_libraries_and_compiled_kernels_are_distinguished_from_data():
    reported = subprocess.run([sys.executable, "-c", COMPILED], capture_output=True, text=True, check=True).stdout
    libraries, kernels, more_libraries, more_kernels = map(int, reported.split())
    assert libraries > 1_000_000
    assert kernels < more_kernels < 10_000_000
    # LLVM, which compiles, is a library; the ballast is none.
    assert 10_000_000 < more_libraries - libraries < 200_000_000
    assert code_bytes()["libraries"] > 1_000_000


def test_scans_count_with_what_was_worked_out_of_them():
    scan = scan_in(box(-3, -3, 3, 3), (0.0, 0.0, 0.0), beams=181)
    bare = scan.ranges.nbytes + scan.laser_pose.nbytes + scan.motion.nbytes
    assert scan_bytes([scan]) == bare
    points = scan.points
    assert scan_bytes([scan, scan]) == 2 * (bare + points.nbytes + np.count_nonzero(scan.valid))


def test_a_scan_that_forgets_its_points_has_the_same_at_each_use():
    scan = scan_in(box(-3, -3, 3, 3), (0.0, 0.0, 0.0), beams=181)
    points = scan.points
    assert scan.points is points
    full = scan_bytes([scan])
    scan.forget_points()
    np.testing.assert_array_equal(scan.points, points)
    assert scan_bytes([scan]) == full - points.nbytes


RELEASED = """
import numba
from hmt_slam_ros.process_memory import current_rss, release_code
numba.njit(lambda x: x + 1)(1)
before = current_rss()
release_code()
print(before - current_rss(), numba.njit(lambda x: x + 2)(1))
"""


def test_code_that_is_given_up_is_there_again_when_it_runs():
    reported = subprocess.run([sys.executable, "-c", RELEASED], capture_output=True, text=True, check=True).stdout
    released, result = map(int, reported.split())
    assert released > 10_000_000
    assert result == 3
