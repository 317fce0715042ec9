"""Reports: requirements, tables, pictures and circumstances, and the tables in docs/."""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
import subprocess
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from benchmark.logs import ROOT
from benchmark.runs import PARAMETERS
from hmt_slam_ros.errors import HmtSlamError

_LIBRARIES = ("numpy", "scipy", "numba", "networkx", "rosbags")
_MANY = 5  # seeds, more of which are not listed one by one

Row = TypeVar("Row")
Columns = Sequence[tuple[str, Callable[[Row], str]]]
"""Heading of each column of a table, and the function that gives the cell of a row."""

# Both change what a run costs.
_VARIABLES = ("OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")

REPORTS = ROOT / "docs" / "reports"
ACCURACY = REPORTS / "accuracy.md"
VALIDATION = REPORTS / "validation.md"
IMAGES = ROOT / "docs" / "images"


@dataclass(frozen=True)
class Requirement:
    """A figure with its bounds.

    :ivar name: what is required.
    :ivar value: as measured; NaN, which meets no bound, if it could not be measured.
    :ivar bound: largest value that is allowed.
    :ivar unit: of both.
    :ivar least: smallest value that is allowed.
    """

    name: str
    value: float
    bound: float
    unit: str = ""
    least: float = -math.inf

    @property
    def is_met(self) -> bool:
        """Whether the figure is within its bounds."""
        return self.least <= self.value <= self.bound

    @property
    def row(self) -> list[str]:
        """The cells of its line in the table."""
        return [self.name, _format_number(self.value, self.unit), self._bounds, "pass" if self.is_met else "FAIL"]

    @property
    def _bounds(self) -> str:
        least, bound = _format_number(self.least, self.unit), _format_number(self.bound, self.unit)
        if math.isinf(self.least):
            return bound
        return f"at least {least}" if math.isinf(self.bound) else f"{least} to {bound}"


