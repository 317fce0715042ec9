"""Documents in a folder: what is written comes back, whatever is wrong has its sentence, and a crash loses nothing."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import pytest

from hmt_slam_ros.arrays import Bool, Float32, Float64
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.own_files import replace_folder
from hmt_slam_ros.saved_map.folder import FolderReader, FolderWriter
from hmt_slam_ros.saved_map.reference import document_reference
from hmt_slam_ros.sensors import Scan


class Place(NamedTuple):
    """A place.

    :ivar pose: shape (3,).
    :ivar certain: or not.
    """

    pose: Float64
    certain: bool


@dataclass(frozen=True)
class Pencil:
    """A pencil.

    :ivar length: m.
    :ivar kind: tells it from a pen.
    """

    length: float
    kind: Literal["pencil"] = "pencil"


@dataclass(frozen=True)
class Pen:
    """A pen.

    :ivar color: its name.
    :ivar kind: tells it from a pencil.
    """

    color: str
    kind: Literal["pen"] = "pen"


@dataclass(frozen=True, eq=False)
class Notebook:
    """All kinds of things.

    :ivar places: ``a_T_b`` by name.
    :ivar pairs: sets of numbers by pairs.
    :ivar scans: some scans.
    :ivar flags: shape (n,).
    :ivar ranges: shape (n, 2).
    :ivar doubt: a number, or None.
    :ivar tool: to write with.
    :ivar spare: another, or None.
    """

    places: Mapping[str, Place]
    pairs: Mapping[tuple[int, int], frozenset[int]]
    scans: tuple[Scan, ...]
    flags: Bool
    ranges: Float32
    doubt: float | None
    tool: Pencil | Pen
    spare: Pencil | Pen | None


def scan(stamp, first=1.0):
    return Scan(stamp, np.array([first, np.nan, np.inf], dtype=np.float32), -1.0, 1.0, 0.1, 30.0, np.arange(3.0), 1e-4)


def notebook(**changes):
    one = scan(5)
    content = {
        "places": {"b": Place(np.array([0.1, -0.0, 1e-300]), True), "a": Place(np.arange(6.0)[::2], False)},
        "pairs": {(2, 1): frozenset({9, 3, 5}), (1, 2): frozenset()},
        "scans": (one, scan(5, 2.0), one),
        "flags": np.array([True, False, True]),
        "ranges": np.asfortranarray(np.arange(4, dtype=np.float32).reshape(2, 2)),
        "doubt": None,
        "tool": Pen("blue"),
        "spare": None,
    }
    return Notebook(**content | changes)


def write_folder(directory, document=None, version=3):
    writer = FolderWriter(directory)
    document = document or notebook()
    writer.write("notes", document)
    writer.write("more", document)
    writer.write_text("words.txt", "hear\n")
    writer.finish("book", version)
    return directory


def read(directory, version=3):
    return FolderReader(directory, "book", version).read("notes", Notebook)


def files(directory):
    return {path.name: path.read_bytes() for path in sorted(directory.iterdir())}


def test_everything_comes_back_bit_for_bit_and_can_be_written_to(tmp_path):
    found = read(write_folder(tmp_path / "book"))
    wanted = notebook()
    assert list(found.places) == ["b", "a"]
    for name, place in wanted.places.items():
        assert found.places[name].pose.tobytes() == place.pose.tobytes()
        assert found.places[name].certain is place.certain
        found.places[name].pose[:] = 7.0
    assert found.pairs == wanted.pairs
    assert list(found.pairs) == [(2, 1), (1, 2)]
    assert found.doubt is None
    assert (found.tool, found.spare) == (Pen("blue"), None)
    for name in ("flags", "ranges"):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))
        assert getattr(found, name).dtype == getattr(wanted, name).dtype
    for one, other in zip(found.scans, wanted.scans, strict=True):
        assert one.ranges.tobytes() == other.ranges.tobytes()
        for name in ("stamp", "angle_min", "angle_increment", "range_min", "range_max", "time_increment"):
            assert getattr(one, name) == getattr(other, name)
        np.testing.assert_array_equal(one.laser_pose, other.laser_pose)


def test_a_scan_is_one_object_in_all_documents_and_two_of_one_stamp_stay_two(tmp_path):
    folder = FolderReader(write_folder(tmp_path / "book"), "book", 3)
    one, two = folder.read("notes", Notebook), folder.read("more", Notebook)
    assert one.scans[0] is one.scans[2] is two.scans[0]
    assert one.scans[1] is two.scans[1] is not one.scans[0]
    assert [found.stamp for found in one.scans] == [5, 5, 5]


def test_the_same_content_gives_the_same_bytes_and_what_is_read_gives_them_again(tmp_path):
    first, again = write_folder(tmp_path / "first"), write_folder(tmp_path / "again")
    assert files(first) == files(again)
    assert files(write_folder(tmp_path / "copy", read(first))) == files(first)


@pytest.mark.parametrize("name", ["notes.json", "notes.bin", "more.json", "scans.bin", "scans.json", "words.txt"])
def test_a_file_that_is_missing_cut_or_changed_is_named(tmp_path, name):
    path = write_folder(tmp_path / "book") / name
    whole = path.read_bytes()
    path.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    with pytest.raises(HmtSlamError, match=rf"{name} is damaged, its SHA-256 is not that of manifest\.json: take a"):
        read(tmp_path / "book")
    path.write_bytes(whole[: len(whole) // 2])
    wanted = rf"{name} is truncated or damaged, it has {len(whole) // 2} of {len(whole)} bytes: take a copy"
    with pytest.raises(HmtSlamError, match=wanted):
        read(tmp_path / "book")
    path.unlink()
    with pytest.raises(HmtSlamError, match=rf"{name} is missing or cannot be read \(No such file or directory\): take"):
        read(tmp_path / "book")


def test_any_changed_character_of_the_manifest_is_noticed(tmp_path):
    path = write_folder(tmp_path / "book") / "manifest.json"
    whole = path.read_text()
    for place in range(len(whole)):
        if whole[place].isalnum():
            path.write_text(whole[:place] + ("1" if whole[place] != "1" else "2") + whole[place + 1 :])
            with pytest.raises(HmtSlamError):
                read(tmp_path / "book")
    path.write_text(whole)
    read(tmp_path / "book")


def test_what_else_a_manifest_can_be_has_its_sentence(tmp_path):
    path = write_folder(tmp_path / "book") / "manifest.json"
    whole = path.read_text()
    with pytest.raises(HmtSlamError, match="is a book of version 3, this program reads version 4: map the log again"):
        read(tmp_path / "book", version=4)
    for content, sentence in {
        whole[:40]: "manifest.json is truncated or damaged, it is no JSON: take a copy",
        whole.replace('"book"', '"menu"'): "is of something else than a book: give an output folder, or the book in it",
        "[]": "is of something else than a book",
        whole.replace('"bytes"', '"size"'): "manifest.json is damaged, it is not as it was written: take a copy",
    }.items():
        path.write_text(content)
        with pytest.raises(HmtSlamError, match=sentence):
            read(tmp_path / "book")
    path.unlink()
    with pytest.raises(HmtSlamError, match=r"holds no book, there is no manifest\.json to read"):
        read(tmp_path / "book")


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (
            {"tool": Pen("blue", "ink")},
            r"notes\.tool\.kind = ink is not pencil or pen: see docs/reference/map_format.md",
        ),
        ({"spare": 3}, r"notes\.spare = 3 is not an object: see docs/reference/map_format.md"),
        ({"doubt": "much"}, r"notes\.doubt = much is not a finite number: see docs/reference/map_format.md"),
        (
            {"flags": np.zeros(2)},
            r"notes\.flags = .*float64.* is not an array of bool: see docs/reference/map_format.md",
        ),
        ({"scans": (7,)}, r"notes\.scans\[0\] = 7 is no scan of the map"),
        ({"pairs": {(1,): frozenset()}}, r"notes\.pairs\[0\]\[0\] = \[1\] is not a list of 2"),
        ({"pairs": {(1, 2): frozenset({"x"})}}, r"notes\.pairs\[0\]\[1\]\[0\] = x is not a whole number"),
        ({"places": ({"pose": 1},)}, r"notes\.places\[0\] = .* is not a list of 2"),
    ],
)
def test_a_document_of_another_form_is_refused_by_name(tmp_path, change, sentence):
    with pytest.raises(HmtSlamError, match=sentence):
        read(write_folder(tmp_path / "book", notebook(**change)))


def test_an_array_beyond_its_file_and_a_key_that_comes_twice_are_refused(tmp_path):
    for old, new, sentence in (
        ('"shape":[3],"at":48', '"shape":[3000],"at":48', r"notes\.flags = .* is not an array"),
        ("[[1,2],[]]", "[[2,1],[]]", r"notes\.pairs = .* is not a list of pairs with different keys"),
    ):
        directory = tmp_path / str(len(new))
        writer = FolderWriter(directory)
        writer.write("notes", notebook())
        text = (directory / "notes.json").read_text()
        assert old in text
        writer.write_text("notes.json", text.replace(old, new))
        writer.finish("book", 3)
        with pytest.raises(HmtSlamError, match=sentence):
            read(directory)


def test_the_description_tells_every_field_of_every_object():
    lines = document_reference({"notes": Notebook})
    assert "### Document `notes`" in lines
    assert "| `places` | list of [text, `Place`] | `a_T_b` by name. |" in lines
    assert (
        "| `pairs` | list of [[whole number, whole number], ordered list of whole number] | sets of numbers by pairs. |"
        in lines
    )
    assert "| `scans` | list of name of a scan | some scans. |" in lines
    assert "| `doubt` | number, or null | a number, or None. |" in lines
    assert "| `pose` | array of float64 | shape (3,). |" in lines
    assert "| `tool` | `Pencil` or `Pen` | to write with. |" in lines
    assert "| `spare` | `Pencil` or `Pen`, or null | another, or None. |" in lines


def test_one_folder_takes_the_place_of_another(tmp_path):
    for name in ("old", "new"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "content").write_text(name)
    replace_folder(tmp_path / "new", tmp_path / "old")
    assert (tmp_path / "old" / "content").read_text() == "new"
    assert (tmp_path / "new" / "content").read_text() == "old"
    replace_folder(tmp_path / "new", tmp_path / "third")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["old", "third"]


_SAVER = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from test_saved_map import write_folder
from hmt_slam_ros.own_files import replace_folder

target, turn = Path(sys.argv[1]), 0
while True:
    turn += 1
    replace_folder(write_folder(target.with_name(f"next-{turn}"), version=3), target)
    print(turn, flush=True)
"""


