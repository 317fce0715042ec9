"""Bags that an attacker would write: each is valid up to one thing that costs memory, time or a traceback."""

from __future__ import annotations

import os
import shutil
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path

from lz4.frame import compress as lz4_compress
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from hmt_slam_ros.logs.bag_files import read_messages
from hmt_slam_ros.logs.ros_types import ODOMETRY, typestore

MAGIC = b"\x89MCAP0\r\n"
BOMB = bytes(120_000_000)

Hostile = Callable[[Path, Path], Path]
"""Writes into a folder, given the folder of the seeds, and returns what is given to the command."""

ALIASES = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{new}: &{new} [{','.join([f'*{old}'] * 9)}]\n" for old, new in zip("abcdefghi", "bcdefghij", strict=True)
)
MERGES = "a: &a {k: 1}\n" + "".join(
    f"{new}: &{new} {{<<: [{','.join([f'*{old}'] * 9)}]}}\n" for old, new in zip("abcdefghi", "bcdefghij", strict=True)
)
QOS = (
    ALIASES,
    MERGES,
    "[" * 100_000,
    "{a: " * 20_000,
    "2001-99-99",
    "1" + "0" * 400,
    "- history: !!python/name:os.system",
)
"""Qualities of service that hang, overflow or end a parser of YAML."""


def compress_zstd(content: bytes) -> bytes:
    """Content in one frame, by the library that rosbags comes with."""
    try:
        from backports import zstd  # noqa: PLC0415  one of the two
    except ImportError:
        import zstandard  # noqa: PLC0415

        return bytes(zstandard.ZstdCompressor().compress(content))
    return bytes(zstd.compress(content))


def text(value: bytes) -> bytes:
    """A text or a map of MCAP."""
    return struct.pack("<I", len(value)) + value


def record(kind: int, content: bytes) -> bytes:
    """A record of MCAP."""
    return struct.pack("<BQ", kind, len(content)) + content


def channel(number: int, topic: bytes, qos: bytes = b"") -> bytes:
    """The record of a topic."""
    pairs = text(b"offered_qos_profiles") + text(qos) if qos else b""
    return record(4, struct.pack("<HH", number, 1) + text(topic) + text(b"cdr") + text(pairs))


def chunk(records: bytes, compression: bytes = b"", packed: bytes | None = None, size: int | None = None) -> bytes:
    """The record of a chunk."""
    data = records if packed is None else packed
    stated = len(records) if size is None else size
    head = struct.pack("<QQQI", 0, 2**62, stated, 0) + text(compression) + struct.pack("<Q", len(data))
    return record(6, head + data)


def index(offset: int, length: int, compression: bytes, packed: int, size: int) -> bytes:
    """The record of the index for a chunk."""
    return record(
        8, struct.pack("<QQQQ", 0, 2**62, offset, length) + text(b"") + struct.pack("<Q", 0) + text(compression)
        + struct.pack("<QQ", packed, size),
    )  # fmt: skip


def mcap(*parts: bytes, summary: bytes = b"") -> bytes:
    """An mcap file of some records."""
    head = MAGIC + record(1, text(b"ros2") + text(b"x")) + b"".join(parts) + record(15, bytes(4))
    start = len(head) if summary else 0
    return head + summary + record(2, struct.pack("<QQI", start, 0, 0)) + MAGIC


_HEAD = len(MAGIC) + len(record(1, text(b"ros2") + text(b"x")))


def _indexed_file(packed: bytes, compression: bytes, size: int, times: int) -> bytes:
    """A file with one chunk, which the index names some times."""
    one = chunk(b"", compression, packed, size)
    return mcap(one, summary=index(_HEAD, len(one), compression, len(packed), size) * times)


def _file(content: Callable[[], bytes], name: str = "bag.mcap") -> Hostile:
    def write(folder: Path, seeds: Path) -> Path:  # noqa: ARG001  others need the seeds
        (folder / name).write_bytes(content())
        return folder / name

    return write


def _message(number: int, stamp: int, content: bytes) -> bytes:
    return record(5, struct.pack("<HIQQ", number, 0, stamp, stamp) + content)


_SCHEMA = record(3, struct.pack("<H", 1) + text(b"nav_msgs/msg/Odometry") + text(b"ros2msg") + text(b"Odometry again"))


