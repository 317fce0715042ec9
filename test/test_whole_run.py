"""The bundled log from end to end: what a newcomer sees, and that a seed determines it to the byte."""

import csv
import filecmp
import json
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from preloaded import hmt_slam

from hmt_slam_ros.area_abstraction.overlap_graph import overlaps, sensed_points
from hmt_slam_ros.evaluation import read_tum
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.process_table import process_names
from hmt_slam_ros.sensors import Scan

LOG = Path(__file__).parents[1] / "data" / "malaga_one_loop"
SCANS = 225


@pytest.fixture(scope="module")
def output(tmp_path_factory):
    """The map of a newcomer, by a process that has nothing loaded before."""
    folder = tmp_path_factory.mktemp("runs") / "first"
    command = [sys.executable, "-m", "hmt_slam_ros.cli.main", "map", str(LOG), "--out", str(folder)]
    subprocess.run(command, check=True, timeout=300)
    return folder


@pytest.fixture(scope="module")
def report(output):
    return json.loads((output / "report.json").read_text(encoding="utf-8"))


def test_every_scan_is_accounted_for(output, report):
    assert report["scans"] == {"in": SCANS, "processed": SCANS, "dropped": 0}
    assert len(read_tum(output / "trajectory.tum").stamps) == SCANS
    assert len(read_tum(output / "trajectory_online.tum").stamps) == SCANS


def test_the_loop_becomes_several_areas_and_its_end_is_recognized(report):
    assert report["areas"] >= 3
    assert report["loop_closures"] >= 1
    assert report["hypotheses"]["probability"] > 0.99


def test_the_report_tells_time_and_memory_of_every_process(report):
    assert set(report["processes"]) == set(process_names())
    for figures in report["processes"].values():
        assert 0.0 < figures["mean_ms_per_scan"] <= figures["max_ms_per_scan"]
    assert 0 < report["pss_bytes"]["hmt_slam"] <= report["peak_rss_bytes"]["hmt_slam"]
    memory = report["memory_bytes"]
    assert set(memory) == {"particle_maps", "libraries", "kernels", "keyframe_scans"}
    assert min(memory.values()) > 100_000
    assert sum(memory.values()) < report["peak_rss_bytes"]["hmt_slam"]
    assert report["wall_s"] > 0.0
    assert report["cpu_s"] > 0.0
    assert {"configuration", "seed", "versions"} <= set(report)


def test_the_probabilities_of_every_keyframe_are_on_record_and_sum_to_one(output, report):
    sums = defaultdict(float)
    with (output / "pmf.csv").open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            sums[int(row["keyframe"])] += float(row["probability"])
            unexamined = float(row["unexamined"])
            assert 0.0 <= unexamined < 1.0
    assert sorted(sums) == list(range(report["keyframe_events"]))
    assert max(abs(total - 1.0) for total in sums.values()) < 1e-3


def revisit_overlap(output, shift=(0.0, 0.0, 0.0)):
    """Median overlap of the last scans, their poses shifted, with those taken nearest to them in the first minute."""
    scans = [r.measurement for r in open_log(LOG).records() if isinstance(r.measurement, Scan)]
    poses = read_tum(output / "trajectory.tum").poses
    points = [sensed_points(scan, 30.0, 360) for scan in scans]
    shares = []
    for late in range(200, SCANS):
        relative = se2.between(poses[:60], poses[late])
        near = np.flatnonzero((np.hypot(relative[:, 0], relative[:, 1]) < 1.0) & (np.abs(relative[:, 2]) < 0.3))
        if near.size:
            early = near[np.argmin(np.hypot(*relative[near, :2].T))]
            shifted = se2.compose(poses[late], shift)
            shares.append(overlaps(points[late], shifted, [points[early]], poses[early][None], 0.1)[0])
    assert len(shares) > 5
    return np.median(shares)


def test_where_the_robot_drives_its_first_meters_again_the_walls_are_single(output):
    overlap = revisit_overlap(output)
    assert overlap > 0.75
    for shift in [(0.0, 0.1, 0.0), (0.1, 0.0, 0.0), (0.0, 0.0, 0.03)]:
        assert revisit_overlap(output, shift) < 0.7


def test_one_seed_gives_the_same_bytes(output, tmp_path):
    again = tmp_path / "again"
    hmt_slam("map", LOG, "--out", again, check=True)
    names = ["trajectory.tum", "trajectory_online.tum", "graph.g2o", "map.pgm", "pmf.csv"]
    names += [str(p.relative_to(output)) for p in sorted((output / "hmt_map").rglob("*")) if p.is_file()]
    assert len(names) > 10
    assert filecmp.cmpfiles(output, again, names, shallow=False) == (names, [], [])


def test_another_seed_gives_nearly_the_same_path(output, tmp_path):
    other = tmp_path / "other"
    hmt_slam("map", LOG, "--out", other, "--seed", 1, check=True)
    difference = se2.between(read_tum(output / "trajectory.tum").poses, read_tum(other / "trajectory.tum").poses)
    assert np.hypot(*difference[:, :2].T).max() < 0.1
