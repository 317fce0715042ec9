"""What writes: commands and parts of the package, with what they find in a folder and may leave there."""

from __future__ import annotations

import hashlib
import io
import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
from PIL import Image

from benchmark.fuzz.cases import SHORT
from hmt_slam_ros.cli import run_commands
from hmt_slam_ros.cli.main import main
from hmt_slam_ros.cli.run_commands import run_measured
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs import Log
from hmt_slam_ros.own_files import write_file
from hmt_slam_ros.results.hmt_map import RunState
from hmt_slam_ros.results.output_folder import atomic_output
from hmt_slam_ros.saved_map.folder import FORMAT, HMT_MAP, VERSION, FolderReader, FolderWriter
from hmt_slam_ros.sensors import Odometry

_MEASURED = ("report.json", "cost.csv", "cost.png")
"""Files that have measured times, and are never twice the same."""


@dataclass(frozen=True)
class Operation:
    """Something that writes into a folder.

    :ivar name: of the operation.
    :ivar prepare: makes the folder as the operation finds it.
    :ivar act: the operation in that folder; returns an exit status as ``hmt_slam`` does.
    :ivar is_whole: whether all files are old, or all are new.
    :ivar verify: raises an exception where the folder cannot be read.
    :ivar foreign: files beside, which others wrote.
    """

    name: str
    prepare: Callable[[Path], None]
    act: Callable[[Path], int]
    is_whole: bool = True
    verify: Callable[[Path], None] = lambda _: None
    foreign: tuple[str, ...] = ()


def digests(folder: Path) -> dict[str, str]:
    """{path of a file: digest of its content}; for files with measured times whether they can be read."""
    return {
        str(path.relative_to(folder)): _digest(path)
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not any(part.startswith(".") for part in path.relative_to(folder).parts)
    }


def _digest(path: Path) -> str:
    content = path.read_bytes()
    if path.name not in _MEASURED:
        return hashlib.sha256(content).hexdigest()
    try:
        if path.suffix == ".png":
            Image.open(io.BytesIO(content)).load()
        elif path.suffix == ".json":
            json.loads(content)
        readable = content.endswith(b"\n") or path.suffix == ".png"
    except (ValueError, OSError, SyntaxError):
        readable = False
    return "readable" if readable else "damaged"


def complaint(folder: Path, old: Mapping[str, str], new: Mapping[str, str], *, is_whole: bool) -> str:
    """What is wrong with a folder that is neither old nor new, empty where nothing is."""
    found = digests(folder)
    if found in (dict(old), dict(new)):
        return ""
    if is_whole:
        changed = [name for name in {*found, *old, *new} if found.get(name) not in (old.get(name), new.get(name))]
        return f"it is a mixture of old and new, or half: {sorted(changed)[:3]}"
    for name in {*found, *old}:
        if found.get(name) not in {old.get(name), new.get(name)}:
            return f"{name} is neither the old nor the new one"
    return ""


def operations(seeds: Path) -> dict[str, Operation]:
    """{name: operation}.

    :param seeds: folder of the seeds of the fuzzer.
    """
    from benchmark.write_faults import node_save  # noqa: PLC0415  rclpy is only for nodes

    bag, out = seeds / "map" / "bag", seeds / "map" / "out"
    run, log = out / HMT_MAP, seeds / "logs" / "log.clf"

    def copy_results(folder: Path) -> None:
        shutil.copytree(out, folder / "out")
        for name in ("map.png", "pmf.png", "cost.png"):
            Image.new("L", (3, 3)).save(folder / "out" / name)
        for name in ("topology.graphml", "landmarks.json", "places.json"):
            (folder / "out" / name).unlink(missing_ok=True)

    def command(*words: str) -> Callable[[Path], int]:
        return lambda folder: main([word.format(folder=folder, bag=bag, log=log) for word in words])

    def nothing(_folder: Path) -> None:
        pass

    run_once = _RunOnce()

    def map_again(folder: Path) -> int:
        with patch.object(run_commands, "run_measured", run_once):
            return command("map", "{log}", "--out", "{folder}/out", *SHORT)(folder)

    def prepare_localized(folder: Path) -> None:
        node_save.prepare(folder, run)
        node_save.save(run)(folder)

    every = (
        Operation("file", _write_old_file, _write_new_file),
        Operation("folder", _write_old_folder, _write_new_folder, verify=_read_map),
        Operation("journal", _start_journal, _checkpoint, is_whole=False, verify=_recover),
        Operation("convert to mcap", nothing, command("convert", "{bag}", "{folder}/bag", "--duration", "1")),
        Operation(
            "convert to sqlite3",
            nothing,
            command("convert", "{bag}", "{folder}/bag", "--duration", "1", "--storage", "sqlite3"),
        ),
        Operation("plot", copy_results, command("plot", "{folder}/out"), is_whole=False, verify=_read_map),
        Operation("export", copy_results, command("export", "{folder}/out"), is_whole=False, verify=_read_map),
        Operation("map", copy_results, map_again, verify=_read_map),
        Operation(
            "save",
            partial(node_save.prepare, old=run),
            node_save.save(run),
            verify=node_save.verify,
            foreign=node_save.FOREIGN,
        ),
        Operation(
            "save while localized",
            prepare_localized,
            node_save.save(run, run),
            verify=node_save.verify,
            foreign=node_save.FOREIGN,
        ),
    )
    return {operation.name: operation for operation in every}