def _with_quality(qos: str) -> bytes:
    return mcap(channel(1, b"/odom", qos.encode()))


MCAP: dict[str, Hostile] = {
    "chunk named twice": _file(lambda: _indexed_file(compress_zstd(bytes(1_000_000)), b"zstd", 1_000_000, 100_000)),
    "bomb of zstd": _file(lambda: _indexed_file(compress_zstd(BOMB), b"zstd", len(BOMB), 1)),
    "bomb of lz4": _file(lambda: _indexed_file(lz4_compress(BOMB), b"lz4", len(BOMB), 1)),
    "many bombs": _file(lambda: mcap(*[chunk(b"", b"zstd", compress_zstd(BOMB), len(BOMB))] * 500)),
    "size beyond the chunk": _file(lambda: mcap(chunk(b"", b"zstd", compress_zstd(b"x" * 99), 2**40))),
    "less than the chunk states": _file(lambda: mcap(chunk(b"", b"zstd", compress_zstd(BOMB), 10))),
    "unknown compression": _file(lambda: mcap(chunk(b"x" * 30, b"\xff\x00lzma"))),
    "chunk in a chunk": _file(lambda: mcap(chunk(chunk(b"") * 9))),
    "records without content": _file(lambda: mcap(chunk(record(0x80, b"") * 1_000_000))),
    "short messages": _file(lambda: mcap(_SCHEMA, channel(1, b"/odom"), record(5, b"x"))),
    "short messages in a chunk": _file(lambda: mcap(_SCHEMA, channel(1, b"/odom"), chunk(record(5, b"xyz")))),
    "message of no bytes": _file(lambda: mcap(_SCHEMA, channel(1, b"/odom"), _message(1, 5, b""))),
    "message of few bytes": _file(lambda: mcap(_SCHEMA, channel(1, b"/odom"), _message(1, 5, b"\0\1\0\0" + bytes(9)))),
    "times backwards": _file(lambda: mcap(_SCHEMA, channel(1, b"/odom"), _message(1, 9, b""), _message(1, 5, b""))),
    "many topics": _file(lambda: mcap(*(channel(k, b"/odom", b"[{history: %d}]" % k) for k in range(60_000)))),
    "footer in the middle": _file(lambda: mcap(record(2, bytes(20)), chunk(b"", b"zstd", compress_zstd(BOMB), 120_000_000))),
    "summary before the data": _file(lambda: mcap(summary=_SCHEMA)[:-36] + struct.pack("<QQI", 3, 0, 0) + MAGIC),
    "text beyond its record": _file(lambda: mcap(record(4, struct.pack("<HHI", 1, 1, 2**31)))),
    "definition within itself": _file(lambda: mcap(_SCHEMA, channel(1, b"/odom"), _message(1, 1, bytes(900)))),
    "definition of 60 MB": _file(lambda: mcap(record(3, struct.pack("<H", 1) + text(b"x") + text(b"ros2msg") + text(bytes(60_000_000))))),
    "topic of no text": _file(lambda: mcap(channel(1, b"\xff\xfe/odom"))),
    **{f"quality of service {k}": _file(partial(_with_quality, qos)) for k, qos in enumerate(QOS)},
}  # fmt: skip


def _base(*statements: str, messages: bool = True) -> Hostile:
    def write(folder: Path, seeds: Path) -> Path:
        path = folder / "bag.db3"
        shutil.copy(seeds / "sqlite" / "bag" / "bag.db3", path)
        with closing(sqlite3.connect(path)) as base:
            if not messages:
                base.execute("DROP TABLE messages")
            base.executescript(";".join(statements))
            base.commit()
        return path

    return write


_NUMBERS = "WITH RECURSIVE n(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n LIMIT {})"
_ENDLESS = (
    "WITH RECURSIVE n(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n) SELECT k AS id, 1 AS topic_id, k AS timestamp"
)

