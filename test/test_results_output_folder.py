"""The output folder, from a small run made by hand whose right answer is known."""

import errno
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hmt_slam_ros.configuration import Configuration, with_changes
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.evaluation import read_tum
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.grids.occupancy_map import read_map
from hmt_slam_ros.messages.map_changes import Arc, ArcEnds, AreaPose, LocalArea, MovedKeyframe
from hmt_slam_ros.messages.messages import (
    ClosureDecision,
    EndOfRun,
    Hypotheses,
    Hypothesis,
    HypothesisEstimate,
    Keyframe,
    LocalEstimate,
    Notice,
    ScanPoses,
)
from hmt_slam_ros.registration.consistency import Clutter
from hmt_slam_ros.results import plots
from hmt_slam_ros.results.export import export_grid, export_topology
from hmt_slam_ros.results.final_map import FinalMap, final_map
from hmt_slam_ros.results.hmt_map import MapWriter, read_run_state, read_saved_map
from hmt_slam_ros.results.output_folder import RunMetrics, write_output
from hmt_slam_ros.results.plots import read_table
from hmt_slam_ros.results.recorder import Recorder
from hmt_slam_ros.sensors import Scan

SCANS, EVERY, CUT, VERDICT = 24, 4, 3, 4
STAMPS = 10**9 + 10**8 * np.arange(SCANS, dtype=np.int64)
SOURCE = STAMPS - 7 * 10**17  # the log's own clock, which differs from the one that the processes see
COVARIANCE = np.diag([0.04, 0.01, 0.0025])
MAP_T_AREA_1 = np.array([3.0, 0.5, 0.4])
TRUTH = np.column_stack([np.linspace(0.0, 6.0, SCANS), 0.1 * np.linspace(0.0, 6.0, SCANS), np.linspace(0, 0.6, SCANS)])


def scan(index: int) -> Scan:
    """A round room of radius 10 m about the map's origin, seen from the true pose."""
    angles = -np.pi + 2.0 * np.pi / 90.0 * np.arange(90)
    x, y, theta = TRUTH[index]
    along = np.cos(angles + theta) * x + np.sin(angles + theta) * y
    ranges = -along + np.sqrt(along**2 + 100.0 - x**2 - y**2)
    return Scan(int(STAMPS[index]), ranges.astype(np.float32), -np.pi, 2.0 * np.pi / 90.0, 0.1, 80.0)


def belief(mean: np.ndarray) -> PoseGaussian:
    return PoseGaussian(np.asarray(mean, dtype=float), COVARIANCE)


def keyframe(sequence: int, children: dict[int, int]) -> Keyframe:
    """Keyframe event with {hypothesis: area}; poses are exact in each hypothesis."""
    index = EVERY * sequence
    estimates = tuple(
        HypothesisEstimate(
            hypothesis,
            area,
            belief(se2.between(frame(area), TRUTH[index])),
            True,
            0.0,
            0.0,
            Clutter(),
            12.0 - sequence,
            mode_count=2 if sequence == CUT else 1,
        )
        for hypothesis, area in children.items()
    )
    return Keyframe(sequence, scan(index), 6.0 * index / (SCANS - 1), estimates)


def frame(area: int) -> np.ndarray:
    return MAP_T_AREA_1 if area == 1 else np.zeros(3)


def verdict_poses(*areas: int) -> tuple[AreaPose, ...]:
    return tuple(AreaPose(area, belief(frame(area))) for area in areas)


def trails() -> list[ScanPoses]:
    """Hypothesis 0 up to the cut, 1 and 2 after it; 2 is wrong by a meter and must not be used."""
    rows = []
    for first in range(0, SCANS, EVERY):
        index = np.arange(first, min(first + EVERY, SCANS))
        anchors = index // EVERY
        poses = se2.between(TRUTH[EVERY * anchors], TRUTH[index])
        after = first > EVERY * CUT
        for hypothesis in ([1] if first > EVERY * VERDICT else [1, 2]) if after else [0]:
            shift = np.array([1.0, 0.0, 0.0]) * (hypothesis == 2)
            rows.append(ScanPoses(hypothesis, first, STAMPS[index], anchors, poses + shift))
    return rows


