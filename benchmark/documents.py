"""Tables in docs/, written by the program that measured them."""

from __future__ import annotations

import shutil
from pathlib import Path

from benchmark.logs import ROOT
from benchmark.report import Report
from hmt_slam_ros.errors import HmtSlamError

ACCURACY = ROOT / "docs" / "accuracy.md"
VALIDATION = ROOT / "docs" / "validation.md"


IMAGES = ROOT / "docs" / "images"


def marks(kind: str) -> tuple[str, str]:
    """The lines between which the tables of a measurement stand."""
    return f"<!-- python -m benchmark {kind} --write-docs -->", f"<!-- end of {kind} -->"


def write_between_marks(path: Path, kind: str, text: str) -> None:
    """Replace what stands between the marks of a measurement.

    :raises HmtSlamError: where the marks are missing.
    """
    begin, end = marks(kind)
    before, found, rest = path.read_text(encoding="utf-8").partition(begin)
    _, closed, after = rest.partition(end)
    if not found or not closed:
        raise HmtSlamError(f"{path.name} has no lines '{begin}' and '{end}': put them where the tables belong")
    path.write_text(f"{before}{begin}\n{text}\n{end}{after}", encoding="utf-8")


def shown(report: Report, out: Path) -> str:
    """Copy the pictures of a report that belong into the documents; return the Markdown that shows them.

    :param out: folder of the report.
    """
    for name in report.illustrations:
        shutil.copy(out / name, IMAGES / name)
    return "".join(f"\n\n![{report.pictures[name]}](images/{name})" for name in report.illustrations)