SQLITE: dict[str, Hostile] = {
    "messages without end": _base(f"CREATE VIEW messages AS {_ENDLESS}, x'00' AS data FROM n", messages=False),
    "topics without end": _base("ALTER TABLE topics RENAME TO t", f"CREATE VIEW topics AS {_ENDLESS} FROM n"),
    "computed bytes": _base(
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB AS (zeroblob(900000000)))",
        f"INSERT INTO messages(topic_id, timestamp) {_NUMBERS.format(9)} SELECT k, k FROM n", messages=False),
    "check that computes": _base(
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB, CHECK(length(hex(zeroblob(400000000))) > 1))",
        messages=False),
    "index that computes": _base("CREATE INDEX i ON messages(length(hex(zeroblob(id))))"),
    "number in place of bytes": _base("UPDATE messages SET data = 3000000000"),
    "text in place of bytes": _base("UPDATE messages SET data = 'abc' WHERE id % 7 = 0"),
    "nothing in place of bytes": _base(
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)",
        "INSERT INTO messages VALUES(1, 1, 1, NULL)", messages=False),
    "text in place of a time": _base("UPDATE messages SET timestamp = 'later' WHERE id = 3"),
    "largest time": _base("UPDATE messages SET timestamp = 9223372036854775807 WHERE id = 3"),
    "smallest time": _base("UPDATE messages SET timestamp = -9223372036854775808 WHERE id = 3"),
    "many topics": _base(f"INSERT INTO topics {_NUMBERS.format(100000)} SELECT k + 100, '/scan', 'x', 'cdr', '', '' FROM n"),
    "many definitions": _base(f"INSERT INTO message_definitions {_NUMBERS.format(100000)} SELECT k + 100, 'x', 'ros2msg', '', '' FROM n"),
    "topics of one number": _base(
        "ALTER TABLE topics RENAME TO t", "CREATE TABLE topics(id INTEGER, name, type, serialization_format, offered_qos_profiles, type_description_hash)",
        f"INSERT INTO topics {_NUMBERS.format(1900)} SELECT 1, '/scan', 'x', 'cdr', '', '' FROM n"),
    "bytes of 200 MB": _base("UPDATE messages SET data = zeroblob(200000000) WHERE id = 5"),
    "scan of zeros": _base("UPDATE messages SET data = zeroblob(20000000) WHERE topic_id = 1 AND id < 20"),
    "topic that is a number": _base("UPDATE topics SET name = 7, type = 7"),
    "encoding unknown": _base("UPDATE message_definitions SET encoding = 'nothing'"),
    "version from the future": _base("UPDATE schema SET schema_version = 99999"),
    "version that is a text": _base("UPDATE schema SET schema_version = schema_version", "ALTER TABLE schema RENAME COLUMN schema_version TO v"),
    "no messages": _base("DELETE FROM messages"),
    "no topics": _base("DELETE FROM topics"),
    "no table": _base("DROP TABLE topics"),
    "no column": _base("ALTER TABLE messages DROP COLUMN data"),
    "virtual table": _base("CREATE VIRTUAL TABLE v USING fts5(x)"),
    **{f"quality of service {k}": _base(f"UPDATE topics SET offered_qos_profiles = '{qos}'") for k, qos in enumerate(QOS)},
}  # fmt: skip


def _pages(change: Callable[[bytearray, int], None]) -> Hostile:
    """A database of which the pages are changed, given their size."""

    def write(folder: Path, seeds: Path) -> Path:
        content = bytearray((seeds / "sqlite" / "bag" / "bag.db3").read_bytes())
        change(content, struct.unpack_from(">H", content, 16)[0])
        (folder / "bag.db3").write_bytes(content)
        return folder / "bag.db3"

    return write