def messages() -> list:
    sent = list(trails())
    for index in range(SCANS):
        area = 1 if index > EVERY * CUT else 0
        pose = belief(se2.between(frame(area), TRUTH[index]))
        sent.append(LocalEstimate(int(STAMPS[index]), index, area, pose, TRUTH[index], 0))
    for k in range(SCANS // EVERY):
        sent.append(keyframe(k, {0: 0} if k <= CUT else {1: 1, 2: 0} if k <= VERDICT else {1: 1}))
        sent.append(hypotheses(k))
        sent.append(make_decision(k))
    return [*sent, Notice("slam", "two scans had no beam: clean the laser"), EndOfRun(SCANS, SCANS, 0)]


def hypotheses(k: int) -> Hypotheses:
    if k < CUT:
        return Hypotheses(k, (Hypothesis(0, 0, 1.0, 0),))
    if k > VERDICT:
        return Hypotheses(k, (Hypothesis(1, 1, 1.0, 1),))
    if k == VERDICT:
        return Hypotheses(k, (Hypothesis(1, 1, 0.95, 1), Hypothesis(2, 2, 0.04, 0)), unexamined=0.01)
    to_1 = se2.between(MAP_T_AREA_1, TRUTH[EVERY * k])
    new = Hypothesis(
        1,
        0,
        0.7,
        1,
        belief(se2.inverse(MAP_T_AREA_1)),
        (MovedKeyframe(k, 0, 1, to_1),),
        (Arc(0, 1, belief(MAP_T_AREA_1), closure=True),),
        (LocalArea(1, np.zeros(3)), LocalArea(0, se2.inverse(MAP_T_AREA_1))),
    )
    return Hypotheses(k, (new, Hypothesis(2, 0, 0.3, 0)))


def make_decision(k: int) -> ClosureDecision:
    if k == 0:
        return ClosureDecision(k, global_poses=verdict_poses(0))
    if k == CUT:
        return ClosureDecision(k, global_poses=verdict_poses(0, 1))
    return ClosureDecision(k, hypothesis=1) if k == VERDICT else ClosureDecision(k)


FIGURES = RunMetrics(
    "by hand",
    "lock-step",
    {"slam": np.arange(SCANS) * 1e-3, "aam": np.zeros(SCANS)},
    {"hmt_slam": 10**8},
    {"hmt_slam": 9 * 10**7},
    wall_seconds=2.0,
    cpu_seconds=1.5,
    refinement_seconds=0.1,
)


def make_recorder(order: int = 0, without: type | None = None) -> Recorder:
    sent = [message for message in messages() if without is None or not isinstance(message, without)]
    recorder = Recorder(with_changes(Configuration(), {"seed": 7, "local_map.cell": 0.1}))
    for index in np.random.default_rng(order).permutation(len(sent)) if order else range(len(sent)):
        assert recorder.handle(sent[index]) == []
    return recorder


def finish_map(recorder: Recorder) -> FinalMap:
    return final_map(recorder.finish(STAMPS), lambda: map(scan, range(SCANS)), recorder.configuration)


def write(directory: Path, recorder: Recorder) -> None:
    write_output(directory, finish_map(recorder), SOURCE, FIGURES, recorder.configuration)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("output")
    write(directory, make_recorder())
    return directory


def contents(directory: Path) -> dict[str, bytes]:
    return {str(f.relative_to(directory)): f.read_bytes() for f in sorted(directory.rglob("*")) if f.is_file()}


def test_every_file_of_the_design_is_there(folder: Path) -> None:
    wanted = "trajectory.tum trajectory_online.tum map.pgm map.yaml hmt_map graph.g2o report.json pmf.csv map.png"
    assert set(wanted.split()) <= {entry.name for entry in folder.iterdir()}


@pytest.mark.parametrize("name", ["trajectory.tum", "trajectory_online.tum"])
def test_both_trajectories_are_true_and_have_the_logs_own_stamps(folder: Path, name: str) -> None:
    trajectory = read_tum(folder / name)
    np.testing.assert_array_equal(trajectory.stamps, SOURCE)
    np.testing.assert_allclose(trajectory.poses, TRUTH, atol=1e-8)


def test_the_order_in_which_messages_arrive_does_not_matter(folder: Path, tmp_path: Path) -> None:
    write(tmp_path, make_recorder(order=3))
    assert contents(tmp_path) == contents(folder)


def test_a_message_that_comes_twice_counts_once(folder: Path, tmp_path: Path) -> None:
    recorder = make_recorder()
    for message in messages():
        recorder.handle(message)
    write(tmp_path, recorder)
    assert contents(tmp_path) == contents(folder)


def test_the_recorder_is_complete_only_when_everything_has_arrived() -> None:
    assert make_recorder().is_complete
    for kind in (EndOfRun, ClosureDecision, Hypotheses, LocalEstimate):
        assert not make_recorder(without=kind).is_complete


def test_a_lost_message_is_named() -> None:
    recorder = make_recorder()
    del recorder.hypotheses[2]
    with pytest.raises(HmtSlamError, match="Hypotheses 2 was lost"):
        recorder.finish(STAMPS)


def test_a_lost_last_message_is_named() -> None:
    recorder = make_recorder()
    del recorder.decisions[SCANS // EVERY - 1]
    with pytest.raises(HmtSlamError, match="was lost"):
        recorder.finish(STAMPS)


def test_a_run_without_any_pose_is_refused() -> None:
    with pytest.raises(HmtSlamError, match="none of the 24 scans"):
        make_recorder(without=LocalEstimate).finish(STAMPS)


def test_a_scan_that_is_not_in_the_log_is_named() -> None:
    with pytest.raises(HmtSlamError, match="is not in the log"):
        make_recorder().finish(STAMPS[:-1])


def test_a_scan_without_a_pose_gets_one_between_its_neighbors() -> None:
    recorder = make_recorder()
    trail = recorder.scan_poses.pop((1, 16))
    keep = np.array([True, False, True, True])
    recorder.handle(ScanPoses(1, 16, trail.stamps[keep], trail.keyframes[keep], trail.poses[keep]))
    np.testing.assert_allclose(recorder.finish(STAMPS).trajectory, TRUTH, atol=5e-3)


def test_an_area_that_no_verdict_placed_is_placed_along_the_arcs() -> None:
    recorder = make_recorder()
    recorder.decisions[CUT] = ClosureDecision(CUT)
    recording = recorder.finish(STAMPS)
    np.testing.assert_allclose(recording.area_poses[1].mean, MAP_T_AREA_1)
    np.testing.assert_allclose(recording.trajectory, TRUTH, atol=1e-9)
    np.testing.assert_allclose(recording.online_trajectory, TRUTH, atol=1e-9)


def test_the_probabilities_are_those_of_tsbi(folder: Path) -> None:
    table = read_table(folder / "pmf.csv")
    at_cut = table["keyframe"] == CUT
    assert table["probability"][at_cut].tolist() == [0.7, 0.3]
    assert table["areas"][at_cut].tolist() == [2, 1]
    assert table["closures"][at_cut].tolist() == [1, 0]
    assert table["parent"][at_cut].tolist() == [0, 0]
    assert table["unexamined"][table["keyframe"] == VERDICT].tolist() == [0.01, 0.01]
    # Those of the particles of the parent.
    assert table["effective_samples"][at_cut].tolist() == [12.0 - CUT] * 2
    assert table["mode_count"][at_cut].tolist() == [2, 2]
    assert table["mode_count"][~at_cut].max() == 1
    accepted_rows = np.flatnonzero(table["accepted"])
    assert [(table["keyframe"][r], table["hypothesis"][r]) for r in accepted_rows] == [(VERDICT, 1)]


def test_the_graph_has_areas_and_arcs_with_information_in_the_order_of_g2o(folder: Path) -> None:
    lines = [line.split() for line in (folder / "graph.g2o").read_text().splitlines()]
    assert [line[:2] for line in lines] == [["VERTEX_SE2", "0"], ["VERTEX_SE2", "1"], ["EDGE_SE2", "0"]]
    assert np.array(lines[1][2:], dtype=float) == pytest.approx(MAP_T_AREA_1)
    assert np.array(lines[2][3:6], dtype=float) == pytest.approx(MAP_T_AREA_1)
    assert np.array(lines[2][6:], dtype=float) == pytest.approx([25.0, 0.0, 0.0, 100.0, 0.0, 400.0])


def test_the_report_counts_what_happened(folder: Path) -> None:
    report = json.loads((folder / "report.json").read_text())
    assert report["scans"] == {"in": SCANS, "processed": SCANS, "dropped": 0}
    assert (report["areas"], report["arcs"], report["loop_closures"]) == (2, 1, 1)
    assert report["keyframes"] == report["keyframe_events"] == SCANS // EVERY
    assert report["processes"]["slam"]["max_ms_per_scan"] == pytest.approx(23.0)
    assert report["processes"]["slam"]["mean_ms_per_scan"] == pytest.approx(11.5)
    particles = {"least_effective_samples": 13.0 - SCANS // EVERY, "most_modes": 2, "events_with_several_modes": 1}
    assert report["particles"] == particles
    assert report["configuration"]["local_map"]["cell"] == 0.1
    assert (report["seed"], report["peak_rss_bytes"]) == (7, {"hmt_slam": 10**8})
    assert report["pss_bytes"] == {"hmt_slam": 9 * 10**7}
    assert report["notices"] == [{"process": "slam", "text": "two scans had no beam: clean the laser"}]
    assert {"numpy", "numba", "hmt_slam_ros"} <= set(report["versions"])


def test_the_map_shows_the_round_room(folder: Path) -> None:
    image = read_map(folder)
    rows, columns = np.nonzero(image.pixels == 0)
    x = image.origin[0] + (columns + 0.5) * image.resolution
    y = image.origin[1] + (image.pixels.shape[0] - rows - 0.5) * image.resolution
    assert rows.size > 300
    assert np.abs(np.hypot(x, y) - 10.0).max() < 0.2


def test_the_saved_map_reads_back_complete(folder: Path) -> None:
    saved = read_saved_map(folder / "hmt_map")
    recording = finish_map(make_recorder()).recording
    hybrid_map = saved.replica.maps[1]
    assert saved.replica.best_hypothesis == recording.replica.best_hypothesis == 1
    assert saved.configuration.seed == 7
    assert hybrid_map.area_ids() == recording.hybrid_map.area_ids()
    for area in hybrid_map.area_ids():
        keyframes = recording.hybrid_map.keyframes(area)
        assert list(hybrid_map.keyframes(area)) == list(keyframes)
        for k, pose in keyframes.items():
            np.testing.assert_array_equal(hybrid_map.keyframes(area)[k], pose)
            np.testing.assert_array_equal(saved.replica.scans[k].ranges, recording.replica.scans[k].ranges)
            np.testing.assert_array_equal(saved.replica.scans[k].points, recording.replica.scans[k].points)
    for (a, b, arc), (c, d, other) in zip(hybrid_map.all_arcs(), recording.hybrid_map.all_arcs(), strict=True):
        assert (a, b, arc.closure) == (c, d, other.closure)
        np.testing.assert_array_equal(arc.pose.covariance, other.pose.covariance)


def test_the_saved_map_keeps_every_live_hypothesis(tmp_path: Path) -> None:
    recorder = make_recorder()
    for k in range(VERDICT, SCANS // EVERY):
        recorder.keyframes[k] = keyframe(k, {1: 1, 2: 0})
        recorder.hypotheses[k] = Hypotheses(k, (Hypothesis(1, 1, 0.6, 1), Hypothesis(2, 2, 0.4, 0)))
        recorder.decisions[k] = ClosureDecision(k)
    write(tmp_path, recorder)
    saved = read_saved_map(tmp_path / "hmt_map")
    assert saved.replica.probabilities == {1: 0.6, 2: 0.4}
    assert {h: m.area_ids() for h, m in saved.replica.maps.items()} == {1: [0, 1], 2: [0]}
    assert saved.replica.robot_areas == {1: 1, 2: 0}


def test_the_saved_map_keeps_that_a_hypothesis_lacks_an_arc(tmp_path: Path) -> None:
    """It has another way between the two areas, along a third one."""
    recorder = make_recorder()
    moved, arc = MovedKeyframe(VERDICT, 1, 2, np.zeros(3)), PoseGaussian(np.ones(3), 0.01 * np.eye(3))
    for k in range(VERDICT, SCANS // EVERY):
        recorder.keyframes[k] = keyframe(k, {1: 1, 2: 0})
        changes: dict[str, Any] = {}
        if k == VERDICT:
            arcs = Arc(0, 2, arc), Arc(1, 2, arc)
            changes = {"moved_keyframes": (moved,), "arcs": arcs, "removed_arcs": (ArcEnds(0, 1),)}
        recorder.hypotheses[k] = Hypotheses(k, (Hypothesis(1, 1, 0.6, 1, None, **changes), Hypothesis(2, 2, 0.4, 0)))
        recorder.decisions[k] = ClosureDecision(k)
    recording = recorder.finish(STAMPS)
    writer = MapWriter(tmp_path / "hmt_map")
    writer.write_map(recording.replica, recording.area_poses, recording.last_estimate)
    writer.finish(recorder.configuration)
    saved = read_saved_map(tmp_path / "hmt_map")
    assert sorted(saved.replica.maps[1].changed_arcs) == [(0, 1), (0, 2), (1, 2)]
    assert saved.replica.maps[1].arc(0, 1) is None


def test_a_map_without_state_is_nothing_to_go_on_from(folder: Path) -> None:
    with pytest.raises(HmtSlamError, match="a map without the state of a run"):
        read_run_state(folder / "hmt_map")


def test_all_plots_are_drawn_from_the_files_alone(folder: Path) -> None:
    for picture in plots.plot_all(folder):
        assert picture.read_bytes().startswith(b"\x89PNG")
        assert picture.stat().st_size > 10_000


def test_plots_of_something_else_are_refused(tmp_path: Path) -> None:
    with pytest.raises(HmtSlamError, match="give an output folder"):
        plots.plot_all(tmp_path)


@pytest.mark.parametrize("fault", [errno.ENOSPC, errno.EROFS])
def test_pictures_and_exports_on_a_disk_that_takes_nothing_are_refused_in_a_sentence(
    folder: Path, monkeypatch: pytest.MonkeyPatch, fault: int
) -> None:
    def fail(*_: object) -> None:
        raise OSError(fault, os.strerror(fault))

    before = contents(folder)
    monkeypatch.setattr(os, "fsync", fail)
    for command in (plots.plot_all, export_topology, lambda directory: export_grid(directory, directory)):
        with pytest.raises(HmtSlamError, match=rf"cannot be written \({os.strerror(fault)}\): make room, or choose"):
            command(folder)
    assert contents(folder) == before