class _RunOnce:
    """``run_measured`` for many trials that differ in their writes alone: the run is computed at the first call."""

    def __init__(self) -> None:
        self._result: Any = None
        self._states: list[RunState] = []

    def __call__(
        self, log: Log, configuration: Configuration, state: RunState, on_state: Callable[[RunState], None]
    ) -> Any:  # noqa: ANN401  what run_measured returns
        if self._result is None:
            self._result = run_measured(log, configuration, state, self._states.append)
        for last in self._states:
            on_state(last)
        return self._result


def _write_old_file(folder: Path) -> None:
    write_file(folder / "map.yaml", b"old\n" * 3000)


def _write_new_file(folder: Path) -> int:
    write_file(folder / "map.yaml", b"new\n" * 5000)
    return 0


def _write_old_folder(folder: Path) -> None:
    _write_folder(folder, 0)


def _write_new_folder(folder: Path) -> int:
    _write_folder(folder, 1)
    return 0


def _write_folder(folder: Path, number: int) -> None:
    with atomic_output(folder / "out") as new:
        writer = FolderWriter(new / HMT_MAP)
        writer.write("numbers", {"numbers": np.full(3000, float(number))})
        writer.finish(FORMAT, VERSION)
        write_file(new / "map.pgm", b"%d" % number * 20_000)
        (new / "graph.g2o").write_text(f"{number}\n" * 9000)


def _read_map(folder: Path) -> None:
    FolderReader(folder / "out" / HMT_MAP, FORMAT, VERSION)


def _recovery(folder: Path) -> Any:  # noqa: ANN401  rclpy is imported only here
    """The recovery of a node in a folder; of the node it needs its name, its configuration and its diagnostics."""
    from hmt_slam_ros.ros.recovery import Recovery  # noqa: PLC0415

    warnings: list[str] = []
    node = SimpleNamespace(
        get_fully_qualified_name=lambda: "/slam",
        configuration=Configuration(),
        diagnostics=SimpleNamespace(warn=warnings.append),
    )
    recovery = Recovery(node, str(folder))  # type: ignore[arg-type]
    return SimpleNamespace(recovery=recovery, warnings=warnings)


def _header(events: int) -> Any:  # noqa: ANN401  as above
    from hmt_slam_ros.ros.recovery import JournalHeader  # noqa: PLC0415

    return JournalHeader(has_checkpoint=True, events=events)


def _inputs(recovery: Any, begin: int) -> None:  # noqa: ANN401  as above
    for stamp in range(begin, begin + 3):
        recovery.record_input(Odometry(stamp, np.zeros(3)))


def _start_journal(folder: Path) -> None:
    recovery = _recovery(folder).recovery
    recovery.start_journal(_header(0))
    _inputs(recovery, 0)
    recovery.write_checkpoint(_header(1), {"numbers": {"numbers": np.zeros(300)}})
    _inputs(recovery, 3)


def _checkpoint(folder: Path) -> int:
    """What a node does that was killed: go on with its journal, and write a checkpoint."""
    node = _recovery(folder)
    if node.recovery.recovered_state is None:  # it was discarded, since it could not be written
        _start_journal(folder)
        node = _recovery(folder)
    _expect(node.recovery)
    node.recovery.resume_journal()
    _inputs(node.recovery, 6)
    node.recovery.write_checkpoint(_header(2), {"numbers": {"numbers": np.ones(300)}})
    _inputs(node.recovery, 9)
    return 0


def _expect(recovery: Any) -> None:  # noqa: ANN401  as above
    """Check that a journal has its inputs one after the other, from the header's event on."""
    from hmt_slam_ros.ros.recovery import CHECKPOINT  # noqa: PLC0415

    state = recovery.recovered_state
    if state is None:  # discarded, since it could not be written
        return
    stamps = [one.stamp for one in state.inputs]
    first = {1: 3, 2: 9}[state.header.events]
    if stamps != list(range(first, first + len(stamps))):
        raise HmtSlamError(f"the journal of event {state.header.events} has inputs of {stamps}: there is a gap")
    FolderReader(state.checkpoint_folder, CHECKPOINT, VERSION)


def _recover(folder: Path) -> None:
    _expect(_recovery(folder).recovery)
