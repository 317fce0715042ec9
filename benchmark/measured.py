"""Run a program and print its cost: ``python -m benchmark.measured PROGRAM ARGUMENTS``.

The last line of standard output is a JSON object; the output of the program goes to standard error.

It is a separate process, because Linux gives a program at least the peak memory of the process that started it. This
one imports nothing large.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import subprocess
import sys
import time

_PR_SET_PDEATHSIG = 1


def measure_cost(command: list[str]) -> dict[str, float]:
    """Exit status, CPU seconds (user and system, with all children), wall seconds and largest resident bytes."""
    begin = time.monotonic()
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=sys.stderr)
    signal.signal(signal.SIGTERM, lambda *_: process.terminate())
    if sys.platform == "linux":
        # The program ends with the process that started this one, even if that is killed.
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    return {
        "status": process.returncode,
        "cpu_s": usage.ru_utime + usage.ru_stime,
        "wall_s": time.monotonic() - begin,
        # ru_maxrss counts in units of 1024 bytes on Linux.
        "peak_rss_bytes": 1024 * usage.ru_maxrss,
    }


if __name__ == "__main__":
    print(json.dumps(measure_cost(sys.argv[1:])))
