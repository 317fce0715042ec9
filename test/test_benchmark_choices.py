"""The choices that are measured exist, and their outcomes become one table a log."""

import json

from benchmark.choices import AS_CONFIGURED, CHOICES, measure_choices
from benchmark.logs import opened
from benchmark.runs import Case, Runner
from benchmark.settings import Settings
from benchmark.simulated.records import Records
from hmt_slam_ros.configuration import Configuration, with_changes


def test_every_choice_changes_the_configuration():
    for name, changes in CHOICES.items():
        values = dict(change.split("=") for change in changes)
        changed = with_changes(Configuration(), {key: json.loads(value) for key, value in values.items()})
        assert (changed != Configuration()) == (name != AS_CONFIGURED)


def test_every_choice_is_run_on_every_log_and_told(tmp_path, monkeypatch):
    two = {AS_CONFIGURED: (), "no refinement": ("refinement.iterations=0",)}
    monkeypatch.setattr("benchmark.choices.CHOICES", two)
    short = ("robot.duration=8",)
    folder = tmp_path / "runs"
    settings = Settings(("malaga",), (0,), short, tmp_path, False, Runner(folder, 1), Records(folder, 1))
    report = measure_choices(settings)
    for name in two:
        assert any(line.startswith(f"| {name} | ") for line in report.text.splitlines())
    outcomes = report.data["choices"]["malaga"]
    assert outcomes["no refinement"]["changes"] == ["refinement.iterations=0"]
    assert all(outcome["cpu_seconds"] > 0.0 for outcome in outcomes.values())


def test_runs_with_other_parameters_have_folders_of_their_own():
    with opened(["malaga"]) as (log,):
        names = {Case(log, 0, changes=changes).name for changes in ((), ("a.b=1",), ("a.b=2",))}
    assert len(names) == 3
