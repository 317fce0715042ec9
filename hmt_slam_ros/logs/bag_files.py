"""The files of a bag, found by its metadata and checked, and the messages in them.

The rosbags library reads one checked file at a time. It gets neither the metadata nor compressed files or messages,
since it would read and unpack these without limits.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs.mcap_file import check_mcap
from hmt_slam_ros.logs.ros_types import LASER_SCAN
from hmt_slam_ros.logs.sqlite_file import check_sqlite
from hmt_slam_ros.logs.unpacking import Allowance, DamageError, unpack, unpack_file
from hmt_slam_ros.untrusted_input import is_short_text, read_yaml, shorten

_CHECKS: dict[str, Callable[[Path], None]] = {".mcap": check_mcap, ".db3": check_sqlite}
"""{suffix of a file: its check}."""

_MAX_FILES = 5000
"""Files of a bag; one that is split every minute has as many after three days."""

_MAX_MESSAGE = 64_000_000
"""Bytes of a message that was compressed."""

_REMEDY = "copy or record it anew, or repair it with 'ros2 bag reindex'."


class BagMessage(NamedTuple):
    """A serialized message: its bag time, ns, its topic, its type, and its bytes in CDR."""

    bag_time: int
    topic: str
    kind: str
    content: bytes


class _BagFiles(NamedTuple):
    """The files of a bag in their order, and what is compressed in it: "file", "message" or ""."""

    paths: list[Path]
    packing: str


def check_bag(path: Path) -> None:
    """Check the files of a bag, so that a library may read them.

    :param path: a bag folder, or a .mcap or .db3 file.
    :raises HmtSlamError: where one is no regular file, or is damaged.
    """
    with _plain_files(path, check=True):
        pass


def read_topics(path: Path) -> dict[str, str]:
    """{topic: message type} of a bag.

    :raises HmtSlamError: where the bag cannot be opened.
    """
    with _plain_files(path) as files:
        return {one.topic: one.msgtype for file in files for one in _connections(file)}


def count_messages(path: Path) -> dict[str, int]:
    """{topic: number of messages} of a bag.

    :raises HmtSlamError: where the bag cannot be opened.
    """
    counts: Counter[str] = Counter()
    with _plain_files(path) as files:
        for file in files:
            for connection in _connections(file):
                counts[connection.topic] += connection.msgcount
    return dict(counts)


def read_messages(path: Path, topics: Collection[str]) -> Iterator[BagMessage]:
    """The messages of some topics in the order of their bag times; of equal bag times, scans come last.

    :raises HmtSlamError: where the bag is damaged.
    """
    with _plain_files(path) as files:
        messages: Iterator[BagMessage] = (message for file in files for message in _read_file(file, topics))
        if _find_files(path).packing == "message":
            messages = _unpack_messages(messages, path)
        for _, simultaneous in groupby(messages, key=lambda message: message.bag_time):
            yield from sorted(simultaneous, key=lambda message: message.kind == LASER_SCAN)


def _connections(file: Path) -> list[Connection]:
    with _damage_as_error(file), Reader(file) as reader:
        return list(reader.connections)


def _read_file(file: Path, topics: Collection[str]) -> Iterator[BagMessage]:
    with _damage_as_error(file), Reader(file) as reader:
        connections = [connection for connection in reader.connections if connection.topic in topics]
        if not connections:
            return
        for connection, bag_time, content in reader.messages(connections):
            yield BagMessage(bag_time, connection.topic, connection.msgtype, bytes(content))


def _unpack_messages(messages: Iterator[BagMessage], path: Path) -> Iterator[BagMessage]:
    """Messages that were compressed one by one."""
    allowance = Allowance()
    for message in messages:
        with _damage_as_error(path):
            content = bytes(unpack(message.content, "zstd", _MAX_MESSAGE))
            if len(content) > _MAX_MESSAGE:
                raise DamageError(f"a message has more than {_MAX_MESSAGE} bytes")
            allowance.spend(len(message.content), len(content))
        yield message._replace(content=content)


@contextmanager
def _plain_files(path: Path, *, check: bool = False) -> Iterator[list[Path]]:
    """The files of a bag as a library may read them; those that were compressed exist within the context.

    :param check: whether they are checked; what is unpacked always is.
    """
    found = _find_files(path)
    if found.packing != "file":
        for file in found.paths if check else ():
            _CHECKS[file.suffix](file)
        yield found.paths
        return
    allowance = Allowance()
    with tempfile.TemporaryDirectory(prefix="hmt_slam-") as folder:
        plain = [Path(folder) / file.stem for file in found.paths]
        for file, target in zip(found.paths, plain, strict=True):
            with _damage_as_error(file):
                unpack_file(file, target, allowance)
            _CHECKS[target.suffix](target)
        yield plain


def _find_files(path: Path) -> _BagFiles:
    """The files of a bag.

    :raises HmtSlamError: where the metadata of a folder names none, or others than of a bag.
    """
    if not path.is_dir():
        return _BagFiles([path], "")
    status = (path / "metadata.yaml").stat()
    return _read_metadata(path, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=4)
def _read_metadata(path: Path, _time: int, _size: int) -> _BagFiles:
    """The files that the metadata of a folder name, parsed once for each of its times and sizes."""
    content = read_yaml(path / "metadata.yaml")
    match content:
        case {"rosbag2_bagfile_information": {"relative_file_paths": [*names], "storage_identifier": str()} as bag}:
            pass
        case _:
            raise HmtSlamError(f"{path / 'metadata.yaml'} names no files of a bag: repair it with 'ros2 bag reindex'.")
    packing = bag.get("compression_mode") or ""
    packing = packing.lower() if isinstance(packing, str) else "?"
    packing = "" if packing == "none" else packing
    if packing not in ("", "file", "message") or (packing and bag.get("compression_format") != "zstd"):
        raise HmtSlamError(f"{path} has a compression that is not known: convert it with 'ros2 bag convert'.")
    files = [path / Path(name).name for name in names if is_short_text(name)]
    suffixes = {(file.with_suffix("") if packing == "file" else file).suffix for file in files}
    if len({*files}) != len(names) or len(files) > _MAX_FILES or not suffixes <= set(_CHECKS):
        raise HmtSlamError(
            f"{path / 'metadata.yaml'} names files twice, or others than .mcap and .db3: "
            "repair it with 'ros2 bag reindex'."
        )
    return _BagFiles(files, packing)


@contextmanager
def _damage_as_error(path: Path) -> Iterator[None]:
    """A context that turns any exception of the rosbags library into one sentence."""
    try:
        yield
    except HmtSlamError:
        raise
    except Exception as error:
        if isinstance(error.__context__, GeneratorExit):  # nobody reads on, as after a signal
            return
        cause = shorten(str(error).strip().rstrip(".") or type(error).__name__)
        raise HmtSlamError(f"{path} is no complete rosbag2, truncated or damaged ({cause}): {_REMEDY}") from error