def test_whenever_a_saving_process_is_killed_there_is_a_whole_map(tmp_path):
    """It saves again and again, and is killed at moments spread over what saving once takes."""
    target = write_folder(tmp_path / "book")
    for round_ in range(5):
        command = [sys.executable, "-c", _SAVER, str(target), str(Path(__file__).parent)]
        environment = dict(os.environ) | {"PYTHONPATH": os.pathsep.join(sys.path)}
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment, cwd=tmp_path) as process:
            assert process.stdout.readline() == "1\n"
            for _ in range(5):
                read(target)
            try:
                process.wait(timeout=0.005 * round_)
            except subprocess.TimeoutExpired:
                process.send_signal(signal.SIGKILL)
        assert process.returncode == -signal.SIGKILL
        read(target)
        for left in tmp_path.glob("next-*"):
            subprocess.run(["rm", "-r", str(left)], check=True)


def test_json_of_a_document_is_one_line_that_any_program_reads(tmp_path):
    directory = write_folder(tmp_path / "book")
    content = json.loads((directory / "notes.json").read_text())
    entry = content["places"][1][1]["pose"]
    array = np.fromfile(directory / "notes.bin", entry["type"], int(np.prod(entry["shape"])), offset=entry["at"])
    assert array.tolist() == [0.0, 2.0, 4.0]
