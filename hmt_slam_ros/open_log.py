"""Opens logs of all formats."""

from __future__ import annotations

import gzip
import lzma
import zlib
from pathlib import Path

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs.carmen import is_carmen, open_carmen
from hmt_slam_ros.logs.rawlog import is_rawlog, open_rawlog
from hmt_slam_ros.logs.records import SIMULATION_PREFIX, Log, TimeWindow

_MCAP, _SQLITE, _GZIP, _XZ = b"\x89MCAP0\r\n", b"SQLite format 3\x00", b"\x1f\x8b", b"\xfd7zXZ\x00"
"""First bytes of files."""


def open_log(
    path: str | Path,
    *,
    scan_topic: str = "/scan",
    odom_topic: str = "/odom",
    start: float = 0.0,
    duration: float | None = None,
) -> Log:
    """Open a rosbag2 (folder, .mcap, .db3), a CARMEN log (plain, .gz, .xz) or an MRPT rawlog, by its content.

    :param path: file or folder, or ``sim:WORLD,name=value,...`` for a simulated drive (docs/guides/simulation.md).
    :param scan_topic: topic of a bag; where the default is missing, the only topic with scans.
    :param odom_topic: topic of a bag, chosen likewise; without any, the transform odom -> base on /tf.
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
    try:
        if path.is_dir():
            return _open_bag(_bag_folder(path), window, scan_topic, odom_topic)
        head = _read_head(path)
        for magic, suffix in ((_MCAP, ".mcap"), (_SQLITE, ".db3")):
            if head.startswith(magic):
                return _open_bag(_check_suffix(path, suffix), window, scan_topic, odom_topic)
    except OSError as error:
        raise HmtSlamError(f"{path} cannot be read ({error.strerror}): give an existing log.") from error
    return _open_file(path, head, window)


def is_simulated(path: str | Path) -> bool:
    """Whether a path names a simulated log."""
    return str(path).startswith(SIMULATION_PREFIX)


def is_bag(path: str | Path) -> bool:
    """Whether a log that `open_log` took is a rosbag2."""
    path = Path(path)
    return not is_simulated(path) and (path.is_dir() or _read_head(path).startswith((_MCAP, _SQLITE)))


def _open_bag(path: Path, window: TimeWindow, scan_topic: str, odom_topic: str) -> Log:
    from hmt_slam_ros.logs.bag import BagLog  # noqa: PLC0415  the rosbags library takes memory

    return BagLog(path, window, scan_topic, odom_topic)


def _open_file(path: Path, head: bytes, window: TimeWindow) -> Log:
    content = _decompress(path, head)
    if is_rawlog(content):
        return open_rawlog(path, content, window)
    if is_carmen(content):
        return open_carmen(path, content, window)
    raise HmtSlamError(
        f"{path} is of no known format: give a rosbag2 folder, a .mcap or .db3 file, a CARMEN log, an MRPT rawlog, or "
        f"{SIMULATION_PREFIX}WORLD for a simulated drive."
    )


def _bag_folder(path: Path) -> Path:
    if not (path / "metadata.yaml").is_file():
        raise HmtSlamError(f"{path} is a folder without a bag's metadata.yaml: give a rosbag2 folder or a log file.")
    return path


def _read_head(path: Path) -> bytes:
    with path.open("rb") as file:
        head = file.read(16)
    if not head:
        raise HmtSlamError(f"{path} is empty: give a log with scans.")
    return head


def _check_suffix(path: Path, suffix: str) -> Path:
    if path.suffix != suffix:
        raise HmtSlamError(f"{path} holds a bag's data under another suffix: rename it to {path.stem}{suffix}.")
    return path


def _decompress(path: Path, head: bytes) -> bytes:
    """The content of a file, decompressed."""
    content = path.read_bytes()
    try:
        if head.startswith(_GZIP):
            return gzip.decompress(content)
        if head.startswith(_XZ):
            return lzma.decompress(content)
    except (EOFError, zlib.error, gzip.BadGzipFile, lzma.LZMAError) as error:
        raise HmtSlamError(f"{path} is truncated or damaged ({error}): copy it anew.") from error
    return content