@dataclass
class Report:
    """The results of one measurement.

    :ivar kind: name of the measurement.
    :ivar title: headline.
    :ivar seeds: of the runs.
    :ivar requirements: in the order in which they are shown.
    :ivar body: Markdown under the requirements.
    :ivar data: all results, for JSON.
    :ivar pictures: {file name: caption}, of pictures in the report's folder.
    :ivar illustrations: file names of those that the documents show too.
    """

    kind: str
    title: str
    seeds: tuple[int, ...] = ()
    requirements: list[Requirement] = field(default_factory=list)
    body: list[str] = field(default_factory=list)
    data: dict[str, Any] = field(default_factory=dict)
    pictures: dict[str, str] = field(default_factory=dict)
    illustrations: tuple[str, ...] = ()

    @property
    def is_met(self) -> bool:
        """Whether all requirements are met."""
        return all(requirement.is_met for requirement in self.requirements)

    @property
    def text(self) -> str:
        """Requirements and body as Markdown."""
        rows = [requirement.row for requirement in self.requirements]
        bounds = "at most" if all(math.isinf(requirement.least) for requirement in self.requirements) else "allowed"
        required = [table(["required", "measured", bounds, ""], rows)] if rows else []
        return "\n\n".join([*required, *self.body])

    def write(self, folder: Path, describe_circumstances: Mapping[str, str]) -> None:
        """Write ``<kind>.md`` and ``<kind>.json``.

        :param describe_circumstances: of the measurement: machine, versions, date.
        """
        facts = table(["", ""], [[name, value] for name, value in describe_circumstances.items()])
        pictures = "\n\n".join(f"![{caption}]({name})\n\n{caption}" for name, caption in self.pictures.items())
        parts = [f"# {self.title}", self.text, pictures, "## Circumstances", facts]
        (folder / f"{self.kind}.md").write_text("\n\n".join(filter(None, parts)) + "\n", encoding="utf-8")
        content = {
            "kind": self.kind,
            "circumstances": dict(describe_circumstances),
            "requirements": [vars(requirement) | {"met": requirement.is_met} for requirement in self.requirements],
            **self.data,
        }
        text = json.dumps(make_json_safe(content), indent=1, allow_nan=False)
        (folder / f"{self.kind}.json").write_text(text + "\n", encoding="utf-8")


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table with a left-aligned first column; the others are right-aligned."""
    rule = ["---", *("---:" for _ in head[1:])]
    return "\n".join("| " + " | ".join(line) + " |" for line in [head, rule, *rows])


def table_of(columns: Columns[Row], rows: Iterable[Row]) -> str:
    """A Markdown table with a line for each row.

    :param columns: heading of each column, and the function that gives the cell of a row.
    """
    return table([heading for heading, _ in columns], [[cell(row) for _, cell in columns] for row in rows])


def mean(values: Collection[float] | NDArray[np.float64]) -> float:
    """The mean; NaN if there are no values."""
    return float(np.mean(list(values))) if len(values) else math.nan


def format_share(flags: Collection[bool] | NDArray[np.bool_]) -> str:
    """The share of true flags in percent; "-" if there are none."""
    return f"{100.0 * mean(flags):.0f} %" if len(flags) else "-"


def _format_number(value: float, unit: str) -> str:
    return f"{value:.4g} {unit}".strip()


def make_json_safe(value: Any) -> Any:  # noqa: ANN401  any content of a report
    """The same value with None for numbers that JSON does not have."""
    if isinstance(value, Mapping):
        return {str(key): make_json_safe(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [make_json_safe(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def describe_circumstances(seeds: Sequence[int], jobs: int, changes: Sequence[str]) -> dict[str, str]:
    """The circumstances of a measurement, {name: value}, in the order of the table.

    :param seeds: of the runs.
    :param jobs: runs at the same time.
    :param changes: parameters that differ from the file.
    """
    return {
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "commit": describe_commit(),
        "machine": f"{_processor_name()}, {os.cpu_count()} cores, {_memory_gib():.1f} GiB, {platform.system()}",
        "versions": ", ".join(
            [f"Python {platform.python_version()}", *(f"{name} {version(name)}" for name in _LIBRARIES)]
        ),
        "parameters": f"{PARAMETERS.name}, SHA-256 {hashlib.sha256(PARAMETERS.read_bytes()).hexdigest()[:16]}",
        "changed parameters": ", ".join(changes) or "none",
        "seeds": _list_seeds(seeds),
        "runs at a time": str(jobs),
        "environment": ", ".join(f"{name}={os.environ.get(name, 'not set')}" for name in _VARIABLES),
    }


def summarize_circumstances(facts: Mapping[str, str]) -> str:
    """The date, commit, machine and seeds as a sentence."""
    return f"Measured {facts['date']} at commit {facts['commit']} on {facts['machine']}; seeds {facts['seeds']}."


def _list_seeds(seeds: Sequence[int]) -> str:
    """The seeds as text; a long range by its ends."""
    if len(seeds) > _MANY and list(seeds) == list(range(seeds[0], seeds[-1] + 1)):
        return f"{seeds[0]} to {seeds[-1]}"
    return ", ".join(map(str, seeds))


def describe_commit() -> str:
    """Short hash of the checked out commit, and whether files outside of docs/ differ from it."""
    try:
        head = _run_git("rev-parse", "--short=10", "HEAD")
        return head + (
            " with changes" if _run_git("status", "--porcelain", "--untracked-files=no", "--", ":!docs") else ""
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _run_git(*words: str) -> str:
    command = ["git", "-C", str(ROOT), *words]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def _processor_name() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or platform.machine())


def _memory_gib() -> float:
    """Memory of the machine, GiB."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30


def document_marks(kind: str) -> tuple[str, str]:
    """The lines that enclose the tables of a measurement in a document."""
    return f"<!-- python -m benchmark {kind} --write-docs -->", f"<!-- end of {kind} -->"


def write_between_marks(path: Path, kind: str, text: str) -> None:
    """Replace the text between the marks of a measurement.

    :raises HmtSlamError: where the marks are missing.
    """
    begin, end = document_marks(kind)
    before, found, rest = path.read_text(encoding="utf-8").partition(begin)
    _, closed, after = rest.partition(end)
    if not found or not closed:
        raise HmtSlamError(f"{path.name} has no lines '{begin}' and '{end}': put them where the tables belong")
    path.write_text(f"{before}{begin}\n{text}\n{end}{after}", encoding="utf-8")


_COLORS = 48
"""Colors of a picture in docs/, which take a third of the bytes."""


def copy_illustrations(report: Report, out: Path) -> str:
    """Copy the illustrations of a report into docs/, in few colors; return the Markdown that shows them.

    :param out: folder of the report.
    """
    for name in report.illustrations:
        picture = Image.open(out / name).convert("RGB")
        picture.quantize(_COLORS, dither=Image.Dither.NONE).save(IMAGES / name, optimize=True)
    return "".join(f"\n\n![{report.pictures[name]}](../images/{name})" for name in report.illustrations)
