"""Opens logs of all formats."""

from __future__ import annotations

import gzip
import io
import lzma
import zlib
from pathlib import Path

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs.carmen import is_carmen, open_carmen
from hmt_slam_ros.logs.rawlog import is_rawlog, open_rawlog
from hmt_slam_ros.logs.records import SIMULATION_PREFIX, Log, TimeWindow
from hmt_slam_ros.untrusted_input import open_regular, read_file

_MCAP, _SQLITE, _GZIP, _XZ = b"\x89MCAP0\r\n", b"SQLite format 3\x00", b"\x1f\x8b", b"\xfd7zXZ\x00"
"""First bytes of files."""

_BAGS = {_MCAP: ".mcap", _SQLITE: ".db3"}
"""{first bytes of a bag's file: its suffix}."""

MAX_CONTENT_BYTES = 200_000_000
"""Of a log that is read as a whole, decompressed; the largest public one has 20 MB."""

_FREE_CONTENT, _MAX_RATIO = 16_000_000, 50
"""Bytes that a packed log may always have, and its content in bytes of the file beyond; logs reach 10."""

_XZ_MEMORY, _PIECE = 200_000_000, 1 << 20
"""Bytes that the decompression of xz may take besides its result, three times what it needs; and of one step of it."""


def open_log(
    path: str | Path,
    *,
    scan_topics: str = "/scan",
    odom_topic: str = "/odom",
    marks_topic: str = "",
    start: float = 0.0,
    duration: float | None = None,
) -> Log:
    """Open a rosbag2 (folder, .mcap, .db3), a CARMEN log (plain, .gz, .xz) or an MRPT rawlog, by its content.

    :param path: file or folder, or ``sim:WORLD,name=value,...`` for a simulated drive (docs/guides/simulation.md).
    :param scan_topics: topics of a bag, separated by commas; where the default is missing, the only topic with scans.
    :param odom_topic: topic of a bag, chosen likewise; without any, the transform odom -> base on /tf.
    :param marks_topic: topic of a bag with observations of marks, empty for none.
    :param start: start of the part to read after the log's first stamp, s.
    :param duration: duration of that part, s, None for the rest.
    :raises HmtSlamError: where the file is missing, of unknown format, truncated or damaged, or lacks scans, odometry
        or a topic.
    """
    window = TimeWindow(start, duration)
    if is_simulated(path):
        from hmt_slam_ros.simulation.simulated_log import open_simulated  # noqa: PLC0415  it loads kernels of its own

        return open_simulated(path, window)
    path = Path(path)
    if is_bag(path):
        return _open_bag(find_bag(path), window, scan_topics, odom_topic, marks_topic)
    return _open_file(path, _read_head(path), window)


def open_configured(path: str | Path, configuration: Configuration) -> Log:
    """Open the part of a log that ``robot.start`` and ``robot.duration`` select, with the topics of the configuration.

    :raises HmtSlamError: as :func:`open_log`, and where the part has no scans.
    """
    log = open_log(
        path,
        scan_topics=configuration.sensors.scan_topics,
        marks_topic=configuration.marks.topic,
        start=configuration.robot.start,
        duration=configuration.robot.duration or None,
    )
    if not log.scan_count:
        raise HmtSlamError(f"{path} has no scans in the part asked for: check --start and --duration")
    return log


def is_simulated(path: str | Path) -> bool:
    """Whether a path names a simulated log."""
    return str(path).startswith(SIMULATION_PREFIX)


def is_bag(path: str | Path) -> bool:
    """Whether a log is a rosbag2, or a folder that can be nothing else."""
    path = Path(path)
    return not is_simulated(path) and (path.is_dir() or _read_head(path).startswith(tuple(_BAGS)))


def find_bag(path: Path) -> Path:
    """The folder or file of a rosbag2.

    :raises HmtSlamError: where it is none, or a file has the suffix of another format.
    """
    if not is_bag(path):
        raise HmtSlamError(f"{path} is no rosbag2: give a bag folder, or a .mcap or .db3 file.")
    if path.is_dir():
        return _bag_folder(path)
    head = _read_head(path)
    return _check_suffix(path, next(suffix for magic, suffix in _BAGS.items() if head.startswith(magic)))


def _open_bag(path: Path, window: TimeWindow, scan_topics: str, odom_topic: str, marks_topic: str) -> Log:
    from hmt_slam_ros.logs.bag import BagLog  # noqa: PLC0415  the rosbags library takes memory

    return BagLog(path, window, scan_topics, odom_topic, marks_topic)


def _open_file(path: Path, head: bytes, window: TimeWindow) -> Log:
    content = _decompress(path, head)
    if is_rawlog(content):
        return open_rawlog(path, content, window)
    if is_carmen(content):
        file = io.BytesIO(content)
        del content  # the reader closes the file, which frees the content
        return open_carmen(path, file, window)
    raise HmtSlamError(
        f"{path} is of no known format: give a rosbag2 folder, a .mcap or .db3 file, a CARMEN log, an MRPT rawlog, or "
        f"{SIMULATION_PREFIX}WORLD for a simulated drive."
    )


def _bag_folder(path: Path) -> Path:
    if not (path / "metadata.yaml").is_file():
        raise HmtSlamError(f"{path} is a folder without a bag's metadata.yaml: give a rosbag2 folder or a log file.")
    return path


def _read_head(path: Path) -> bytes:
    with open_regular(path) as file:
        head = file.read(16)
    if not head:
        raise HmtSlamError(f"{path} is empty: give a log with scans.")
    return head


def _check_suffix(path: Path, suffix: str) -> Path:
    if path.suffix != suffix:
        raise HmtSlamError(f"{path} holds a bag's data under another suffix: rename it to {path.stem}{suffix}.")
    return path


def _decompress(path: Path, head: bytes) -> bytes:
    """The content of a file, decompressed up to a limit."""
    content = read_file(path, MAX_CONTENT_BYTES)
    limit = min(MAX_CONTENT_BYTES, _FREE_CONTENT + _MAX_RATIO * len(content))
    try:
        if head.startswith(_GZIP):
            content = _decompress_gzip(content, limit)
        elif head.startswith(_XZ):
            content = _decompress_xz(content, limit)
    except (EOFError, zlib.error, gzip.BadGzipFile, lzma.LZMAError) as error:
        raise HmtSlamError(f"{path} is truncated or damaged ({error}): copy it anew.") from error
    if len(content) > limit:
        raise HmtSlamError(
            f"{path} has more than {limit} bytes of content: give a shorter log, or convert it in parts."
        )
    return content


def _decompress_gzip(content: bytes, limit: int) -> bytes:
    """The content of all members of a gzip file, up to the limit and a byte."""
    pieces: list[bytes] = []
    left = limit + 1
    with gzip.GzipFile(fileobj=io.BytesIO(content)) as file:
        while left and (piece := file.read(min(left, _PIECE))):
            pieces.append(piece)
            left -= len(piece)
    return b"".join(pieces)


def _decompress_xz(content: bytes, limit: int) -> bytes:
    """The content of all streams of an xz file, up to the limit and a byte."""
    pieces: list[bytes] = []
    left = limit + 1
    while content and left:
        decompressor = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_XZ_MEMORY)
        while not decompressor.eof and left:
            if decompressor.needs_input and not content:
                raise EOFError("it ends inside a stream")
            piece = decompressor.decompress(content, min(left, _PIECE))
            content = b""
            pieces.append(piece)
            left -= len(piece)
        # Between streams and at the end there may be padding of zeros.
        content = decompressor.unused_data.lstrip(b"\0") if decompressor.eof else b""
    return b"".join(pieces)
