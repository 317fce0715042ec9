"""Text logs, rawlogs, settings and places in the file system that an attacker would choose."""

from __future__ import annotations

import gzip
import json
import lzma
import os
import shutil
import struct
from collections.abc import Callable
from pathlib import Path

from benchmark.fuzz.hostile_bags import ALIASES, MERGES, Hostile

_TAIL = "{stamp} host 0\n"
_FLASER = "FLASER 3 1 2 3 {x} 0 0 {x} 0 0 " + _TAIL
_ROBOTLASER = "ROBOTLASER1 0 -1 2 0.5 {maximum} 0.1 0 3 1 2 3 0 {x} {y} 0 {x} 0 0 0 0 0 0 0 " + _TAIL


def _text(make: Callable[[], str | bytes] | str | bytes, name: str = "log.clf") -> Hostile:
    def write(folder: Path, seeds: Path) -> Path:  # noqa: ARG001  others need the seeds
        content = make() if callable(make) else make
        (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
        return folder / name

    return write


def _scans(count: int, line: str = _FLASER, **fields: Callable[[int], object]) -> str:
    fields = {"x": float, "y": lambda k: 0.1, "maximum": lambda k: 80.0, "stamp": float} | fields
    return "".join(line.format(**{name: value(k) for name, value in fields.items()}) for k in range(count))


def _gzip_without_end(content: bytes, size: int) -> bytes:
    """A gzip file of the content over and over."""
    return gzip.compress(content * (20_000_000 // len(content)), 9) * (size // 20_000_000)


CARMEN: dict[str, Hostile] = {
    "line of 20 MB": _text(lambda: "FLASER 9999999 " + "1 " * 10_000_000),
    "line of 100 MB, packed": _text(lambda: gzip.compress(b"FLASER 3 " + b"1 " * 50_000_000), "log.gz"),
    "more readings than stated": _text(lambda: _FLASER.format(x=1, stamp=1).replace(" 3 ", " 2 ")),
    "fewer readings than stated": _text(lambda: _FLASER.format(x=1, stamp=1).replace(" 3 ", " 1000000000 ")),
    "less than none": _text(lambda: _FLASER.format(x=1, stamp=1).replace(" 3 ", " -3 ")),
    "count of 5000 digits": _text(lambda: _FLASER.format(x=1, stamp=1).replace(" 3 ", f" {'9' * 5000} ")),
    "count that is a real": _text(lambda: _FLASER.format(x=1, stamp=1).replace(" 3 ", " 3.0 ")),
    "no readings": _text(lambda: "FLASER 0 0 0 0 0 0 0 1 host 0\n" * 20),
    "digits of Arabia": _text(lambda: _FLASER.format(x=1, stamp="١٢٣")),
    "words of no ASCII": _text(lambda: "ODOM é à ü 0 0 0 1 höst 0\n"),
    "bytes of no text": _text(lambda: b"ODOM \xff\xfe \x00 0 0 0 1 host 0\n"),
    **{f"stamp {stamp[:8]}": _text(_scans(3) + _FLASER.format(x=4, stamp=stamp)) for stamp in
       ("nan", "inf", "-inf", "1e400", "1e-400", "1e999999999", "9" * 5000, "0x10", "1_000", "-5", "1.2.3", ".", "+", "1e18")},
    "stamps backwards": _text(lambda: _scans(200, stamp=lambda k: 200 - k)),
    "one stamp": _text(lambda: _scans(200, stamp=lambda k: 7)),
    "stamps far apart": _text(lambda: _scans(5, stamp=lambda k: k * 9e8)),
    "maxima of each scan": _text(lambda: _scans(20_000, _ROBOTLASER, maximum=lambda k: 50 + 1e-3 * k)),
    "lasers of each scan": _text(lambda: _scans(20_000, _ROBOTLASER, y=lambda k: 0.01 * k)),
    "lasers far away": _text(lambda: _scans(20, _ROBOTLASER, y=lambda k: 10.0**k)),
    "poses far apart": _text(lambda: _scans(50, x=lambda k: (-1) ** k * 9e6)),
    "angles beyond sense": _text(lambda: _scans(20, _ROBOTLASER).replace(" -1 2 0.5 ", " 1e308 1e308 1e308 ")),
    "comments alone": _text(lambda: "# message_name\n" * 500_000),
    "bomb of gzip": _text(lambda: _gzip_without_end(b"ODOM 0 0 0 0 0 0 1 h 0\n", 4_000_000_000), "log.gz"),
    "bomb of gzip of zeros": _text(lambda: _gzip_without_end(b"\0", 10_000_000_000), "log.gz"),
    "bomb of xz": _text(lambda: lzma.compress(bytes(300_000_000), preset=0), "log.xz"),
    "xz with a large dictionary": _text(lambda: lzma.compress(b"ODOM", filters=[{"id": lzma.FILTER_LZMA2, "dict_size": 1 << 29, "preset": 0}]), "log.xz"),
    "gzip in gzip": _text(lambda: gzip.compress(gzip.compress(_scans(9).encode())), "log.gz"),
    "gzip of nothing": _text(lambda: gzip.compress(b""), "log.gz"),
    "xz of nothing": _text(lambda: lzma.compress(b""), "log.xz"),
    "gzip cut off": _text(lambda: gzip.compress(_scans(999).encode())[:60], "log.gz"),
    "empty": _text(lambda: b""),
    "one byte": _text(lambda: b"\x1f"),
}  # fmt: skip


def thing(name: str, version: int, content: bytes) -> bytes:
    """An object of a rawlog."""
    return bytes([0x80 | len(name)]) + name.encode() + bytes([version]) + content + b"\x88"


def _nest(name: str, times: int) -> bytes:
    content = b""
    for _ in range(times):
        content = thing(name, 2 if name == "CSensoryFrame" else 0, struct.pack("<I", 1) + content)
    return content


def _matrix(rows: int, columns: int) -> bytes:
    return thing("CMatrixD", 0, struct.pack("<II", rows, columns))


_POSE = thing("CPose2D", 1, bytes(24))
_MOUNT = thing("CPose3D", 3, bytes(96))

RAWLOG: dict[str, Hostile] = {
    "frames in frames": _text(lambda: _nest("CSensoryFrame", 5000), "log.rawlog"),
    "actions in actions": _text(lambda: _nest("CActionCollection", 15), "log.rawlog"),
    "matrix of no rows": _text(lambda: _matrix(0, 2**32 - 1), "log.rawlog"),
    "matrix of all rows": _text(lambda: _matrix(2**32 - 1, 2**32 - 1), "log.rawlog"),
    "frame of 4 billion": _text(lambda: thing("CSensoryFrame", 2, b"\xff" * 4), "log.rawlog"),
    "frame of no scans, often": _text(lambda: thing("CSensoryFrame", 2, bytes(4)) * 200_000, "log.rawlog"),
    "scan of 4 billion beams": _text(lambda: thing("CObservation2DRangeScan", 8, bytes(9) + _MOUNT + b"\xff" * 4), "log.rawlog"),
    "mounting of zeros": _text(lambda: thing("CObservation2DRangeScan", 6, bytes(9) + _MOUNT + bytes(4) + bytes(4) + b"\x7f" * 8 + bytes(16)) * 9, "log.rawlog"),
    "times without end": _text(lambda: thing("CObservationOdometry", 0, _POSE + bytes(4) + b"\xff" * 8), "log.rawlog"),
    "text of 4 billion": _text(lambda: thing("CObservationOdometry", 0, _POSE + b"\xff" * 12), "log.rawlog"),
    "class of another program": _text(lambda: thing("CPickle", 0, b""), "log.rawlog"),
    "class of 127 letters": _text(lambda: thing("C" * 127, 0, b""), "log.rawlog"),
    "packed, of odometry alone": _text(lambda: _gzip_without_end(thing("CObservationOdometry", 2, _POSE + bytes(4) + b"\x7f" * 8 + bytes(2)), 1_000_000_000), "log.gz"),
}  # fmt: skip

YAML = (
    ALIASES, MERGES, "&a [*a]", "&a {a: *a}", "? &a [*a]\n: 1", "[" * 5000, "[" * 400_000, "{a: " * 3000, "- " * 5000, "? " * 5000,
    "a: " + "[" * 70 + "]" * 70, "mode: 2001-99-99", "mode: 2001-13-01T99:99:99Z", "seed: 1" + "0" * 400, "seed: -1" + "0" * 400,
    "seed: 0x" + "f" * 6000, "seed: 0b" + "1" * 6000, "seed: 0o9", "seed: 1:99:99", "seed: 190:20:30.15", "seed: 1e400", "seed: -.inf", "seed: .nan",
    "seed: " + "_" * 100, "seed: 0_", "seed: 1__0", "seed: +", "seed: ~", "seed: yes", "seed: [1]", "seed: {}", "seed: ''", "seed: 3.0", "seed: 1e3",
    "k" * 500_000 + ": 1", "? " + "k" * 2000 + "\n: 1", "? [a, b]\n: c", "? {a: b}\n: c", "? !!float .nan\n: 1", "true: 1", "null: 1", "1: 1", "'': 1",
    "seed: 1\nseed: 2", "a: !!python/object/apply:os.system [ls]", "a: !!python/name:os.system", "!!python/object/new:type [x]", "a: !!binary '*'",
    "a: !!binary AAAA", "a: !!timestamp x", "a: !!set {a}", "a: !!omap [a: 1]", "a: !!pairs [a: 1]", "a: !!merge <<", "!!merge <<: {a: 1}", "a: !!int x",
    "a: !!int [1]", "a: !!float {}", "a: !!bool maybe", "a: !!null x", "a: !!str [1]", "a: !!seq x", "a: !!map x", "a: !<tag:x> 1", "a: !e!x 1",
    "%TAG ! tag:yaml.org,2002:python/\n--- !name:os.system", "<<: 1", "<<: [1, 2]", "<<: [{a: 1}, {b: 2}]", "<<: {<<: {<<: {a: 1}}}", "a: 1\n<<: {a: 2}",
    "\x00", "seed: \x00", "\ufeffseed: 1", "seed: 1\ufeff", "\u2028seed: 1", "\x85seed: 1", "\x1b[31mseed: 1", "seed: \x7f", "\ufffe", "--- a\n--- b",
    "---\n---\n---", "...", "--- !!map\n", "%YAML 9.9\n---\na", "%YAML 1.1\n%YAML 1.1\n---\na", "%FOO\n---\na", "a: |\n", "a: |9\n x", "a: >-\n\n\n", "a: |\n" + " x\n" * 50_000,
    "'", '"', '"\\x', '"\\ud800"', '"\\U00110000"', '"\\uffff"', "a: b: c", "\ta: 1", "a:\n\tb: 1", "- a\nb: c", "@a", "`a", "a: @", "*a", "&a", "&", "*", "!", "[,]",
    "{,}", "[a", "{a", "a]", "a}", ": a", "- - - - a", "filter: []", "filter: {particles: {}}", "filter: {particles: 1e99}", "filter: {particles: -1}",
    "filter:\n  particles: 99999999999", "filter: {particles: nan}", "mode: ''", "mode: " + "m" * 100_000, "/**:\n  ros__parameters:\n    seed: 1",
    "/**: {ros__parameters: []}", "a" * 999_999, "[" + "1," * 490_000 + "]", "\n".join(f"k{k}: {k}" for k in range(60_000)), "\n" * 900_000, "#" * 900_000, " " * 900_000,
)  # fmt: skip
"""Documents for files of parameters and of worlds."""

YAML_BYTES = (
    b"\xff\xfe",
    b"\xfe\xff\x00s",
    b"\xff\xfes\x00",
    b"seed: \xff",
    b"\xc3(",
    b"\xed\xa0\x80",
    b"\xf4\x90\x80\x80",
    b"\x00\x00\xfe\xff",
    b"seed: \xc0\x80",
    b"\x80" * 9999,
)
"""The same, of no UTF-8."""  # fmt: skip

WORLDS = (
    {"walls": [[0, 0, 1e9, 0]], "route": [[1, 1], [1e9, 1]]},
    {"walls": [[0, 0, 1e308, 1e308]], "route": [[0, 0], [1e308, 0]]},
    {"walls": [[0, 0, 8, 0]] * 20_000, "route": [[1, 1], [7, 1]]},
    {"walls": [[0, 0, 8, 0]], "route": [[1, 1], [1, 1]]},
    {"walls": [[0, 0, 8, 0]], "route": [[1, 1]] * 20_000},
    {"walls": [[0, 0, 8, 0]], "route": [[k % 2, 1] for k in range(20_000)]},
    {"walls": [[0, 0, 8, 0]], "route": [[1, 1], [7, 1]], "settings": {"range": 1e300}},
    {"walls": [[0, 0, 8, 0]], "route": [[1, 1], [7, 1]], "settings": {"beams": 10**9}},
    {"walls": [[0, 0, 8, 0]], "route": [[1, 1], [7, 1]], "settings": {"rate": 1e12}},
    {"walls": [[0, 0, 8, 0]], "route": [[1, 1], [7, 1]], "settings": {"speed": 1e-12}},
    {"walls": [[0, 0, 8, 0]], "route": [[1, 1], [7, 1]], "settings": {"people": 10**9}},
    {"walls": [[0, 0, 8, 0]], "furniture": [[4, 3, 30, 10**9, 0.5]], "route": [[1, 1], [7, 1]]},
    {"walls": [[0, 0, 8, 0]], "furniture": [[4, 3, 1e9, 1, 1e-9]], "route": [[1, 1], [7, 1]]},
    {"walls": [], "route": [[1, 1], [7, 1]]},
    {"walls": [[0, 0, 0, 0]], "route": [[1, 1], [7, 1]]},
    {"walls": "x", "route": 3},
)
"""Worlds that are large, slow or none."""

_DOCUMENTS: tuple[str | bytes, ...] = (*YAML, *YAML_BYTES)
_FOR_WORLDS: tuple[str | bytes, ...] = (*YAML[:100:3], *YAML_BYTES)

SETTINGS: dict[str, Hostile] = {
    **{f"parameters {k}": _text(document, "config.yaml") for k, document in enumerate(_DOCUMENTS)},
    **{f"world {k}": _text(document, "world.yaml") for k, document in enumerate(_FOR_WORLDS)},
    **{f"built world {k}": _text(json.dumps(world), "world.yaml") for k, world in enumerate(WORLDS)},
}  # fmt: skip


def _place(make: Callable[[Path], object], name: str = "log") -> Hostile:
    def write(folder: Path, seeds: Path) -> Path:  # noqa: ARG001  others need the seeds
        make(folder / name)
        return folder / name

    return write


def _sparse(path: Path) -> None:
    path.touch()
    os.truncate(path, 2**40)


PLACES: dict[str, Hostile] = {
    "pipe": _place(os.mkfifo),
    "folder": _place(Path.mkdir),
    "device without end": _place(lambda path: path.symlink_to("/dev/zero")),
    "device of nothing": _place(lambda path: path.symlink_to("/dev/null")),
    "terminal": _place(lambda path: path.symlink_to("/dev/tty")),
    "memory of the process": _place(lambda path: path.symlink_to("/proc/self/mem")),
    "file of the kernel": _place(lambda path: path.symlink_to("/proc/self/environ")),
    "link to itself": _place(lambda path: path.symlink_to(path)),
    "link to nothing": _place(lambda path: path.symlink_to("/nowhere")),
    "nothing": _place(lambda path: None),
    "name too long": lambda folder, seeds: folder / ("x" * 300),
    "path too long": lambda folder, seeds: folder / "/".join(["x" * 200] * 40),
    "file as a folder": _place(lambda path: path.write_text("x")),
    "below a file": lambda folder, seeds: Path("/etc/hostname/x"),
    "sparse file of 1 TB": _place(_sparse),
    "name of no UTF-8": _place(lambda path: None, os.fsdecode(b"log\xff\xfe")),
    "name of two lines": _place(lambda path: path.write_text("x"), "log\nof two lines"),
}


def _result(name: str, make: Callable[[Path], str | bytes] | str) -> Hostile:
    """An output folder of which one file is replaced."""

    def write(folder: Path, seeds: Path) -> Path:
        shutil.copytree(seeds / "map" / "out", folder / "out")
        path = folder / "out" / name
        content = make(path) if callable(make) else make
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return folder / "out"

    return write


_LINE = "{} 0 0 0 0 0 0 1\n"

RESULTS: dict[str, Hostile] = {
    **{f"trajectory with {value[:9]}": _result("trajectory.tum", _LINE.format(value) * 9) for value in
       ("nan", "inf", "1e400", "x", "9" * 5000, "", "\0", "-1", "1_0", "٣")},
    "trajectory of one number": _result("trajectory.tum", lambda _: "1\n"),
    "trajectory of nothing": _result("trajectory.tum", lambda _: ""),
    "trajectory of a line without end": _result("trajectory.tum", lambda _: "1 " * 20_000_000),
    "trajectory of a million lines": _result("trajectory.tum", lambda _: "".join(f"{k} 0 0 0 0 0 0 1\n" for k in range(300_000))),
    "picture of 10 billion pixels": _result("map.pgm", lambda _: b"P5\n100000 100000\n255\n" + bytes(99)),
    "picture of no pixels": _result("map.pgm", lambda _: b"P5\n0 0\n255\n"),
    "picture of another kind": _result("map.pgm", lambda _: b"\x89PNG\r\n\x1a\n" + bytes(99)),
    "picture with a comment without end": _result("map.pgm", lambda _: b"P5\n#" + b"x" * 5_000_000),
    "report of depth": _result("report.json", lambda _: "[" * 200_000),
    "report of nothing": _result("report.json", lambda _: "{}"),
    "report of a number": _result("report.json", lambda _: "1" + "0" * 400),
    "report of NaN": _result("report.json", lambda _: '{"areas": NaN}'),
    "report of 60 MB": _result("report.json", lambda _: '{"a":[' + "0," * 20_000_000 + "0]}"),
    "table of nothing": _result("pmf.csv", lambda _: ""),
    "table of one column": _result("pmf.csv", lambda _: "x\n1\n"),
    "table of one line without end": _result("pmf.csv", lambda _: "1," * 5_000_000),
    "table of quotes": _result("pmf.csv", lambda _: '"' * 500_000),
    "cost of NaN": _result("cost.csv", lambda _: "slam_ms\nnan\ninf\n1e400\n"),
    "cost of NUL": _result("cost.csv", lambda _: "slam_ms\n\0\n"),
    "settings of aliases": _result("map.yaml", lambda _: ALIASES),
    "resolution 0": _result("map.yaml", lambda path: path.read_text().replace("resolution: ", "resolution: 0 #")),
    "manifest of depth": _result("hmt_map/manifest.json", lambda _: "[" * 90_000),
    "manifest of nothing": _result("hmt_map/manifest.json", lambda _: ""),
}  # fmt: skip
