"""Maps that were tampered with behind right checksums: no process is handed one."""

import dataclasses
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
from hmt_slam_ros.hybrid_map.hybrid_map import GraphState, HybridMap
from hmt_slam_ros.messages.messages import Hypotheses, Hypothesis, PrunedKeyframe
from hmt_slam_ros.messages.replica import Replica, ReplicaState
from hmt_slam_ros.plain_data import field_names, is_record
from hmt_slam_ros.results.hmt_map import PARTS, ChainState, MapDocument, read_run_state, read_saved_map
from hmt_slam_ros.saved_map.field_limits import _LIMITS, _SHAPES
from hmt_slam_ros.saved_map.folder import FORMAT, MANIFEST, SCANS, VERSION, FolderReader, _manifest_digest
from hmt_slam_ros.saved_map.hypothesis_maps import check_hypothesis_maps
from hmt_slam_ros.saved_map.reference import document_reference
from hmt_slam_ros.saved_map.scans import ScanTable
from hmt_slam_ros.saved_map.validation import _CHECKS, check_process_states, check_record
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


FORM = (32, "cb286d621a21ab4a")
"""Version of the format, and the digest of all fields and types: a change of one is a change of both."""


def test_a_changed_field_has_a_new_version():
    lines = document_reference({"map": MapDocument, SCANS: ScanTable, "chain": ChainState, **PARTS})
    form = [line.rsplit(" | ", 1)[0] for line in lines if line.startswith(("### ", "| `"))]
    assert len(form) > 300
    assert (VERSION, hashlib.sha256("\n".join(form).encode()).hexdigest()[:16]) == FORM


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
        ("tsbi.json", put("unexamined", value=0.5), r"tsbi\.unexamined = 0\.5 is not what the probabilities of the"),
        ("tsbi.json", put("hypothesis_states", 0, 1, "pending_candidates", value=[7]), r"= \[7\] is not areas of the"),
        ("tsbi.json", put("hypothesis_states", 0, 1, "unmatched_keyframes", value=[7]), r"= \[7\] is not keyframes of"),
        (
            "tsbi.json",
            put("hypothesis_states", 0, 1, "localization", "relocalized_area", value=7),
            r"relocalized_area = \[7\] is not areas of the hypothesis",
        ),
        (
            "tsbi.json",
            put("hypothesis_states", 0, 1, "kidnapping_counts", value=[["uncertain", {"events": 1, "kidnappings": 2}]]),
            r"kidnapping_counts.*\.kidnappings = 2 is not at most the events",
        ),
        ("aam.json", put("partitions", 0, 1, "area", value=7), r"partitions\.area = 7 is not 0, the robot's area"),
        ("slam.json", put("live_hypotheses", 0, 1, "event", "anchor", value=9), r"anchor = 9 is not a keyframe of the"),
        ("tlca.json", put("paths", value=[]), r"tlca\.paths = \[\] is not those of replica"),
        ("tlca.json", put("paths", 0, 1, "version", value=99), r"paths\[0\]\.version = 99 is not at most"),
        ("slam.json", put("keyframe_events", value=2**30), r"recorder\.events = 1 is not 1073741824, as of slam"),
        ("log.json", put("first_scans", value=[]), r"log\.first_scans = \(\) is not from 0 to"),
        ("log.json", put("records_read", value=0), r"log\.records_read = 0 is not as many as"),
        ("recorder.json", put("parents", value=[[1, 2], [2, 1]]), r"recorder\.parents = .* is not older than"),
        ("recorder.json", put("events", value=2**30), r"probabilities = \[0\] is not up to the last event"),
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


def replica_of(keyframes, counts, arcs, changed=None):
    """A replica of areas 0, 1, ... with their keyframes and arcs.

    :param changed: a graph that differs, that of hypothesis 0.
    """
    count = len(arcs)
    common = GraphState(
        np.arange(len(counts)),
        np.array(counts),
        np.array(keyframes),
        np.zeros((len(keyframes), 3)),
        np.array(arcs, np.int64).reshape(-1, 2),
        np.zeros((count, 3)),
        np.tile(np.eye(3), (count, 1, 1)),
        np.zeros(count, bool),
        np.zeros(count, bool),
    )
    return ReplicaState(common=common, changes={0: changed or GraphState.empty()})


