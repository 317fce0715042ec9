"""The service ``slam/save`` in one process: slam's side and those of all others, which get each message at once."""

from __future__ import annotations

import shutil
import sys
from collections import defaultdict
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

from std_msgs.msg import String

from hmt_slam_ros.cli.main import FAULT
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.messages.system_name import SystemName
from hmt_slam_ros.process_table import COORDINATOR, PROCESSES, participant_names
from hmt_slam_ros.results.hmt_map import ChainState, MapDocument, RunState, read_run_state
from hmt_slam_ros.ros.map_services import MapSaver
from hmt_slam_ros.ros.request_participant import RequestParticipant
from hmt_slam_ros.ros.slam_node import SlamNode
from hmt_slam_ros.saved_map.folder import FORMAT, VERSION, FolderReader
from hmt_slam_ros.untrusted_input import one_sentence

SAVED = "out"
"""Folder of the map."""

FOREIGN = ("notes.txt", ".out.partial-notes", ".out.partial-4194305-mine/diary")
"""Files beside the map that the package did not write; the last is in a folder as one of a process that is gone."""


class _Bus:
    """Topics of one process: what is published is delivered before the call returns."""

    def __init__(self) -> None:
        self._callbacks: dict[str, list[Callable[[String], None]]] = defaultdict(list)

    def subscribe(self, _kind: type, topic: str, callback: Callable[[String], None], *_options: Any) -> None:  # noqa: ANN401  rclpy's
        self._callbacks[topic].append(callback)

    def publisher(self, _kind: type, topic: str, *_options: Any) -> Any:  # noqa: ANN401  rclpy's
        def publish(message: String) -> None:
            for callback in self._callbacks[topic]:
                callback(message)

        return SimpleNamespace(publish=publish, get_subscription_count=lambda: len(self._callbacks[topic]))


class _Saving(NamedTuple):
    """The service, and how often slam was released after a save."""

    saver: MapSaver
    released: list[bool]


@cache
def _read(run: Path) -> tuple[RunState, Configuration, MapDocument]:
    """State, parameters and map of a run."""
    return *read_run_state(run), FolderReader(run, FORMAT, VERSION).read("map", MapDocument)


def _nodes(run: Path, target: Path, loaded: Path | None) -> _Saving:
    """All nodes in the state of a run.

    :param run: folder of its map.
    :param target: folder that the service saves to.
    :param loaded: folder of a map in which the robot is only localized, None where it maps.
    """
    state, configuration, document = _read(run)
    bus, system = _Bus(), SystemName("faults")
    diagnostics = SimpleNamespace(warn=lambda _: None, refuse=lambda *_: None, steady_clock=None, system=system)
    shared = {
        "configuration": configuration,
        "diagnostics": diagnostics,
        "system": system,
        "create_publisher": bus.publisher,
        "create_subscription": bus.subscribe,
        "create_service": lambda *_, **__: None,
        "create_timer": lambda *_, **__: None,
        "inbox": SimpleNamespace(is_holding=False),
        "initial_state": SimpleNamespace(events=state.processes[COORDINATOR].keyframe_events),
    }
    processes = {row.name: row.make(configuration, state.processes[row.name]) for row in PROCESSES}
    for name in participant_names():
        node: Any = SimpleNamespace(process=processes[name], **shared)
        RequestParticipant(node, name)
    slam: Any = SimpleNamespace(
        process=processes[COORDINATOR],
        get_parameter=lambda _name: SimpleNamespace(value=str(target)),
        estimate=document.last_estimate,
        unchanged_map_folder=loaded,
        _area_poses={entry.area: entry for entry in document.area_poses},
        is_busy=False,
        **shared,
    )
    slam.write_map = lambda writer: SlamNode.write_map(slam, writer)
    released: list[bool] = []
    return _Saving(MapSaver(slam, lambda: released.append(True)), released)


def prepare(folder: Path, old: Path) -> None:
    """Put an old map into a folder, and files of others beside it."""
    shutil.copytree(old, folder / SAVED)
    for name in FOREIGN:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text("mine\n")


def save(run: Path, loaded: Path | None = None) -> Callable[[Path], int]:
    """What saves the map, and once more by the same nodes where that failed.

    :param loaded: as of `_nodes`.
    :returns: a function that returns an exit status, 0 where the map is saved, else 2.
    """

    def act(folder: Path) -> int:
        saving = _nodes(run, folder / SAVED, loaded)
        for number in (1, 2):
            is_saved, sentence = saving.saver.request().result()
            if len(saving.released) != number or saving.saver.is_blocking or saving.saver.is_busy:
                raise RuntimeError(f"slam does not go on after: {sentence}")
            if is_saved:
                return 0
            print(one_sentence(sentence), file=sys.stderr)
        return FAULT

    return act


def verify(folder: Path) -> None:
    """Read all that nodes start from, and look whether what others wrote is there.

    :raises HmtSlamError: where a part of the map cannot be read.
    :raises OSError: where an entry of others is gone.
    """
    reader = FolderReader(folder / SAVED, FORMAT, VERSION)
    for row in PROCESSES:
        reader.read(row.name, row.state_class)
    reader.read("map", MapDocument)
    reader.read("chain", ChainState)
    for name in FOREIGN:
        (folder / name).read_text()
