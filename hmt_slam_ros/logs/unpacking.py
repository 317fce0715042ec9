"""Compressed parts of bags, unpacked within limits: zstd and lz4."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO, cast

from hmt_slam_ros.untrusted_input import open_regular, shorten

MAX_CONTENT = 16_000_000
"""Bytes that a bag may always unpack to."""

MAX_RATIO = 300
"""Of unpacked to packed bytes beyond that; scans without any return reach 285."""

_PIECE = 1 << 20
"""Bytes of one step of unpacking a file."""


class DamageError(Exception):
    """What is wrong with a file of a bag."""


class Allowance:
    """How many bytes a bag may still unpack to, so that a small file cannot fill memory, disk or time."""

    def __init__(self) -> None:
        self._left = MAX_CONTENT

    def spend(self, packed: int, size: int) -> None:
        """Count packed bytes and what they unpack to.

        :raises DamageError: where the content is out of proportion to the file.
        """
        self._left += MAX_RATIO * packed - size
        if self._left < 0:
            raise DamageError(f"its content is more than {MAX_RATIO} times as large as the file")


def unpack(data: bytes | memoryview, compression: str, size: int) -> bytes | memoryview:
    """At most one byte more than the size of some compressed content.

    :param compression: "zstd", "lz4" or "" for none.
    :raises DamageError: where it cannot be unpacked.
    """
    if compression == "":
        return data
    if compression not in ("zstd", "lz4"):
        raise DamageError(f"it is compressed with {shorten(compression)}")
    try:
        if compression == "lz4":
            from lz4.frame import LZ4FrameDecompressor  # noqa: PLC0415  few bags need it

            return bytes(LZ4FrameDecompressor().decompress(data, max_length=size + 1))
        return _unpack_zstd(data, size)
    except Exception as fault:  # each library has its own
        raise DamageError(f"a part of it cannot be decompressed, {shorten(fault)}") from fault


def _unpack_zstd(data: bytes | memoryview, size: int) -> bytes:
    try:
        from backports import zstd  # noqa: PLC0415  the rosbags library comes with one of the two
    except ImportError:
        import zstandard  # noqa: PLC0415

        with zstandard.ZstdDecompressor().stream_reader(data) as reader:
            return bytes(reader.read(size + 1))
    return bytes(zstd.ZstdDecompressor().decompress(data, size + 1))


def unpack_file(packed: Path, target: Path, allowance: Allowance) -> None:
    """Write the content of a file that is compressed with zstd.

    :raises HmtSlamError: where the file cannot be read.
    :raises DamageError: where it cannot be unpacked, or to too much.
    :raises OSError: where the target cannot be written.
    """
    with open_regular(packed) as file, target.open("wb") as written:
        stream, read = _zstd_stream(file), 0
        while True:
            try:
                piece = stream.read(_PIECE)
            except Exception as fault:  # each library has its own
                raise DamageError(f"it cannot be decompressed, {shorten(fault)}") from fault
            if not piece:
                return
            allowance.spend(file.tell() - read, len(piece))
            read = file.tell()
            written.write(piece)


def _zstd_stream(file: BinaryIO) -> BinaryIO:
    try:
        from backports import zstd  # noqa: PLC0415  see above
    except ImportError:
        import zstandard  # noqa: PLC0415

        reader = zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True)
        return cast("BinaryIO", reader)
    return cast("BinaryIO", zstd.open(file, "rb"))