def _interior_to_itself(content: bytearray, size: int) -> None:
    """Let the children of each interior page be the page itself."""
    for page in range(1, len(content) // size):
        at = page * size
        if content[at] in (2, 5):
            (cells,) = struct.unpack_from(">H", content, at + 3)
            for cell in range(cells):
                (pointer,) = struct.unpack_from(">H", content, at + 12 + 2 * cell)
                struct.pack_into(">I", content, at + pointer, page + 1)
            struct.pack_into(">I", content, at + 8, page + 1)


def _copy_pages(content: bytearray, size: int) -> None:
    for page in range(3, len(content) // size, 2):
        content[page * size : (page + 1) * size] = content[(page - 1) * size : page * size]


def _zero_pages(content: bytearray, size: int) -> None:
    for page in range(5, len(content) // size, 7):
        content[page * size : (page + 1) * size] = bytes(size)


SQLITE |= {
    "pages that lead to themselves": _pages(_interior_to_itself),
    "pages twice": _pages(_copy_pages),
    "pages of zeros": _pages(_zero_pages),
    "page size 1": _pages(lambda content, _: struct.pack_into(">H", content, 16, 1)),
    "more pages than bytes": _pages(lambda content, _: struct.pack_into(">I", content, 28, 2**31)),
}


def _folder(change: Callable[[Path, str], str | None], kind: str = "sqlite") -> Hostile:
    """A bag folder of which the metadata are changed."""

    def write(folder: Path, seeds: Path) -> Path:
        bag = folder / "bag"
        shutil.copytree(seeds / kind / "bag", bag)
        path = bag / "metadata.yaml"
        changed = change(bag, path.read_text(encoding="utf-8"))
        if changed is not None:
            path.write_text(changed, encoding="utf-8")
        return bag

    return write


def _bomb_as_file(bag: Path, metadata: str) -> str:
    (bag / "bag.db3").unlink()
    (bag / "bag.db3.zstd").write_bytes(compress_zstd(BOMB) * 60)
    return _pack_metadata(metadata, "FILE").replace("bag.db3", "bag.db3.zstd")


def _pack_metadata(metadata: str, mode: str) -> str:
    lines = [line for line in metadata.split("\n") if "compression_" not in line]
    lines.insert(1, f"  compression_format: zstd\n  compression_mode: {mode}")
    return "\n".join(lines)


def _as_sqlite(bag: Path, metadata: str) -> str:
    (bag / "bag.mcap").rename(bag / "bag.db3")
    return metadata.replace("bag.mcap", "bag.db3")


def _replace(path: Path, make: Callable[[Path], object]) -> None:
    path.unlink()
    make(path)


FOLDERS: dict[str, Hostile] = {
    "bomb as a file": _folder(_bomb_as_file),
    "packed, but is not": _folder(lambda _, text: _pack_metadata(text, "MESSAGE")),
    "packed by nothing known": _folder(lambda _, text: _pack_metadata(text, "MESSAGE").replace("zstd", "rot13")),
    "file twice": _folder(lambda _, text: text.replace("  - bag.db3", "  - bag.db3\n  - bag.db3")),
    "file above": _folder(lambda _, text: text.replace("- bag.db3", "- ../../../../etc/passwd")),
    "file that is its folder": _folder(lambda _, text: text.replace("- bag.db3", "- .")),
    "mcap under the name of sqlite": _folder(_as_sqlite, "mcap"),
    "file that is a pipe": _folder(lambda bag, _: _replace(bag / "bag.db3", os.mkfifo)),
    "file that is a folder": _folder(lambda bag, _: _replace(bag / "bag.db3", Path.mkdir)),
    "file that is a device": _folder(lambda bag, _: _replace(bag / "bag.db3", lambda path: path.symlink_to("/dev/zero"))),
    "file that leads to itself": _folder(lambda bag, _: _replace(bag / "bag.db3", lambda path: path.symlink_to(path))),
    "metadata that are a pipe": _folder(lambda bag, _: _replace(bag / "metadata.yaml", os.mkfifo)),
    "metadata of aliases": _folder(lambda _, text: text + ALIASES),
    "metadata of merges": _folder(lambda _, text: text + MERGES),
    "metadata of a megabyte": _folder(lambda _, text: text + "  custom_data: {" + ", ".join(f"k{k}: {k}" for k in range(60_000)) + "}\n"),
    "metadata without an end": _folder(lambda _, text: text + "x: " + "[" * 90_000),
    "metadata of nothing": _folder(lambda *_: ""),
    "metadata of a number": _folder(lambda *_: "7"),
    "metadata of zeros": _folder(lambda *_: "\0" * 99),
    "topics of a number": _folder(lambda _, text: text.replace("topics_with_message_count:", "topics_with_message_count: 3\n  other:")),
}  # fmt: skip


def _write_packed_messages(folder: Path, seeds: Path) -> Path:
    """A bag of compressed messages, each of which is a bomb."""
    bag = folder / "bag"
    writer = Writer(bag, version=8, storage_plugin=StoragePlugin.SQLITE3)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/odom", ODOMETRY, typestore=typestore())
        for number, message in enumerate(read_messages(seeds / "sqlite" / "bag", {"/odom"})):
            writer.write(connection, number, message.content + BOMB[:60_000_000])
            if number == 20:
                break
    return bag


FOLDERS["messages that are bombs"] = _write_packed_messages
