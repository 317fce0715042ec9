"""Reports, the tables in the documents, the logs that are measured on, and what a run costs."""

import json
import lzma
import subprocess
import sys

import numpy as np
import pytest

from benchmark.logs import ROOT, open_logs, reason_missing
from benchmark.report import ACCURACY, Report, Requirement, document_marks, write_between_marks
from hmt_slam_ros.errors import HmtSlamError


def test_a_report_is_complete_as_text_and_for_programs(tmp_path):
    report = Report("accuracy", "Title", requirements=[Requirement("figure", float("nan"), 1.0, "m")])
    report.body.append("body")
    report.pictures["picture.png"] = "caption"
    report.write(tmp_path, {"machine": "a computer"})
    text = (tmp_path / "accuracy.md").read_text()
    for part in ("# Title", "| figure | nan m | 1 m | FAIL |", "body", "![caption](picture.png)"):
        assert part in text
    assert "| machine | a computer |" in text
    assert '"value": null' in (tmp_path / "accuracy.json").read_text()


def test_logs_are_decompressed_and_vanish(tmp_path, monkeypatch):
    monkeypatch.setenv("HMT_SLAM_DATASETS", str(tmp_path))
    assert "aces.clf.xz is not in" in reason_missing("aces")
    for name, text in (("aces.clf.xz", "# a log\n"), ("aces.relations.xz", "1 2 3 0 0 0 0 0\n")):
        (tmp_path / name).write_bytes(lzma.compress(text.encode()))
    assert not reason_missing("aces")
    with open_logs(["aces", "malaga"]) as (aces, malaga):
        assert aces.path.read_text() == "# a log\n"
        assert aces.relations.poses.tolist() == [[3.0, 0.0, 0.0]]
        assert malaga.relations is None
    assert not aces.path.exists()
    assert malaga.path.exists()


@pytest.mark.parametrize(("name", "words"), [("mars", "choose from aces"), ("intel", "set HMT_SLAM_DATASETS")])
def test_a_log_that_is_not_there_is_named_with_the_remedy(tmp_path, monkeypatch, name, words):
    monkeypatch.setenv("HMT_SLAM_DATASETS", str(tmp_path))
    with pytest.raises(HmtSlamError, match=words), open_logs([name]):
        pass


def test_the_memory_of_a_program_is_not_that_of_the_one_that_starts_it():
    ballast = np.ones(40_000_000)
    command = [sys.executable, "-m", "benchmark.measured", sys.executable, "-c", "sum(range(3_000_000)); print('done')"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    usage = json.loads(result.stdout)
    assert usage["status"] == 0
    assert 0.0 < usage["cpu_s"] < 10.0
    assert 1_000_000 < usage["peak_rss_bytes"] < 100_000_000 < ballast.nbytes
    assert result.stderr == "done\n"


def test_tables_are_written_between_their_marks_and_nowhere_else(tmp_path):
    document = tmp_path / "document.md"
    (begin, end), (other, _) = document_marks("speed"), document_marks("sessions")
    document.write_text(f"before\n{begin}\nold\n{end}\nafter\n")
    write_between_marks(document, "speed", "| new |")
    assert document.read_text() == f"before\n{begin}\n| new |\n{end}\nafter\n"
    with pytest.raises(HmtSlamError, match="sessions"):
        write_between_marks(document, "sessions", "| new |")
    assert other not in document.read_text()


@pytest.mark.parametrize("kind", ["accuracy", "odometry", "robustness", "sessions", "speed"])
def test_the_document_has_a_place_for_every_measurement(kind):
    text = ACCURACY.read_text()
    assert all(text.count(mark) == 1 for mark in document_marks(kind))
