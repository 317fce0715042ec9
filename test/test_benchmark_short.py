"""The short form of the measurements: a regression fails, noise does not."""

import json
import re

import pytest

from benchmark import short
from benchmark.__main__ import main
from benchmark.short import EXPECTED, PARTS, Expected, Part, read_expected, regressions, write_expected
from hmt_slam_ros.errors import HmtSlamError

FIGURES = {"aces": {"translation_m": [0.040, 0.042, 0.041, 0.039, 0.043], "relations_missed": [0.0] * 5}}


@pytest.fixture
def expected_figures(tmp_path):
    write_expected(tmp_path / "expected.toml", FIGURES)
    return read_expected(tmp_path / "expected.toml")


def test_what_is_written_is_read(expected_figures):
    assert expected_figures["aces"]["translation_m"].mean == pytest.approx(0.041)
    assert expected_figures["aces"]["translation_m"].std == pytest.approx(0.00158, abs=1e-5)
    assert expected_figures["aces"]["relations_missed"] == Expected(0.0, 0.0, seeds=5)


def test_the_bound_is_four_standard_errors_above_the_mean():
    assert Expected(1.0, 0.1, seeds=10).bound(2) == pytest.approx(1.0 + 4.0 * 0.1 * (1 / 2 + 1 / 10) ** 0.5)
    assert Expected(1.0, 0.001, seeds=10).bound(10) == pytest.approx(1.02)


def test_the_same_figures_pass_and_others_within_the_noise_too(expected_figures):
    assert all(r.is_met for r in regressions("aces", FIGURES["aces"], expected_figures["aces"]))
    other = {"translation_m": [0.043, 0.044], "relations_missed": [0.0, 0.0]}
    assert all(r.is_met for r in regressions("aces", other, expected_figures["aces"]))


@pytest.mark.parametrize(
    "worse",
    [
        {"translation_m": [0.047, 0.047], "relations_missed": [0.0, 0.0]},
        {"translation_m": [0.041, 0.041], "relations_missed": [0.0, 1.0]},
        {"translation_m": [0.041, float("nan")], "relations_missed": [0.0, 0.0]},
    ],
)
def test_a_figure_that_became_worse_fails(expected_figures, worse):
    assert [r.is_met for r in regressions("aces", worse, expected_figures["aces"])].count(False) == 1


def test_a_figure_of_which_nothing_is_expected_is_no_pass(expected_figures):
    with pytest.raises(HmtSlamError, match="--write-expected"):
        regressions("aces", {**FIGURES["aces"], "new": [1.0]}, expected_figures["aces"])
    with pytest.raises(HmtSlamError, match="relations_missed"):
        regressions("aces", {"translation_m": [0.041]}, expected_figures["aces"])


def test_something_is_expected_of_every_part():
    assert set(read_expected(EXPECTED)) == {part.log for part in PARTS}


@pytest.fixture
def without_datasets(tmp_path, monkeypatch):
    monkeypatch.setenv("HMT_SLAM_DATASETS", str(tmp_path / "none"))


@pytest.mark.long
def test_a_regression_of_the_bundled_log_fails_the_command(tmp_path, monkeypatch, without_datasets):
    """The whole command, on the real log, against a record that is stricter in one figure."""
    record = EXPECTED.read_text()
    strict = re.sub(r"^disagreement = .*", "disagreement = { mean = 0.01, std = 0.001 }", record, flags=re.MULTILINE)
    (tmp_path / "strict.toml").write_text(strict)
    monkeypatch.setattr(short, "EXPECTED", tmp_path / "strict.toml")
    monkeypatch.setattr(short, "PARTS", (Part("malaga", 0.0, 1), *PARTS[1:]))
    assert main(["short", "--out", str(tmp_path / "report")]) == 1
    requirements = json.loads((tmp_path / "report" / "short.json").read_text())["requirements"]
    assert [requirement["name"] for requirement in requirements if not requirement["met"]] == [
        "malaga: disagreement, mean of 1"
    ]
    assert len(requirements) == 4
    assert "Skipped aces: aces.clf.xz is not in" in (tmp_path / "report" / "short.md").read_text()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["short", "--write-expected"], "not all expected figures can be measured"),
        (["accuracy", "--logs", "mars"], "there is no log 'mars'"),
        (["accuracy", "--write-docs", "--logs", "malaga"], "leave --set and --logs away"),
        (["accuracy", "--logs", "malaga", "--seeds", "1", "--set", "no.such=1"], "the run malaga-no.such_1-0 failed"),
    ],
)
def test_a_wrong_command_is_one_sentence_and_status_2(tmp_path, capsys, without_datasets, arguments, words):
    assert main([*arguments, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert words in error


def test_a_report_is_never_written_over_another(tmp_path, capsys):
    (tmp_path / "accuracy.md").write_text("old")
    assert main(["accuracy", "--out", str(tmp_path)]) == 2
    assert "is there already" in capsys.readouterr().err
