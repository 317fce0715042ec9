"""The command ``compile``, which compiles the kernels of all nodes and commands at the installation."""

from __future__ import annotations

import argparse
import multiprocessing
import os
import signal
import sys
import time

from hmt_slam_ros.cli.terminal import MovingLine
from hmt_slam_ros.kernel_loading import KernelLoading
from hmt_slam_ros.kernel_table import known_calls


def run_compile(_options: argparse.Namespace) -> None:
    """Compile what is not cached, on two cores where there are, with the time left, and say so."""
    begin, loading = time.monotonic(), KernelLoading()
    helper = multiprocessing.get_context("fork").Process(target=_help, daemon=True)
    if len(os.sched_getaffinity(0)) > 1:
        helper.start()
    with MovingLine(sys.stderr) as line:
        loading.run(lambda: line.show(loading.progress))
    print(f"{len(known_calls())} kernels are compiled; {time.monotonic() - begin:.1f} s")


def _help() -> None:
    """Compile what others do not compile just now; the parent decides what a signal means."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    KernelLoading().run()
