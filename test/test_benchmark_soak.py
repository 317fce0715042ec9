"""Requirements on a long run of the nodes."""

import math

import pytest

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from benchmark.__main__ import main
from benchmark.soak import Soak, growth, requirements


def test_what_fills_up_in_the_first_half_is_no_growth_and_what_leaks_is():
    filling = [min(100 + k, 150) for k in range(100)]
    assert growth(filling) == pytest.approx(0.0)
    leaking = [1000 + k for k in range(100)]
    assert growth(leaking) == pytest.approx(40 / 1054.5)
    assert math.isnan(growth([1, 2, 3]))


def test_a_run_that_leaves_something_behind_does_not_do():
    good = Soak(60.0, 600.0, 3000, {"slam": [100] * 100}, statuses={"slam": 0})
    assert all(one.is_met for one in requirements(good))
    for fault in (
        {"leaked": {"/dev/shm/fastrtps_1"}},
        {"zombies": 1},
        {"dropped": 1},
        {"errors": {"/slam": "x"}},
        {"statuses": {"slam": -9}},
        {"log_seconds": 500.0},
        {"resident": {"slam": [100 + k for k in range(100)]}},
    ):
        assert sum(not one.is_met for one in requirements(Soak(**{**vars(good), **fault}))) == 1


def test_a_run_that_is_too_short_for_that_is_refused(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["soak", "--minutes", "1"])
    assert ended.value.code == 2
    assert "1 minutes are too few for the growth of memory: give 2 or more" in capsys.readouterr().err
