"""What the documents tell users to type and to turn is there: commands, parameters, documents, pictures."""

import re
import shlex
from pathlib import Path

import pytest

import hmt_slam_ros
from hmt_slam_ros.cli.arguments import build_parser
from hmt_slam_ros.cli.main import main
from hmt_slam_ros.configuration import Configuration, flat_parameters, load_configuration

ROOT = Path(hmt_slam_ros.__file__).parents[1]
TUTORIAL = (ROOT / "docs" / "guides" / "tutorial.md").read_text(encoding="utf-8")
TUNING = (ROOT / "docs" / "guides" / "tuning.md").read_text(encoding="utf-8")
GUIDES = ("tutorial", "your_robot", "tuning", "troubleshooting")
FOR_USERS = (*(f"docs/guides/{name}.md" for name in GUIDES), "docs/reference/parameters.md")
ALL = ["README.md", *sorted(str(path.relative_to(ROOT)) for path in (ROOT / "docs").rglob("*.md"))]
# So that the test takes seconds, these see a part of their log, and what test_nodes_replay does is not done once more.
SHORTENED = {"map sim": ["--duration", "40"]}
NAMES = {hypothesis.name for hypothesis in flat_parameters(Configuration())}
GROUPS = {name.partition(".")[0] for name in NAMES if "." in name}


def commands(text):
    """The lines that are typed."""
    return re.findall(r"^    (hmt_slam .*)$", text, re.MULTILINE)


def shorten(command):
    return next((more for begin, more in SHORTENED.items() if command.startswith(f"hmt_slam {begin}")), [])


def test_every_command_of_the_tutorial_does_what_the_tutorial_says(tmp_path, monkeypatch, capsys):
    (tmp_path / "data").symlink_to(ROOT / "data")
    monkeypatch.chdir(tmp_path)
    assert len(commands(TUTORIAL)) >= 8
    messages = []
    for command in commands(TUTORIAL):
        if command.startswith("hmt_slam replay"):
            build_parser().parse_args(shlex.split(command)[1:])
            continue
        assert main([*shlex.split(command)[1:], *shorten(command)]) == 0, command
        messages += capsys.readouterr().out.splitlines()
    for shown in re.findall(r"^    ((?!hmt_slam|ros2|\.\.\.).*)$", TUTORIAL, re.MULTILINE):
        assert any(line.startswith(shown.removesuffix("...")) for line in messages), shown
    for path in re.findall(r"`(output/[^`]+)`", TUTORIAL):
        assert (tmp_path / path).exists(), path
    for name in ("pmf.png", "cost.png", "trajectory.tum", "report.json"):
        assert name in TUTORIAL
        assert (tmp_path / "output" / "tutorial" / name).exists()


@pytest.mark.parametrize("document", ("README.md", *FOR_USERS))
def test_every_parameter_that_is_named_exists(document):
    named = re.findall(r"\b([a-z_]+)\.([a-z_0-9]+)\b(?!/)", (ROOT / document).read_text(encoding="utf-8"))
    strange = {f"{group}.{name}" for group, name in named if group in GROUPS} - NAMES
    assert not strange - {"robot.md"}


def test_every_value_that_the_tuning_guide_proposes_is_possible():
    proposed = re.findall(r"`([a-z_]+\.[a-z_]+)`(?: \(|: | )(\d+(?:\.\d+)?)", TUNING)
    assert len(proposed) >= 12
    for name, value in proposed:
        (hypothesis,) = (hypothesis for hypothesis in flat_parameters(Configuration()) if hypothesis.name == name)
        load_configuration(None, [f"{name}={hypothesis.kind(float(value))}"], None)


@pytest.mark.parametrize("document", FOR_USERS)
def test_the_readme_leads_to_it(document):
    assert document in (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("document", ALL)
def test_what_it_links_to_exists(document):
    path = ROOT / document
    text = path.read_text(encoding="utf-8")
    for link in re.findall(r"\]\(((?!http)[^)#]+)", text):
        assert (path.parent / link).exists(), link
    for name in re.findall(r"\bdocs/[a-z_/0-9-]+\.md\b", text):
        assert (ROOT / name).exists(), name


@pytest.mark.parametrize(("kind", "most"), (("png", 500_000), ("svg", 250_000)))
def test_the_pictures_are_small(kind, most):
    assert sum(path.stat().st_size for path in (ROOT / "docs" / "images").glob(f"*.{kind}")) < most
