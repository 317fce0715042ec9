"""Scores of kidnapped robots by their localization."""

import itertools
import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from benchmark.kidnapped_drive import LocalizationReport, MonitoredRun, summarize_drive
from benchmark.kidnapping import (
    KINDS,
    SOON,
    draw_drive,
    drive_kidnapped,
    leave_gap,
    localizations_by_world,
    requirements,
)
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.sensors import Scan

LOST, RIGHT, WRONG = (False, False), (True, True), (True, False)


def summarize(*states):
    return summarize_drive(
        [LocalizationReport(float(k), *one, 0.95) for k, one in enumerate(states)], (0.02, 0.03), float(len(states))
    )


@pytest.mark.parametrize(
    ("states", "noticed", "again", "confident", "wrong"),
    [
        ((WRONG, WRONG, LOST, LOST, RIGHT, RIGHT), 2.0, 4.0, 0.0, False),
        ((WRONG, LOST, WRONG, WRONG, RIGHT), 1.0, 4.0, 2.0, False),
        ((WRONG, WRONG, WRONG), math.inf, math.inf, 0.0, True),
        ((LOST, RIGHT, LOST), 0.0, math.inf, 0.0, False),
    ],
    ids=["noticed and found", "found in a wrong place first", "never noticed", "lost again"],
)
def test_a_drive_is_scored_by_the_localization_of_the_robot(states, noticed, again, confident, wrong):
    found = summarize(*states)
    assert (found.noticed, found.again, found.confident, found.wrong) == (noticed, again, confident, wrong)


def test_a_confident_wrong_answer_and_one_that_comes_late_are_faults():
    met = [
        one.is_met
        for one in requirements("office, known", [summarize(LOST, RIGHT), summarize(LOST, WRONG, WRONG, RIGHT)])
    ]
    assert met == [True, False]
    assert not requirements("office, known", [summarize(*[WRONG] * 7, LOST)])[0].is_met


def test_localizations_of_worlds_that_look_alike_are_counted_apart():
    found = localizations_by_world(["office", "ring", "busy"], [summarize(WRONG), summarize(LOST), summarize(RIGHT)])
    assert found == {"other worlds": [(0.95, False), (0.95, True)], "ring": [(0.95, False)]}


def test_the_pose_counts_in_the_area_that_the_robot_is_in_after_the_event():
    monitored = MonitoredRun(Configuration())
    for record in itertools.islice(open_log("sim:ring,seed=1").records(), 200):
        monitored.run.process_record(record)
        if isinstance(record.measurement, Scan):
            monitored.report(record.measurement.stamp, record.true_pose, 0.0)
    monitored.kidnap_event, recorder = monitored.events, monitored.run.recorder
    event = max(recorder.hypotheses)
    (estimate,), (hypothesis,) = recorder.keyframes[event].estimates, recorder.hypotheses[event].hypotheses
    true = monitored.true[event]
    assert monitored.estimate_error(true).is_right
    frame = PoseGaussian.from_pose(np.array([1.0, 2.0, 0.5]))
    estimate = replace(estimate, area=7, pose=frame.inverse().compose(estimate.pose))
    recorder.keyframes[event] = replace(recorder.keyframes[event], estimates=(estimate,))
    assert not monitored.estimate_error(true).is_right
    hypothesis = replace(hypothesis, frame_change=frame)
    recorder.hypotheses[event] = replace(recorder.hypotheses[event], hypotheses=(hypothesis,))
    assert monitored.estimate_error(true).is_right


def test_events_of_scans_from_before_the_kidnapping_are_not_reported():
    monitored, reports = MonitoredRun(Configuration()), []
    for n, record in enumerate(itertools.islice(open_log("sim:ring,seed=1").records(), 200)):
        monitored.run.process_record(record)
        if isinstance(record.measurement, Scan):
            if n > 100 and monitored.kidnap_stamp is None:
                monitored.kidnap_stamp = record.measurement.stamp + 1
            reports.append(monitored.report(record.measurement.stamp, record.true_pose, 0.0))
    first = next(report for report in reports if report is not None)
    assert first.event == monitored.kidnap_event
    scans = {event: keyframe.scan.stamp for event, keyframe in monitored.run.recorder.keyframes.items()}
    assert scans[first.event - 1] < monitored.kidnap_stamp <= scans[first.event]


@pytest.mark.parametrize("kind", KINDS)
def test_the_robot_is_kidnapped_once_without_odometry(kind):
    log = open_log(draw_drive("ring", kind, 1))
    drive = log.scenario.settings
    assert (drive.carried > 0.5) == (kind in ("known", "gap"))
    assert drive.to > drive.carried
    poses = log.scenario.poses
    steps = [math.hypot(*step) for step in (poses[1:, :2] - poses[:-1, :2])]
    far = [step for step in steps if step > 0.6]
    assert len(far) == 1
    assert kind != "short" or far[0] < 3.0
    wheels = log.scenario.odometry
    assert max(math.hypot(*step) for step in wheels[1:, :2] - wheels[:-1, :2]) < 0.2


def test_scans_are_missing_from_the_kidnapping_on():
    log = open_log(draw_drive("ring", "gap", 1))
    whole, parted = list(log.records()), list(leave_gap(log.records(), 2.0))
    kept = {record.measurement.stamp for record in parted if isinstance(record.measurement, Scan)}
    scans = [record for record in whole if isinstance(record.measurement, Scan)]
    missing = [record.measurement.stamp for record in scans if record.measurement.stamp not in kept]
    first = next(
        later.measurement.stamp
        for one, later in pairwise(scans)
        if math.hypot(*(later.true_pose - one.true_pose)[:2]) > 0.6
    )
    assert missing[0] == first
    assert missing[-1] - first < 2 * 10**9 <= min(stamp for stamp in kept if stamp > first) - first
    assert len(whole) - len(parted) == len(missing)


@pytest.mark.parametrize(
    ("world", "kind", "seed"),
    [
        pytest.param("busy", "known", 1000, marks=pytest.mark.long, id="among people"),
        pytest.param("office", "unknown", 8, id="where little but passed walls contradicts, keyframe by keyframe"),
    ],
)
def test_a_kidnapping_is_detected_and_the_robot_relocalized(world, kind, seed):
    found = drive_kidnapped(draw_drive(world, kind, seed))
    assert found.noticed <= SOON
    assert not found.wrong
    assert max(found.errors) < 0.1
    assert found.localizations[-1] == (pytest.approx(1.0, abs=0.1), True)
