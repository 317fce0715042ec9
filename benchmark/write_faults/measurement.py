"""``python -m benchmark faults``: a fault at every call that writes a map, a bag, a journal or results."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmark.fuzz.seeds import write_seeds
from benchmark.report import Report, Requirement, table
from benchmark.settings import Settings
from hmt_slam_ros.errors import HmtSlamError

OPERATIONS = (
    "file", "folder", "journal", "convert to mcap", "convert to sqlite3", "plot", "export", "map", "save",
    "save while localized",
)  # fmt: skip
"""Names of `operations.operations`, which loads all that they need."""


def measure_faults(settings: Settings) -> Report:
    """Try each fault at each call of all operations."""
    report = Report("faults", "A fault at every call that writes")
    seeds = settings.out / "seeds"
    write_seeds(seeds)
    found = try_operations(settings.out, seeds, settings.logs_or(OPERATIONS))
    trials, breaches = found["trials"], found["breaches"]
    report.requirements.append(Requirement(f"breaches in {sum(trials.values())} trials", len(breaches), 0))
    report.body.append(table(["operation", "trials"], [[name, str(count)] for name, count in trials.items()]))
    report.data["breaches"] = breaches
    return report


def try_operations(folder: Path, seeds: Path, names: Sequence[str], *options: str) -> dict[str, Any]:
    """The trials of some operations and their breaches, by a process that has the injector in memory.

    :param folder: for the compiled injector.
    :param options: of `trial.main`.
    :raises HmtSlamError: where there is no C compiler, or the process fails.
    """
    library = folder / "inject.so"
    source = Path(__file__).with_name("inject.c")
    _run(["gcc", "-shared", "-fPIC", "-O1", "-o", str(library), str(source), "-ldl"], {})
    command = [sys.executable, "-m", "benchmark.write_faults.trial", str(seeds), *names, *options]
    output = _run(command, {"LD_PRELOAD": str(library)})
    result: dict[str, Any] = json.loads(output.splitlines()[-1])
    return result


def _run(command: Sequence[str], environment: dict[str, str]) -> str:
    try:
        finished = subprocess.run(
            command, env=os.environ | environment, capture_output=True, text=True, check=True, errors="replace"
        )
    except FileNotFoundError as fault:
        raise HmtSlamError(f"{command[0]} is not installed: install a C compiler") from fault
    except subprocess.CalledProcessError as fault:
        raise HmtSlamError(f"{command[0]} failed: {fault.stderr[-2000:]}") from fault
    return finished.stdout
