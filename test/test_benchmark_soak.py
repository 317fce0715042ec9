"""Requirements on a long run of the nodes."""

import math

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from benchmark.__main__ import main
from benchmark.soak import Soak, largest_change, requirements, slope

HOURS = [0.1 * k for k in range(40)]


def test_what_fills_up_in_the_first_hour_is_no_change_and_what_leaks_later_is():
    filling = [round(100 + min(hour, 1.0) * 50) for hour in HOURS]
    assert largest_change(HOURS, filling) == 0.0
    assert slope(HOURS, filling) == pytest.approx((0.0, 0.0))
    leaking = [round(1000 + 100 * hour) for hour in HOURS]
    assert largest_change(HOURS, leaking) == pytest.approx((1390 - 1110) / 1110)
    assert slope(HOURS, leaking) == pytest.approx((100.0, 0.0))
    peak = [1000] * 38 + [900, 1000]
    assert largest_change(HOURS, peak) == pytest.approx(0.1)
    assert math.isnan(largest_change(HOURS[:12], leaking[:12]))
    assert math.isnan(slope(HOURS[:12], leaking[:12])[0])


def test_the_error_of_a_slope_is_that_of_its_repetitions():
    noise = np.random.default_rng(0).normal(0.0, 20.0, (400, len(HOURS)))
    slopes, errors = zip(*(slope(HOURS, 1000.0 + own) for own in noise), strict=True)
    assert np.std(slopes) == pytest.approx(np.mean(errors), rel=0.1)


def test_a_run_that_leaves_something_behind_does_not_do():
    good = Soak(60.0, 600.0, 3000, HOURS, {"slam": [100] * len(HOURS)}, statuses={"slam": 0})
    assert all(one.is_met for one in requirements(good))
    for fault in (
        {"leaked": {"/dev/shm/fastrtps_1"}},
        {"zombies": 1},
        {"dropped": 1},
        {"errors": {"/slam": "x"}},
        {"statuses": {"slam": -9}},
        {"log_seconds": 500.0},
        {"resident": {"slam": [100 + round(hour) for hour in HOURS]}},
    ):
        assert sum(not one.is_met for one in requirements(Soak(**{**vars(good), **fault}))) == 1


def test_a_run_that_is_too_short_for_that_is_refused(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["soak", "--minutes", "1"])
    assert ended.value.code == 2
    assert "1 minutes are too few for two hours of the log: give 12 or more" in capsys.readouterr().err
