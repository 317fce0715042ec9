"""What a run says while it works, with a clock of its own."""

import io
from dataclasses import replace
from pathlib import Path

import pytest
from test_results_output_folder import SCANS, STAMPS, make_recorder

from hmt_slam_ros.cli.terminal import Progress, summary


class Stream(io.StringIO):
    def __init__(self, tty: bool) -> None:
        super().__init__()
        self.tty = tty

    def isatty(self) -> bool:
        return self.tty


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def run(tty: bool, seconds_per_scan: float, scans: int = 100) -> str:
    stream, clock = Stream(tty), Clock()
    with Progress(scans, log_seconds=200.0, stream=stream, clock=clock) as progress:
        for done in range(1, scans + 1):
            clock.now += seconds_per_scan
            progress(done)
    return stream.getvalue()


def test_a_short_run_into_a_file_prints_nothing() -> None:
    assert run(tty=False, seconds_per_scan=0.09) == ""


def test_a_long_run_into_a_file_says_a_whole_line_every_ten_seconds() -> None:
    lines = run(tty=False, seconds_per_scan=0.5).splitlines()
    assert lines[0] == "20/100 scans, 4.0 x real time, 40 s left"
    assert [line.split("/")[0] for line in lines] == ["20", "40", "60", "80", "100"]


def test_a_terminal_sees_one_moving_line_that_ends_full() -> None:
    text = run(tty=True, seconds_per_scan=0.5)
    assert text.count("\n") == 1
    last = text.rstrip("\n").rsplit("\r", 1)[1]
    assert "[########################] 100/100 scans" in last
    assert "the final map is being made" in last


def test_the_moving_line_is_not_drawn_for_every_scan_of_a_fast_run() -> None:
    assert run(tty=True, seconds_per_scan=0.001, scans=1000).count("\r") <= 12


def test_minutes_are_distinct() -> None:
    assert run(tty=False, seconds_per_scan=5.0, scans=20).startswith("2/20 scans, 2.0 x real time, 1 min 30 s left")


def test_the_time_left_does_not_count_what_came_before_the_first_scan() -> None:
    stream, clock = Stream(tty=False), Clock()
    with Progress(100, log_seconds=200.0, stream=stream, clock=clock) as progress:
        clock.now += 40.0  # kernels are compiled
        progress(0)
        for done in range(1, 31):
            clock.now += 0.5
            progress(done)
    assert stream.getvalue().splitlines() == ["0/100 scans, starting", "20/100 scans, 4.0 x real time, 40 s left"]


@pytest.mark.parametrize("tty", [False, True])
def test_a_log_without_scans_or_time_divides_by_nothing(tty: bool) -> None:
    stream = Stream(tty)
    with Progress(0, 0.0, stream=stream, clock=Clock()) as progress:
        progress(0)


def test_the_summary_counts_the_scans_of_the_newest_log() -> None:
    recording = make_recorder().finish(STAMPS)
    assert f" of {SCANS} scans, 0 dropped" in summary(Path("out"), recording, 10.0, 1.0)
    further = replace(recording, first_scans=(0, SCANS // 2))
    own = SCANS - SCANS // 2
    sentence = summary(Path("out"), further, 10.0, 1.0)
    assert f"out: {own} of {own} scans beside {SCANS // 2} of one log before, 0 dropped" in sentence
