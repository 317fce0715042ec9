"""Runs of ``hmt_slam map``, each in its own process, several in parallel."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from benchmark.logs import ROOT, MeasuredLog
from hmt_slam_ros.errors import HmtSlamError

PARAMETERS = ROOT / "config" / "hmt_slam.yaml"
"""The parameter file of every run."""

_TAIL = 3  # lines of a failed run that go into a message


@dataclass(frozen=True)
class Case:
    """A run to be made.

    :ivar log: the log.
    :ivar seed: of all random numbers.
    :ivar kind: of degradation of the odometry, empty for none.
    :ivar changes: parameters that differ from the file, as ``name=value``.
    :ivar duration: seconds of the log that are used, 0 for all.
    :ivar start: seconds of the log that are skipped.
    :ivar source: output folder whose map is extended, None for none.
    :ivar jobs: OS processes of the run.
    """

    log: MeasuredLog
    seed: int
    kind: str = ""
    changes: tuple[str, ...] = ()
    duration: float = 0.0
    start: float = 0.0
    source: Path | None = None
    jobs: int = 1

    @property
    def name(self) -> str:
        """Of the output folder."""
        changes = "_".join(re.sub(r"[^\w.]+", "_", change) for change in self.changes)
        section = "_".join(
            f"{name}_{seconds:g}" for name, seconds in (("from", self.start), ("for", self.duration)) if seconds
        )
        jobs = f"jobs_{self.jobs}" if self.jobs > 1 else ""
        return "-".join(filter(None, (self.log.name, self.kind, changes, section, jobs, str(self.seed))))

    def command(self, folder: Path) -> list[str]:
        """The command line that maps the log into a folder."""
        program = ["benchmark.degraded_odometry", self.kind] if self.kind else ["hmt_slam_ros.cli.main", "map"]
        options = ["--out", str(folder), "--seed", str(self.seed), "--config", str(PARAMETERS)]
        options += ["--jobs", str(self.jobs)]
        section = {"--duration": self.duration, "--start": self.start, "--from": self.source}
        section_words = [word for name, value in section.items() if value for word in (name, str(value))]
        changes = [word for change in self.changes for word in ("--set", change)]
        return [sys.executable, "-m", *program, str(self.log.path), *options, *section_words, *changes]


@dataclass(frozen=True)
class Run:
    """The outcome of a case.

    :ivar case: what was run.
    :ivar folder: its output folder.
    :ivar cpu_seconds: of the whole process, user and system.
    :ivar wall_seconds: likewise.
    :ivar peak_rss: likewise, bytes.
    :ivar fault: last lines of the errors of a failed run, empty for a successful one.
    """

    case: Case
    folder: Path
    cpu_seconds: float
    wall_seconds: float
    peak_rss: int
    fault: str = ""

    @cached_property
    def report(self) -> dict[str, Any]:
        """The run's own report.json."""
        content: dict[str, Any] = json.loads((self.folder / "report.json").read_text(encoding="utf-8"))
        return content


class Runner:
    """Runs cases, each at most once.

    :ivar folder: gets a folder for each run.
    :ivar jobs: runs at the same time.
    """

    def __init__(self, folder: Path, jobs: int) -> None:
        self.folder, self.jobs = folder, jobs
        self._done: dict[Case, Run] = {}

    def attempts(self, cases: Sequence[Case]) -> list[Run]:
        """The runs of some cases in their order, including failed ones."""
        waiting = [case for case in dict.fromkeys(cases) if case not in self._done]
        with ThreadPoolExecutor(self.jobs) as pool:
            self._done.update(zip(waiting, pool.map(self._run, waiting), strict=True))
        # The log of an earlier measurement may have vanished since.
        return [replace(self._done[case], case=case) for case in cases]

    def runs(self, cases: Sequence[Case]) -> list[Run]:
        """The runs of some cases in their order.

        :raises HmtSlamError: where one fails.
        """
        runs = self.attempts(cases)
        for run in runs:
            if run.fault:
                raise HmtSlamError(f"the run {run.case.name} failed: {run.fault}")
        return runs

    def _run(self, case: Case) -> Run:
        run = run_case(case, self.folder.absolute() / case.name)
        print(f"{case.name}: {run.cpu_seconds:.1f} CPU s {run.fault}".rstrip(), file=sys.stderr, flush=True)
        return run


class CachedRunner(Runner):
    """A runner that keeps runs in their folder, for the same program and parameters.

    :ivar fingerprint: of the program, which identifies its runs.
    """

    def __init__(self, folder: Path, jobs: int, fingerprint: str) -> None:
        super().__init__(folder, jobs)
        self.fingerprint = fingerprint

    def _run(self, case: Case) -> Run:
        folder = self.folder.absolute() / case.name
        usage_file = folder / "usage.json"
        if usage_file.is_file():
            usage: dict[str, Any] = json.loads(usage_file.read_text(encoding="utf-8"))
            if usage.pop("code") == self.fingerprint:
                return Run(case, folder, **usage)
        shutil.rmtree(folder, ignore_errors=True)
        run = super()._run(case)
        if not run.fault:
            usage = {"cpu_seconds": run.cpu_seconds, "wall_seconds": run.wall_seconds, "peak_rss": run.peak_rss}
            usage_file.write_text(json.dumps(usage | {"code": self.fingerprint}), encoding="utf-8")
        return run


def run_case(case: Case, folder: Path) -> Run:
    """Run a case in its own process."""
    result = subprocess.run(
        [sys.executable, "-m", "benchmark.measured", *case.command(folder)],
        cwd=ROOT,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    last_lines = " | ".join(result.stderr.strip().splitlines()[-_TAIL:]) or "nothing"
    if result.returncode:
        return Run(case, folder, 0.0, 0.0, 0, last_lines)
    usage = json.loads(result.stdout.splitlines()[-1])
    fault = last_lines if usage["status"] else ""
    return Run(case, folder, usage["cpu_s"], usage["wall_s"], int(usage["peak_rss_bytes"]), fault)
