"""Maps that were tampered with behind right checksums: no process is handed one."""

import hashlib
import json
import os
import shutil
from pathlib import Path
from typing import get_args, get_origin, get_type_hints

import numpy as np
import pytest

from hmt_slam_ros.cli.main import main
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.plain_data import field_names, is_record
from hmt_slam_ros.results.hmt_map import PARTS, ChainState, MapDocument, read_run_state, read_saved_map
from hmt_slam_ros.saved_map.field_limits import _LIMITS, _SHAPES
from hmt_slam_ros.saved_map.folder import FORMAT, MANIFEST, VERSION, FolderReader, _manifest_digest
from hmt_slam_ros.saved_map.scans import ScanTable
from hmt_slam_ros.saved_map.validation import _CHECKS
from hmt_slam_ros.sensors import Scan

BUNDLED = Path(__file__).parents[1] / "data" / "malaga_one_loop"


def records_of(kind, found):
    """All records that a value of a class can hold."""
    for argument in get_args(kind):
        records_of(argument, found)
    if is_record(kind) and kind is not Scan and kind.__name__ not in found:
        found[kind.__name__] = kind
        for hint in get_type_hints(kind).values():
            records_of(hint, found)
    return found


RECORDS = {}
for part in (*PARTS.values(), MapDocument, ChainState, ScanTable):
    records_of(part, RECORDS)


def test_every_array_of_every_record_has_a_shape():
    arrays = {
        (name, entry)
        for name, kind in RECORDS.items()
        for entry, hint in get_type_hints(kind).items()
        if entry in field_names(kind) and get_origin(hint) is np.ndarray
    }
    assert arrays == {(name, entry) for name, entries in _SHAPES.items() for entry in entries}


def test_every_name_in_the_tables_is_one_of_a_record():
    assert _CHECKS.keys() <= RECORDS.keys()
    assert _LIMITS.keys() <= {name for kind in RECORDS.values() for name in field_names(kind)}


@pytest.fixture(scope="module")
def map_folder(tmp_path_factory):
    """A map of the first seconds of the bundled log."""
    out = tmp_path_factory.mktemp("run") / "out"
    arguments = ["--duration", "3", "--set", "filter.particles=2"]
    assert main(["map", str(BUNDLED), "--out", str(out), *arguments]) == 0
    return out / "hmt_map"


def tamper(map_folder, folder, name, change):
    """A copy of a map with one changed file, behind right checksums.

    :param change: of the content of the file, bytes, or of its JSON.
    """
    shutil.copytree(map_folder, folder)
    path = folder / name
    if name.endswith(".json") and name != MANIFEST:
        document = json.loads(path.read_text())
        change(document)
        path.write_text(json.dumps(document))
    else:
        path.write_bytes(change(path.read_bytes()))
    manifest = json.loads((folder / MANIFEST).read_text())
    for listed, entry in manifest["files"].items():
        content = (folder / listed).read_bytes()
        entry["bytes"], entry["sha256"] = len(content), hashlib.sha256(content).hexdigest()
    manifest["sha256"] = _manifest_digest(manifest)
    (folder / MANIFEST).write_text(json.dumps(manifest))
    return folder


def put(*path, value):
    """A change that sets a value at a path of keys and indices."""

    def change(document):
        for step in path[:-1]:
            document = document[step]
        document[path[-1]] = value

    return change


def enlarge(content):
    """Parameters with a larger local map than the grids have."""
    return content.replace(b"extent: 56.0", b"extent: 156.0")


