"""The records of mcap files: their lengths are checked before a library reads them, and their checksums are written.

The rosbags library allocates what a length says, and writes no checksums. An mcap file is: eight bytes of magic;
records of one byte of kind, eight bytes of length and the content; the same magic. All numbers are little endian. See
the specification of MCAP for the fields of each kind.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO, NamedTuple
from zlib import crc32

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs.channels import ChannelCheck
from hmt_slam_ros.logs.unpacking import Allowance, DamageError, unpack
from hmt_slam_ros.untrusted_input import file_size, open_regular, shorten

_MAGIC = 8
"""Bytes at the beginning and at the end."""

_HEAD = 9
"""Bytes of a record before its content: kind and length."""

_FOOTER_BYTES = _HEAD + 20 + _MAGIC
"""Bytes of the footer record and of the magic at the end."""

_FOOTER, _CHANNEL, _MESSAGE, _CHUNK, _CHUNK_INDEX, _ATTACHMENT = 0x02, 0x04, 0x05, 0x06, 0x08, 0x09
"""Kinds of records."""

_CRC_AT = 24
"""Offset of the checksum in the content of a chunk: after two times and the size of its records."""

_MESSAGE_HEAD = 22
"""Bytes of a message before its content: topic, number and two times."""

_FREE_RECORDS, _BYTES_OF_RECORD = 200_000, 8
"""Records that a file may always have in its chunks, and packed bytes of each beyond; a message takes some 20."""

MAX_CHUNK_BYTES = 128_000_000
"""Of the records of one chunk, decompressed; writers make chunks of 1 to 4 MB."""

_MAX_SMALL_RECORD = 64_000_000
"""Bytes of a record that is read as a whole, such as a schema or an index."""


class _Record(NamedTuple):
    """A record: its kind, the offset of its content in the file, and the bytes of its content."""

    kind: int
    begin: int
    length: int


class _Placed(NamedTuple):
    """What the index repeats of a chunk: offset and length of its record, compression, compressed size and size."""

    offset: int
    length: int
    compression: str
    packed: int
    size: int


def check_mcap(path: Path) -> None:
    """Check lengths, sizes and checksums of a file, so that a library may read it.

    :raises HmtSlamError: where a length leads out of the file, a chunk has not the size or checksum that it states, or
        the index does not fit the chunks.
    """
    with open_regular(path) as file:
        try:
            _check(file, file_size(file))
        except (struct.error, UnicodeDecodeError, DamageError) as fault:
            raise HmtSlamError(f"{path} is truncated or damaged ({fault}): copy or record it anew.") from fault


def write_checksums(path: Path, chunks: Sequence[int]) -> None:
    """Write checksums of the chunks and of the index into a file that has none; no other byte changes.

    :param chunks: CRC-32 of the records of each chunk, in the order of the file.
    """
    with path.open("r+b") as file:
        size = file_size(file)
        places = [record.begin for record in _records(file, _MAGIC, size) if record.kind == _CHUNK]
        for begin, checksum in zip(places, chunks, strict=True):
            file.seek(begin + _CRC_AT)
            file.write(struct.pack("<I", checksum))
        file.seek(size - _MAGIC - 4)
        file.write(struct.pack("<I", crc32(_summary(file, size))))


def _check(file: BinaryIO, size: int) -> None:
    if size < 2 * _MAGIC + _HEAD:
        raise DamageError("it is cut off")
    check = _RecordCheck(file, _FREE_RECORDS + size // _BYTES_OF_RECORD)
    for record in _records(file, _MAGIC, size):
        check.add(record)
    summary = _summary(file, size)
    (checksum,) = struct.unpack("<I", _read(file, size - _MAGIC - 4, 4))
    if checksum and crc32(summary) != checksum:
        raise DamageError("the checksum of its index is wrong")
    start = _summary_start(file, size)
    for record in _records(file, start, size) if start else ():
        if record.kind == _CHUNK_INDEX:
            check.add_index(record)
        elif record.kind == _CHANNEL:
            check.add(record)


class _RecordCheck:
    """Checks the records of a file, one after the other, and then those of its index."""

    def __init__(self, file: BinaryIO, most: int) -> None:
        """:param most: records that all chunks may have."""
        self._file, self._most = file, most
        self._chunks: set[_Placed] = set()
        self._allowance = Allowance()
        self._channels = ChannelCheck()
        self._seen: set[bytes] = set()

    def add(self, record: _Record) -> None:
        """Check a record.

        :raises DamageError: where it is damaged, or out of proportion.
        """
        if record.kind == _CHUNK:
            self._add_chunk(record)
        elif record.kind not in (_MESSAGE, _ATTACHMENT) and record.length > _MAX_SMALL_RECORD:
            raise DamageError(f"the record at {record.begin} has {record.length} bytes")
        elif record.kind == _CHANNEL:
            self._add_channel(_read(self._file, record.begin, record.length))

    def add_index(self, record: _Record) -> None:
        """Check that a record of the index names a chunk that no other has named.

        :raises DamageError: where it does not.
        """
        try:
            self._chunks.remove(_indexed_chunk(_read(self._file, record.begin, record.length)))
        except KeyError:
            raise DamageError(f"the index at {record.begin} names no chunk, or one that was named") from None

    def _add_chunk(self, record: _Record) -> None:
        placed, records = _unpack_chunk(self._file, record, self._allowance)
        self._chunks.add(placed)
        at = 0
        while at < len(records):
            kind, length = struct.unpack_from("<BQ", records, at)
            at += _HEAD
            self._most -= 1
            if self._most < 0:
                raise DamageError("its chunks have more records than its bytes can hold")
            if length > len(records) - at or (kind == _MESSAGE and length < _MESSAGE_HEAD):
                raise DamageError(f"a record of the chunk at {record.begin} has {length} bytes")
            if kind == _CHANNEL:
                self._add_channel(bytes(records[at : at + length]))
            at += length

    def _add_channel(self, content: bytes) -> None:
        """Check a topic; the index and each chunk may repeat it."""
        if content in self._seen:
            return
        self._seen.add(content)
        topic, after = _text(content, 4)
        _, after = _text(content, after)
        at, end = after + 4, after + 4 + struct.unpack_from("<I", content, after)[0]
        qos = ""
        while at < end:
            key, at = _text(content, at)
            value, at = _text(content, at)
            qos = value if key == "offered_qos_profiles" else qos
        self._channels.add(shorten(topic), qos)


def _text(content: bytes, at: int) -> tuple[str, int]:
    """A text at an offset, and the offset after it."""
    (length,) = struct.unpack_from("<I", content, at)
    if length > len(content) - at - 4:
        raise DamageError("a text ends beyond its record")
    return content[at + 4 : at + 4 + length].decode(), at + 4 + length


def _records(file: BinaryIO, begin: int, size: int) -> Iterator[_Record]:
    """The records from an offset to the footer; a record that leads beyond the file is damage."""
    while begin + _HEAD <= size - _MAGIC:
        kind, length = struct.unpack("<BQ", _read(file, begin, _HEAD))
        if length > size - _MAGIC - begin - _HEAD:
            raise DamageError(f"the record at {begin} ends beyond the file")
        if kind == _FOOTER:
            if begin != size - _FOOTER_BYTES:
                raise DamageError(f"its footer is at {begin} instead of its end")
            return
        yield _Record(kind, begin + _HEAD, length)
        begin += _HEAD + length
    raise DamageError("its footer is missing")


def _read(file: BinaryIO, begin: int, count: int) -> bytes:
    file.seek(begin)
    return file.read(count)


def _summary_start(file: BinaryIO, size: int) -> int:
    """Offset of the index, 0 for none."""
    if size < _MAGIC + _FOOTER_BYTES:
        raise DamageError("its footer is missing")
    (start,) = struct.unpack("<Q", _read(file, size - _FOOTER_BYTES + _HEAD, 8))
    if start > size - _FOOTER_BYTES:
        raise DamageError("its index begins beyond the file")
    return int(start)


def _summary(file: BinaryIO, size: int) -> bytes:
    """The bytes that the checksum of the index covers: up to that checksum in the footer."""
    start = _summary_start(file, size) or size - _FOOTER_BYTES
    if size - start > _MAX_SMALL_RECORD:
        raise DamageError(f"its index has {size - start} bytes")
    return _read(file, start, size - _MAGIC - 4 - start)


def _unpack_chunk(file: BinaryIO, record: _Record, allowance: Allowance) -> tuple[_Placed, bytes | memoryview]:
    """What the index repeats of a chunk, and its records, which have the size and checksum that it states."""
    if record.length > MAX_CHUNK_BYTES:
        raise DamageError(f"the chunk at {record.begin} has {record.length} bytes")
    content = _read(file, record.begin, record.length)
    size, checksum, length = struct.unpack_from("<QII", content, 16)
    compression = content[32 : 32 + length].decode()
    (packed,) = struct.unpack_from("<Q", content, 32 + length)
    data = memoryview(content)[40 + length : 40 + length + packed]
    if size > MAX_CHUNK_BYTES:
        raise DamageError(f"the chunk at {record.begin} states {size} bytes")
    allowance.spend(record.length, size)
    records = unpack(data, compression, size)
    if len(data) != packed or len(records) != size:
        raise DamageError(f"the chunk at {record.begin} has another size than it states")
    if checksum and crc32(records) != checksum:
        raise DamageError(f"the checksum of the chunk at {record.begin} is wrong")
    return _Placed(record.begin - _HEAD, record.length + _HEAD, compression, packed, size), records


def _indexed_chunk(content: bytes) -> _Placed:
    """The chunk that an index of a chunk names."""
    offset, length, offsets = struct.unpack_from("<QQI", content, 16)
    (letters,) = struct.unpack_from("<I", content, 44 + offsets)
    compression = content[48 + offsets : 48 + offsets + letters].decode()
    packed, size = struct.unpack_from("<QQ", content, 48 + offsets + letters)
    return _Placed(offset, length, compression, packed, size)
