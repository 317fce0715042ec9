"""Scoring from output folders: requirements are met by good trajectories, and missed by bad ones."""

from dataclasses import replace

import numpy as np
import pytest

from benchmark.accuracy import BOUNDS, accuracy_requirements, accuracy_table
from benchmark.logs import MeasuredLog
from benchmark.report import Report
from benchmark.scoring import FINAL, ONLINE, over_seeds, score
from benchmark.speed import speed_requirements
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.evaluation import StampedPoses, write_tum

SECONDS = np.arange(0.0, 200.0, 1.0)


def line(error=0.0):
    """A drive along x at 1 m/s, whose every meter is too long by ``error``."""
    poses = np.stack([(1.0 + error) * SECONDS, 0.0 * SECONDS, 0.0 * SECONDS], axis=1)
    return StampedPoses((SECONDS * 1e9).astype(np.int64), poses)


@pytest.fixture
def log(tmp_path):
    """A log with two relations: over 10 m, and over 100 s and 100 m."""
    relations = tmp_path / "line.relations"
    relations.write_text("20 30 10 0 0 0 0 0\n50 150 100 0 0 0 0 0\n")
    path = tmp_path / "line.clf"
    readings = "".join(f"ODOM {t} 0 0 1 0 0 {t} host {t}\n" for t in SECONDS)
    path.write_text(f"{readings}FLASER 2 1.0 2.0 0 0 0 0 0 0 0 host 0\n")
    return MeasuredLog("aces", path, relations)


def folder_with(tmp_path, name, **trajectories):
    folder = tmp_path / name
    folder.mkdir()
    for file, trajectory in trajectories.items():
        write_tum(folder / f"{file}.tum", trajectory)
    return folder


def test_a_folder_is_scored_by_hand(tmp_path, log):
    folder = folder_with(tmp_path, "run", trajectory=line(0.01), trajectory_online=line(0.02))
    final, online = score(folder, log, FINAL), score(folder, log, ONLINE)
    assert (final.overall.matched, final.over_60_s.matched) == (2, 1)
    assert final.overall.translation.mean == pytest.approx(0.5 * (0.1 + 1.0))
    assert final.over_60_s.translation.mean == pytest.approx(1.0)
    assert online.overall.translation.mean == pytest.approx(1.1)


def test_means_over_seeds_by_hand(tmp_path, log):
    scores = [score(folder_with(tmp_path, str(k), trajectory=line(k * 0.01)), log) for k in (1, 2, 3)]
    means = over_seeds(scores)
    assert means.translation == pytest.approx(1.1)
    assert means.translation_std == pytest.approx(0.55)
    assert means.worst == pytest.approx(1.65)
    assert means.long == pytest.approx(2.0)
    assert means.long_max == pytest.approx(3.0)
    assert (means.matched, means.extrapolated, means.missed) == (1.0, 0, 0)


@pytest.mark.parametrize(
    ("change", "unmet"),
    [
        ({}, []),
        ({"translation": 0.0431, "long": 0.06, "worst": 0.05}, ["aces: translation, mean over seeds"]),
        ({"rotation": 0.91}, ["aces: rotation, mean over seeds"]),
        ({"long": 0.0601}, ["aces: relations over 60 s / all relations"]),
        ({"worst": 0.0501}, ["aces: worst seed / mean over seeds"]),
        ({"translation": float("nan")}, ["translation", "relations over 60 s", "worst seed"]),
    ],
)
def test_each_requirement_fails_on_its_own_figure(tmp_path, log, change, unmet):
    means = over_seeds([score(folder_with(tmp_path, "run", trajectory=line()), log)])
    good = replace(means, translation=0.04, rotation=0.4, long=0.06, worst=0.05)
    requirements = accuracy_requirements("aces", replace(good, **change))
    failed = [requirement.name for requirement in requirements if not requirement.is_met]
    assert len(failed) == len(unmet)
    assert all(part in name for part, name in zip(unmet, failed, strict=True))
    assert ("| FAIL |" in Report("accuracy", "", requirements=requirements).text) == bool(unmet)


def test_the_bounds_are_those_that_the_project_promises():
    assert (BOUNDS["aces"].translation, BOUNDS["aces"].rotation) == (0.043, 0.9)
    assert (BOUNDS["intel"].translation, BOUNDS["intel"].rotation) == (0.022, 0.8)
    query = speed_requirements("intel", [26.0, 23.0], [350 * 10**6])
    assert [(one.name, one.is_met) for one in query] == [("intel: CPU time", True), ("intel: peak memory", True)]
    assert not speed_requirements("intel", [26.0, 25.0], [1])[0].is_met
    assert not speed_requirements("intel", [1.0], [1, 351 * 10**6])[1].is_met
    assert not speed_requirements("aces", [15.1], [1])[0].is_met


def test_a_log_without_truth_is_not_scored(tmp_path, log):
    folder = folder_with(tmp_path, "run", trajectory=line())
    with pytest.raises(HmtSlamError, match="no true relations"):
        score(folder, replace(log, relations_file=None))


def test_the_table_of_accuracy_names_log_and_trajectory(tmp_path, log):
    means = over_seeds([score(folder_with(tmp_path, "run", trajectory=line(0.01)), log)])
    text = accuracy_table({"aces": {FINAL: means, ONLINE: means}})
    assert "| aces | final | **0.5500** |" in text
    assert "| aces | online |" in text