def test_every_keyframe_is_in_one_area_and_arcs_join_all_areas():
    check_hypothesis_maps(replica_of([3, 4, 5], [2, 1], [(0, 1)]), "map")
    for replica, sentence in (
        (replica_of([3, 3, 5], [2, 1], [(0, 1)]), "keyframes = one twice is not one of each"),
        (replica_of([3, 4, 3], [2, 1], [(0, 1)]), "keyframes = one twice is not one of each"),
        (replica_of([3, 4, 5], [3, 0], [(0, 1)]), "keyframe_counts = 0 is not 1 or more in each area"),
        (replica_of([3, 4, 5], [1, 1, 1], [(0, 1)]), r"arcs = none to \[2\] is not a way along arcs to every area"),
    ):
        with pytest.raises(HmtSlamError, match=sentence):
            check_hypothesis_maps(replica, "map")


def test_a_hypothesis_is_checked_with_the_areas_and_arcs_that_differ():
    moved = replica_of([4, 5], [2], []).common
    check_hypothesis_maps(replica_of([4, 5, 6], [2, 1], [(0, 1)], moved), "map")
    with pytest.raises(HmtSlamError, match="keyframes = one twice"):
        check_hypothesis_maps(replica_of([4, 6, 5], [2, 1], [(0, 1)], moved), "map")
    without_arc = dataclasses.replace(replica_of([], [], [(0, 1)]).common, removed=np.ones(1, bool))
    with pytest.raises(HmtSlamError, match=r"none to \[1\]"):
        check_hypothesis_maps(replica_of([4, 6, 5], [2, 1], [(0, 1)], without_arc), "map")


def test_a_keyframe_that_was_pruned_from_all_hypotheses_needs_no_scan():
    """The common map has it until the next commit, and a map that is saved meanwhile is read."""
    scan = Scan(0, np.ones(3, np.float32), -0.5, 0.5, 0.1, 10.0)
    replica = Replica({k: dataclasses.replace(scan, stamp=k) for k in range(3)}, {0: HybridMap()}, {0: 1.0}, {0: 0})
    for keyframe in range(3):
        replica.maps[0].set_keyframe(keyframe, 0, np.zeros(3))
    replica.maps[0].commit()
    replica.apply_hypotheses(
        Hypotheses(3, (Hypothesis(0, 0, 1.0, 0, None),), 0.0, pruned_keyframes=(PrunedKeyframe(1, 0),))
    )
    state = replica.state
    assert 1 in state.common.keyframes
    assert sorted(state.scans) == [0, 2]
    check_record(state, "replica")
    with pytest.raises(HmtSlamError, match=r"scans = without \[2\] is not a scan for every keyframe"):
        check_record(dataclasses.replace(state, scans={0: scan}), "replica")


def test_the_states_of_all_processes_have_the_same_map(map_folder):
    state, configuration = read_run_state(map_folder)
    check_process_states(state.processes, configuration)
    other = dataclasses.replace(state.processes["aam"], replica=ReplicaState())
    with pytest.raises(HmtSlamError, match=r"aam\.replica\.scans = .* is not that of slam"):
        check_process_states({**state.processes, "aam": other}, configuration)


def test_an_array_without_elements_is_no_larger_than_its_file(map_folder, tmp_path):
    """NumPy raises a ValueError at the first shape, and whoever goes through the rows of the second never ends."""
    for number, shape in enumerate(([0, 2**31, 2**31, 2**31], [2**31, 0])):
        change = put("replica", "common", "arcs", "shape", value=shape)
        with pytest.raises(HmtSlamError, match=r"arcs = .* is not an array of int64"):
            read_saved_map(tamper(map_folder, tmp_path / str(number), "map.json", change))


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