def fill(value):
    """A change that sets all numbers of a file of float64."""
    return lambda content: np.full(len(content) // 8, value).tobytes()


@pytest.mark.parametrize(
    ("name", "change", "sentence"),
    [
        ("slam.json", put("keyframe_events", value=-1), r"slam\.keyframe_events = -1 is not 0 to"),
        ("slam.json", put("keyframe_events", value=2**70), "an integer of 22 digits needs more than 64 bits"),
        ("slam.json", put("path_length", value=1e308), r"slam\.path_length = 1e\+308 is not 0 to"),
        ("slam.json", put("path_length", value=float("nan")), "NaN is no finite number"),
        ("slam.json", put("replica", "probabilities", value=[[0, 1.5]]), r"probabilities = 1\.5 is not 0 to 1"),
        ("slam.json", put("replica", "probabilities", value=[]), "is not of the hypotheses of changes"),
        ("slam.json", put("replica", "robot_areas", value=[[0, 7]]), "robot_areas = 7 is not an area of the"),
        ("slam.json", put("replica", "scans", value=[]), "scans = without .* is not a scan for every keyframe"),
        ("slam.json", put("replica", "max_area_id", value=2**40), r"max_area_id = 1099511627776 is not -1 to 1e\+06"),
        ("slam.json", put("scan_queue", "last_stamp", value=[[]]), "last_stamp = .* is not a whole number"),
        ("rtl.bin", fill(np.nan), "= NaN or infinite is not finite"),
        ("slam.bin", fill(1e300), "is not"),
        ("map.bin", fill(-1.0), "is not"),
        ("scans.bin", fill(np.nan), "is not"),
        ("aam.json", put("graphs", value=[]), "graphs = .* is not graphs of the state"),
        ("aam.json", put("partitions", value=[]), "partitions = .* is not those of replica"),
        ("tsbi.json", put("next_hypothesis", value=0), r"tsbi\.next_hypothesis = 0 is not above 0"),
        ("tsbi.json", put("unexamined", value=-0.5), r"tsbi\.unexamined = -0\.5 is not 0 to 1"),
        ("tlca.json", put("paths", value=[]), r"tlca\.paths = \[\] is not those of replica"),
        ("log.json", put("first_scans", value=[]), r"log\.first_scans = \(\) is not from 0 to"),
        ("log.json", put("records_read", value=0), r"log\.records_read = 0 is not as many as"),
        ("recorder.json", put("parents", value=[[1, 2], [2, 1]]), r"recorder\.parents = .* is not older than"),
        ("recorder.json", put("events", value=2**30), r"recorder\.events = 1073741824 is not .*, as of slam"),
        ("rtl.json", put("ambiguity", "shape", value=[-3, -3]), r"rtl\.ambiguity = .* is not an array of float64"),
        ("rtl.json", put("ambiguity", "shape", value=[9]), r"rtl\.ambiguity = an array of shape \(9,\) is not one of"),
        ("rtl.json", put("ambiguity", "shape", value=[3.0, 3]), r"rtl\.ambiguity = .* is not an array of float64"),
        ("tlca.json", put("extra", value=json.loads("[" * 200 + "]" * 200)), "nests deeper than 64 levels"),
        ("tlca.json", put("a" * 5000, value=1), r"tlca\.a+\.\.\. is unknown"),
        ("configuration.yaml", enlarge, "of shape .* is not of shape"),
    ],
)  # fmt: skip
def test_a_map_that_no_run_could_have_written_is_refused_in_one_sentence(map_folder, tmp_path, name, change, sentence):
    folder = tamper(map_folder, tmp_path / "map", name, change)
    with pytest.raises(HmtSlamError, match=sentence) as refused:
        read_saved_map(folder)
        read_run_state(folder)
    assert len(str(refused.value)) < 600


def test_the_same_bytes_cannot_be_two_arrays(map_folder, tmp_path):
    def change(document):
        document["replica"]["common"]["means"]["at"] = document["replica"]["common"]["poses"]["at"]
        document["replica"]["common"]["poses"]["shape"] = [10**6, 3]

    with pytest.raises(HmtSlamError, match="is not an array of float64"):
        read_saved_map(tamper(map_folder, tmp_path / "map", "map.json", change))


@pytest.mark.parametrize("name", ["../notes", "/etc/passwd", "a/b", "", "..", "n" * 300, "a\nb", MANIFEST])
def test_a_manifest_cannot_name_files_elsewhere(map_folder, tmp_path, name):
    shutil.copytree(map_folder, tmp_path / "map")
    path = tmp_path / "map" / MANIFEST
    for files, sentence in (
        ({name: {"bytes": 0, "sha256": ""}}, "which is no file of its folder"),
        ({"map.json": {"bytes": -1, "sha256": ""}}, "without its bytes and SHA-256"),
        ({"map.json": 7}, "without its bytes and SHA-256"),
        ([], "lists no files"),
        ({}, "does not list scans.json"),
    ):
        manifest = json.loads((map_folder / MANIFEST).read_text()) | {"files": files}
        path.write_text(json.dumps(manifest | {"sha256": _manifest_digest(manifest)}))
        with pytest.raises(HmtSlamError, match=sentence):
            FolderReader(tmp_path / "map", FORMAT, VERSION)


def as_pipe(path):
    path.unlink()
    os.mkfifo(path)


def as_endless(path):
    path.unlink()
    path.symlink_to("/dev/zero")


@pytest.mark.parametrize("replace", [as_pipe, as_endless])
@pytest.mark.parametrize("name", [MANIFEST, "map.json", "slam.bin"])
def test_a_pipe_and_an_endless_device_are_refused_at_once(map_folder, tmp_path, name, replace):
    shutil.copytree(map_folder, tmp_path / "map")
    replace(tmp_path / "map" / name)
    with pytest.raises(HmtSlamError, match="is no regular file"):
        FolderReader(tmp_path / "map", FORMAT, VERSION)


def test_a_name_of_5000_characters_and_a_deep_manifest_are_refused(tmp_path):
    with pytest.raises(
        HmtSlamError, match=r"holds no hmt_map, there is no manifest\.json to read \(File name too long"
    ):
        FolderReader(tmp_path / ("n" * 5000), FORMAT, VERSION)
    (tmp_path / MANIFEST).write_text("[" * 100_000)
    with pytest.raises(HmtSlamError, match="nests deeper than 64 levels"):
        FolderReader(tmp_path, FORMAT, VERSION)
