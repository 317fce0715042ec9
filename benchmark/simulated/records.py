"""Records of runs of simulated worlds, each in its own process, kept in a folder.

``python -m benchmark.simulated.records FOLDER FILE.csv`` writes all comparisons of a folder as one table. The columns
are those of ``benchmark.simulated.examinations.Row`` after ``family`` and ``seed``; missing values are empty.
"""

from __future__ import annotations

import csv
import gzip
import hashlib
import json
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

from benchmark.logs import ROOT
from benchmark.runs import PARAMETERS
from benchmark.simulated.worlds import World
from hmt_slam_ros.errors import HmtSlamError

Record = dict[str, Any]

_SUFFIX = ".json.gz"
_TAIL = 3  # lines of a failed run that go into a message


@cache
def code_hash(own: str = "benchmark/simulated", without: tuple[str, ...] = ()) -> str:
    """A hash of the program and its parameters, which identifies its records.

    :param own: folder of the program that makes the records.
    :param without: packages of ``hmt_slam_ros`` that do not take part.
    """
    digest = hashlib.sha256(PARAMETERS.read_bytes())
    left_out = [ROOT / "hmt_slam_ros" / package for package in without]
    for folder in ("hmt_slam_ros", own):
        for file in sorted((ROOT / folder).rglob("*.py")):
            if not any(file.is_relative_to(package) for package in left_out):
                digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def read_record(path: Path) -> Record:
    """Read a record."""
    with gzip.open(path, "rt", encoding="utf-8") as source:
        record: Record = json.load(source)
    return record


def read_records(folder: Path) -> Iterator[Record]:
    """All records of a folder, in the order of their names.

    :raises HmtSlamError: where there are none.
    """
    paths = sorted(folder.glob(f"*{_SUFFIX}"))
    if not paths:
        raise HmtSlamError(f"{folder} has no records: make them by `python -m benchmark calibration --runs {folder}`")
    yield from map(read_record, paths)


class Records:
    """Makes records, each at most once.

    :ivar folder: of the records; those of another program or other parameters are replaced.
    :ivar jobs: runs at the same time.
    """

    def __init__(self, folder: Path, jobs: int) -> None:
        self.folder, self.jobs = folder, jobs

    def make(self, worlds: Iterable[World], changes: Sequence[str]) -> list[Record]:
        """The records of some worlds, in their order.

        :param changes: parameters that differ from the file, as ``name=value``.
        :raises HmtSlamError: where a run failed.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        with ThreadPoolExecutor(self.jobs) as pool:
            return list(pool.map(lambda world: self._record(world, list(changes)), worlds))

    def _record(self, world: World, changes: list[str]) -> Record:
        path = self.folder / f"{world.name}{_SUFFIX}"
        if path.is_file():
            record = read_record(path)
            if (record["code"], record["world"], record["changes"]) == (code_hash(), world.log, changes):
                return record
        module = "benchmark.simulated.watch"
        command = [sys.executable, "-m", module, world.family, str(world.seed), str(path), *changes]
        result = subprocess.run(
            command, cwd=ROOT, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False
        )
        if result.returncode:
            last_lines = " | ".join(result.stderr.strip().splitlines()[-_TAIL:]) or "nothing"
            raise HmtSlamError(f"the run {world.name} failed: {last_lines}")
        record = read_record(path)
        print(f"{world.name}: {record['cpu_s']:.1f} CPU s", file=sys.stderr, flush=True)
        return record


def write_comparisons(folder: Path, file: Path) -> int:
    """Write the table; return the number of its rows."""
    count = 0
    with file.open("w", encoding="utf-8", newline="") as target:
        writer = csv.writer(target)
        for record in read_records(folder):
            if not count:
                writer.writerow(["family", "seed", *record["columns"]])
            writer.writerows([record["family"], record["seed"], *row] for row in record["rows"])
            count += len(record["rows"])
    return count


def main(arguments: Sequence[str]) -> int:
    """Write; return the exit status."""
    folder, file = map(Path, arguments)
    try:
        print(f"{file}: {write_comparisons(folder, file)} comparisons")
    except HmtSlamError as fault:
        print(f"records: {fault}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
