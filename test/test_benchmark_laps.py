"""Laps over known ground: the requirements, and a measurement of a run."""

import pytest

from benchmark.laps import Lap, Laps, drive_laps, requirements
from benchmark.report import VALIDATION, document_marks
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.open_log import open_log


def laps(last, error=0.03, count=20):
    usual = Lap(10, 200, 200, 1_000_000, 250_000_000, 0, 1, 1.0)
    return Laps((*[usual] * (count - 1), last), (*[0.03] * (count - 1), error))


@pytest.mark.parametrize(
    ("last", "error", "unmet"),
    [
        (Lap(10, 209, 230, 2_000_000, 282_000_000, 20_000_000, 3, 1.09), 0.032, None),
        (Lap(11, 200, 200, 1_000_000, 250_000_000, 0, 1, 1.0), 0.03, "areas"),
        (Lap(10, 211, 200, 1_000_000, 250_000_000, 0, 1, 1.0), 0.03, "keyframes"),
        (Lap(10, 200, 200, 1_000_000, 263_000_000, 0, 1, 1.0), 0.03, "memory"),
        (Lap(10, 200, 200, 1_000_000, 250_000_000, 0, 1, 1.2), 0.03, "the cost of a scan"),
        (Lap(10, 200, 200, 1_000_000, 250_000_000, 0, 1, 1.0), 0.04, "the error"),
    ],
)
def test_what_grows_is_reported(last, error, unmet):
    failed = [requirement.name for requirement in requirements("office", laps(last, error)) if not requirement.is_met]
    assert failed == ([] if unmet is None else [f"office, lap 3 to 20: growth of {unmet}"])


def test_a_log_of_few_passes_is_compared_with_the_first():
    assert requirements("intel", laps(laps(None).laps[0], count=3))[0].name == "intel, lap 1 to 3: growth of areas"


def test_the_laps_of_a_run_are_measured():
    found = drive_laps("sim:office,size=0.7,rate=1.5,laps=2", None, 2, Configuration())
    assert len(found.laps) == len(found.errors) == 2
    assert all(3 <= lap.areas <= 6 and 100 < lap.keyframes <= lap.scans + 5 for lap in found.laps)
    scans = open_log("sim:office,size=0.7,rate=1.5,laps=2").scan_count
    assert 100 * scans < found.laps[1].recorded < 300 * scans
    assert all(lap.resident > 50_000_000 and lap.milliseconds > 0.1 for lap in found.laps)
    assert all(error < 0.15 for error in found.errors)


def test_the_document_has_a_place_for_the_tables():
    text = VALIDATION.read_text()
    assert all(text.count(mark) == 1 for mark in document_marks("laps"))
