"""The size of the package, and the number of files that a scan, a keyframe and a closure pass.

A function call or a return that leads from one file of the package to another is a move. The bundled log is run in
lock-step; the figures of a scan are the median over those without a keyframe event, those of a keyframe the median over
events without a closure, those of a closure the largest over events that accept one.
"""

from __future__ import annotations

import ast
import statistics
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import NamedTuple

from benchmark.logs import BUNDLED, open_logs
from benchmark.report import Report, Requirement, table
from benchmark.runs import PARAMETERS
from benchmark.settings import Settings
from hmt_slam_ros.configuration import load_configuration
from hmt_slam_ros.offline.lock_step import LockStepRun
from hmt_slam_ros.open_log import open_log

PACKAGE = Path(sys.modules["hmt_slam_ros"].__file__ or "").parent

LONGEST, MOST_LINES = 600, 36_000
"""Lines of a file, and of the package, at most."""

MOST_FILES = {"scan": 14, "keyframe": 35, "closure": 50}
"""Largest numbers of files that are passed."""


class Passage(NamedTuple):
    """The files that a record of the log passes.

    :ivar kind: "scan", "keyframe" or "closure".
    :ivar files: of the package that were entered.
    :ivar moves: between two of them.
    """

    kind: str
    files: int
    moves: int


def measure_structure(settings: Settings) -> Report:
    """Count files, lines and classes, and follow the bundled log through them."""
    report = Report("structure", "The size of the package, and the path of a scan through it", seeds=(0,))
    paths = sorted(PACKAGE.rglob("*.py"))
    lines = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in paths}
    classes = Counter(name for path in paths for name in class_names(path))
    homonyms = sorted(name for name, count in classes.items() if count > 1)
    with open_logs([BUNDLED]) as (log,):
        passages = list(follow_log(log.path, settings.changes))
    figures = {kind: typical_passage(passages, kind) for kind in MOST_FILES}
    report.requirements = [
        Requirement("lines of the package", sum(lines.values()), MOST_LINES),
        Requirement("lines of the longest file", max(lines.values()), LONGEST),
        Requirement("class names with several meanings", len(homonyms), 0),
        *(Requirement(f"files that a {kind} passes", figures[kind].files, most) for kind, most in MOST_FILES.items()),
    ]
    report.body = [
        table(["modules", "lines", "classes"], [[str(len(paths)), str(sum(lines.values())), str(classes.total())]]),
        table(
            ["of one", "files", "moves"],
            [[kind, str(passage.files), str(passage.moves)] for kind, passage in figures.items()],
        ),
        f"Several meanings: {', '.join(homonyms) or 'none'}.",
    ]
    report.data = {kind: passage._asdict() for kind, passage in figures.items()}
    return report


def class_names(path: Path) -> Iterator[str]:
    """The classes of a file at its top level, without a leading underscore."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ClassDef):
            yield node.name.lstrip("_")


def typical_passage(passages: list[Passage], kind: str) -> Passage:
    """The median of a kind's passages; of closures, the largest."""
    own = [passage for passage in passages if passage.kind == kind]
    over: Callable[[list[int]], float] = max if kind == "closure" else statistics.median
    files, moves = ([getattr(passage, name) for passage in own] or [0] for name in ("files", "moves"))
    return Passage(kind, round(over(files)), round(over(moves)))


def follow_log(path: Path, changes: tuple[str, ...]) -> Iterator[Passage]:
    """The passage of each scan of a log after the first keyframe event."""
    run = LockStepRun(load_configuration(PARAMETERS, list(changes)))
    recorder = run.recorder
    scans, events, closures = 0, 0, 0
    for record in run.unread_records(open_log(path)):
        follower = Follower()
        sys.setprofile(follower)
        try:
            run.process_record(record)
        finally:
            sys.setprofile(None)
        accepted = sum(decision.hypothesis is not None for decision in recorder.decisions.values())
        kind = "closure" if accepted > closures else "keyframe" if len(recorder.keyframes) > events else "scan"
        if events and len(recorder.estimates) > scans:
            yield Passage(kind, len(follower.files), follower.moves)
        scans, events, closures = len(recorder.estimates), len(recorder.keyframes), accepted


class Follower:
    """A profiler that notes the files of the package that are entered.

    :ivar files: that were entered.
    :ivar moves: between two of them.
    """

    def __init__(self) -> None:
        self.files: set[str] = set()
        self.moves = 0
        self._at = ""
        self._stack: list[str] = []

    def __call__(self, frame: FrameType, event: str, _argument: object) -> None:
        """Note a call or a return of a Python function."""
        name = frame.f_code.co_filename
        if event == "call":
            self._stack.append(self._at)
            if name.startswith(str(PACKAGE)):
                self._enter(name)
        elif event == "return" and self._stack:
            back = self._stack.pop()
            if back:
                self._enter(back)

    def _enter(self, name: str) -> None:
        if name != self._at:
            self.moves += bool(self._at)
            self._at = name
            self.files.add(name)
