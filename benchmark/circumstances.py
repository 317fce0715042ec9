"""On what, with what and when something was measured."""

from __future__ import annotations

import hashlib
import os
import platform
import subprocess
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from benchmark.logs import ROOT
from benchmark.runs import PARAMETERS

_LIBRARIES = ("numpy", "scipy", "numba", "networkx", "rosbags")
_MANY = 5  # seeds, more of which are not listed one by one
# Both change what a run costs.
_VARIABLES = ("OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


def circumstances(seeds: Sequence[int], jobs: int, changes: Sequence[str]) -> dict[str, str]:
    """Names and values, in the order in which they are shown.

    :param seeds: of the runs.
    :param jobs: runs at the same time.
    :param changes: parameters that differ from the file.
    """
    return {
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "commit": commit(),
        "machine": f"{_processor()}, {os.cpu_count()} cores, {_memory() / 2**30:.1f} GiB, {platform.system()}",
        "versions": ", ".join(
            [f"Python {platform.python_version()}", *(f"{name} {version(name)}" for name in _LIBRARIES)]
        ),
        "parameters": f"{PARAMETERS.name}, SHA-256 {hashlib.sha256(PARAMETERS.read_bytes()).hexdigest()[:16]}",
        "changed parameters": ", ".join(changes) or "none",
        "seeds": _listed(seeds),
        "runs at a time": str(jobs),
        "environment": ", ".join(f"{name}={os.environ.get(name, 'not set')}" for name in _VARIABLES),
    }


def summary(facts: Mapping[str, str]) -> str:
    """The most important of them in one sentence."""
    return f"Measured {facts['date']} at commit {facts['commit']} on {facts['machine']}; seeds {facts['seeds']}."


def _listed(seeds: Sequence[int]) -> str:
    """The seeds, many in a row by the first and the last."""
    if len(seeds) > _MANY and list(seeds) == list(range(seeds[0], seeds[-1] + 1)):
        return f"{seeds[0]} to {seeds[-1]}"
    return ", ".join(map(str, seeds))


def commit() -> str:
    """Short hash of the checked out commit, and whether files differ from it, documents aside."""
    try:
        head = _git("rev-parse", "--short=10", "HEAD")
        return head + (" with changes" if _git("status", "--porcelain", "--untracked-files=no", "--", ":!docs") else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _git(*words: str) -> str:
    command = ["git", "-C", str(ROOT), *words]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or platform.machine())


def _memory() -> int:
    """Bytes."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
