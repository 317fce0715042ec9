"""Each reader as a function of bytes, for fuzzers in one process: it returns, or raises an `HmtSlamError`."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path

from hmt_slam_ros.configuration import load_configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.evaluation import read_tum
from hmt_slam_ros.evaluation.relations import read_relations
from hmt_slam_ros.grids.occupancy_map import read_map
from hmt_slam_ros.logs.ros_types import LASER_SCAN, ODOMETRY, TRANSFORMS, deserialize
from hmt_slam_ros.messages import documents
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.results.plots import read_table
from hmt_slam_ros.saved_map.folder import FORMAT, VERSION, FolderReader
from hmt_slam_ros.simulation.worlds import read_world

CORPUS = Path(__file__).parent.parent.parent / "test" / "corpus"
"""Small files for each target in a folder of its name: seeds, and what once was a fault."""

_MAX_RECORDS = 300
_MEMORY = Path("/dev/shm")  # noqa: S108  files that live for a millisecond

Target = Callable[[bytes], object]


@contextmanager
def _folder_with(name: str, content: bytes) -> Iterator[Path]:
    parent = _MEMORY if os.access(_MEMORY, os.W_OK) else None
    with tempfile.TemporaryDirectory(dir=parent) as folder:
        (Path(folder) / name).write_bytes(content)
        yield Path(folder)


def _log(name: str) -> Target:
    def read(content: bytes) -> None:
        with _folder_with(name, content) as folder:
            for _ in islice(open_log(folder / name).records(), _MAX_RECORDS):
                pass

    return read


def _file(name: str, reader: Callable[[Path], object]) -> Target:
    def read(content: bytes) -> None:
        with _folder_with(name, content) as folder:
            reader(folder / name)

    return read


def _metadata(content: bytes) -> None:
    with _folder_with("metadata.yaml", content) as folder:
        (folder / "bag.mcap").write_bytes((CORPUS / "mcap" / "seed").read_bytes())
        for _ in islice(open_log(folder).records(), _MAX_RECORDS):
            pass


def _picture(content: bytes) -> None:
    with _folder_with("map.pgm", content) as folder:
        (folder / "map.yaml").write_bytes((CORPUS / "map_yaml" / "seed").read_bytes())
        read_map(folder)


def _map_yaml(content: bytes) -> None:
    with _folder_with("map.yaml", content) as folder:
        (folder / "map.pgm").write_bytes((CORPUS / "picture" / "seed").read_bytes())
        read_map(folder)


def _message(content: bytes) -> None:
    """The first byte chooses the type."""
    deserialize(content[1:], (LASER_SCAN, ODOMETRY, TRANSFORMS)[content[0] % 3 if content else 0])


_KINDS = tuple(documents._DOCUMENTS)


def _document(content: bytes) -> None:
    """The first byte chooses the document."""
    documents.decode(content[1:].decode("utf-8", "surrogateescape"), _KINDS[content[0] % len(_KINDS) if content else 0])


TARGETS: dict[str, Target] = {
    "carmen": _log("log.clf"),
    "rawlog": _log("log.rawlog"),
    "packed": _log("log.gz"),
    "mcap": _log("bag.mcap"),
    "sqlite": _log("bag.db3"),
    "metadata": _metadata,
    "message": _message,
    "document": _document,
    "parameters": _file("config.yaml", load_configuration),
    "world": _file("world.yaml", read_world),
    "trajectory": _file("trajectory.tum", read_tum),
    "relations": _file("relations", read_relations),
    "table": _file("pmf.csv", read_table),
    "picture": _picture,
    "map_yaml": _map_yaml,
    "manifest": _file("manifest.json", lambda path: FolderReader(path.parent, FORMAT, VERSION)),
}
"""{name: reader}."""


def accepts(target: str, content: bytes) -> bool:
    """Whether a reader takes some bytes; it refuses others by an `HmtSlamError`, and any other exception is a fault."""
    try:
        TARGETS[target](content)
    except HmtSlamError:
        return False
    return True


def corpus(target: str) -> list[bytes]:
    """The corpus of a target."""
    return [path.read_bytes() for path in sorted((CORPUS / target).iterdir())]
