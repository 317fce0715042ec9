"""Marks of the measurement: where true relations are, each seen at both ends, some with a wrong name."""

from itertools import pairwise

import numpy as np

from benchmark.marks import RETURN, LogCase, draw_marks, insert_marks
from hmt_slam_ros.evaluation import Relations
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.records import LogRecord
from hmt_slam_ros.sensors import MarkObservation, Odometry

SECOND = 10**9
POSE = np.array([0.5, 0.2, 0.1])
STARTS = np.arange(1, 41) * SECOND
RELATIONS = Relations(
    np.concatenate((STARTS, [5 * SECOND, 6 * SECOND])),
    np.concatenate((STARTS + 2 * RETURN, [6 * SECOND, 6 * SECOND + 2 * RETURN])),
    np.concatenate((np.tile(POSE, (41, 1)), [[9.0, 0.0, 0.0]])),
)
"""Forty returns, a relation to the next second, and one to a place far away."""


def test_marks_are_at_returns_spread_over_the_log_and_a_tenth_of_the_names_is_wrong():
    drawn = [draw_marks(RELATIONS, LogCase(10, seed)) for seed in range(40)]
    for seen in drawn:
        assert len(seen) == 20
        assert [one.source_stamp for one in seen] == sorted(one.source_stamp for one in seen)
        assert {one.name for one in seen} <= {f"mark {k}" for k in range(10)}
        right = [one for one in seen if not one.is_wrong]
        for name in {one.name for one in right}:
            ends = [one for one in right if one.name == name]
            if len(ends) == 2:
                assert ends[1].source_stamp - ends[0].source_stamp == 2 * RETURN
                error = se2.between(POSE, se2.between(ends[0].pose, ends[1].pose))
                assert np.abs(error).max() < 0.25
    share = np.mean([one.is_wrong for seen in drawn for one in seen])
    assert 0.07 < share < 0.13
    assert draw_marks(RELATIONS, LogCase(0, 0)) == []


def test_an_observation_comes_before_the_first_record_that_is_later_on_the_running_clock():
    shift = 7  # of the running clock, ns
    records = [LogRecord(k * SECOND, Odometry(k * SECOND + shift, np.zeros(3))) for k in range(100, 200)]
    marks = [one for one in draw_marks(RELATIONS, LogCase(3, 1)) if one.source_stamp > 100 * SECOND]
    marked = list(insert_marks(records, marks))
    assert len(marked) == len(records) + len(marks)
    for before, after in pairwise(marked):
        if isinstance(before.measurement, MarkObservation):
            assert before.measurement.stamp == before.source_stamp + shift
            assert before.source_stamp <= after.source_stamp
