"""Recorded logs for measurements, decompressed where needed."""

from __future__ import annotations

import lzma
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.evaluation import Relations, StampedPoses, read_odometry_poses, read_relations
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.sensors import Scan

ROOT = Path(__file__).resolve().parents[1]
VARIABLE = "HMT_SLAM_DATASETS"

# The file of each log and, where there is one, of its true relations, below the folder of the data sets.
_FILES = {
    "aces": ("aces.clf.xz", "aces.relations.xz"),
    "intel": ("intel.clf.xz", "intel.relations.xz"),
    "csail": ("csail.clf.xz", "csail.relations.xz"),
    "hospital": ("hospital.clf.xz", "hospital.relations.xz"),
    "edmonton": ("edmonton.kf.clf.xz", None),
    "freiburg-101": ("freiburg-101.kf.clf.xz", None),
}
BUNDLED = "malaga"
LOGS = (*_FILES, BUNDLED)
WITH_RELATIONS = ("aces", "intel")
"""The logs with true relations that are mapped as a whole, unless others are chosen."""


@dataclass(frozen=True)
class MeasuredLog:
    """A log with its truth; two of the same name are equal, wherever they were decompressed.

    :ivar name: one of ``LOGS``.
    :ivar path: of the log, as ``hmt_slam map`` takes it.
    :ivar relations_file: true relations, None where there are none.
    """

    name: str
    path: Path = field(compare=False)
    relations_file: Path | None = field(default=None, compare=False)

    @cached_property
    def relations(self) -> Relations | None:
        """True relations, None where there are none."""
        return None if self.relations_file is None else read_relations(self.relations_file)

    @cached_property
    def odometry(self) -> StampedPoses:
        """Wheel odometry with source stamps."""
        return read_odometry_poses(open_log(self.path))

    @cached_property
    def scans(self) -> list[Scan]:
        """All scans, in the order of the log."""
        return [r.measurement for r in open_log(self.path).records() if isinstance(r.measurement, Scan)]


def dataset_folder() -> Path:
    """The folder of the data sets."""
    return Path(os.environ.get(VARIABLE) or ROOT.parent / "shared" / "datasets")


def reason_missing(name: str) -> str:
    """The reason for which a log is missing, as a sentence; empty for one that is there.

    :param name: one of ``LOGS``.
    """
    absent = [file for file in _FILES.get(name, ()) if file and not (dataset_folder() / file).is_file()]
    return f"{absent[0]} is not in {dataset_folder()}: set {VARIABLE} to the folder of the data sets" if absent else ""


@contextmanager
def open_logs(names: Sequence[str]) -> Iterator[list[MeasuredLog]]:
    """The logs of some names, decompressed into a temporary folder.

    :raises HmtSlamError: for an unknown name or a missing file.
    """
    for name in names:
        if name not in LOGS:
            raise HmtSlamError(f"there is no log {name!r}: choose from {', '.join(LOGS)}")
        if reason := reason_missing(name):
            raise HmtSlamError(reason)
    with tempfile.TemporaryDirectory(prefix="hmt_slam_benchmark_") as folder:
        yield [_prepare_log(name, Path(folder)) for name in names]


def _prepare_log(name: str, folder: Path) -> MeasuredLog:
    if name == BUNDLED:
        return MeasuredLog(name, ROOT / "data" / "malaga_one_loop")
    log, relations = _FILES[name]
    return MeasuredLog(name, _decompress(log, folder), _decompress(relations, folder) if relations else None)


def _decompress(file: str, folder: Path) -> Path:
    plain = folder / file.removesuffix(".xz")
    with lzma.open(dataset_folder() / file) as source, plain.open("wb") as target:
        shutil.copyfileobj(source, target)
    return plain
