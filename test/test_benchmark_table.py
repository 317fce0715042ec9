"""The comparison with a metric filter: its one area, its requirements, and runs that are kept."""

import json
from pathlib import Path

import pytest

from benchmark.charted_run import OneArea
from benchmark.logs import MeasuredLog
from benchmark.runs import CachedRunner, Run
from benchmark.table import (
    Comparison,
    Entry,
    comparison_table,
    metric_case,
    open_compared_logs,
    requirements,
)
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.messages import AreaEvents, Hypotheses
from hmt_slam_ros.offline.run import run_log
from hmt_slam_ros.open_log import open_log

LOG = MeasuredLog("aces", Path("aces.clf"))


def method(particles, cpu, peak, long_error, name="metric RBPF", worst=0.5):
    return Entry(name, particles, 1.0, 0.0, cpu, 1.0, peak, 100.0, 10.0, long_error, long_error, worst)


OURS = method(12, 10.0, 200.0, 0.1, "HMT-SLAM")


def test_accuracy_is_equal_up_to_a_factor_or_a_centimeter():
    assert method(12, 1.0, 1.0, 0.125).as_accurate_as(OURS)
    assert not method(12, 1.0, 1.0, 0.126).as_accurate_as(OURS)
    assert method(12, 1.0, 1.0, 0.029).as_accurate_as(method(12, 1.0, 1.0, 0.02))
    assert not method(12, 1.0, 1.0, 0.1, worst=1.1).as_accurate_as(OURS)


@pytest.mark.parametrize(
    ("last", "met"), [((100, 40.0, 600.0, 0.1), [True] * 3), ((40, 39.0, 599.0, 0.9), [True, False, False])]
)
def test_the_campus_requests_ratios_of_the_last_filter_that_was_tried(last, met):
    found = Comparison(OURS, (method(12, 11.0, 220.0, 1.0), method(*last)), {}, "truth")
    assert [requirement.is_met for requirement in requirements(found)] == met
    assert ("not as accurate" in requirements(found)[1].name) == (not found.is_equal)
    assert comparison_table({"campus": found}).count("metric RBPF") == 2


def test_a_metric_run_has_a_map_that_holds_the_log_and_its_own_particles():
    case = metric_case(LOG, 3, ("seed=3",), 40)
    command = case.command(Path("out"))
    assert command[2:5] == ["benchmark.charted_run", "metric", "aces.clf"]
    assert command[-4:] == ["--set", "local_map.extent=80", "--set", "filter.particles=40"]
    assert case.name != metric_case(LOG, 3, (), 100).name


def test_a_run_is_kept_and_made_again_for_another_program(tmp_path, monkeypatch):
    runs = []

    def run_case(case, folder):
        folder.mkdir(parents=True)
        runs.append(folder)
        return Run(case, folder, 5.0, 6.0, 7)

    monkeypatch.setattr("benchmark.runs.run_case", run_case)
    case = metric_case(LOG, 0, (), 12)
    for _ in range(2):
        (run,) = CachedRunner(tmp_path, 1, "this").runs([case])
        assert (run.cpu_seconds, run.wall_seconds, run.peak_rss) == (5.0, 6.0, 7)
    assert len(runs) == 1
    usage = runs[0] / "usage.json"
    usage.write_text(json.dumps(json.loads(usage.read_text()) | {"code": "older"}))
    CachedRunner(tmp_path, 1, "this").runs([case])
    assert len(runs) == 2


def test_a_name_that_is_no_log_is_refused():
    with pytest.raises(HmtSlamError, match="there is no log 'atlantis'"), open_compared_logs(["atlantis"]):
        pass


def test_with_one_area_nothing_is_ever_left():
    log = open_log("sim:office,seed=1,size=0.7", duration=60.0)
    recorder = run_log(log, Configuration(), abstraction=OneArea).recorder
    assert len(recorder.keyframes) > 20
    assert all(
        len(message.hypotheses) == 1 for message in recorder.hypotheses.values() if isinstance(message, Hypotheses)
    )
    assert {hypothesis.area for message in recorder.hypotheses.values() for hypothesis in message.hypotheses} == {0}


def test_one_area_answers_keyframes_alone():
    assert OneArea(Configuration()).handle(AreaEvents(0, ())) == []
