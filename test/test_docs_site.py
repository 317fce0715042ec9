"""The documents make a site without a warning: every link leads somewhere; of the API with the pages of one folder."""

import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
TOOLS = ("sphinx", "myst_parser", "autoapi")
MISSING = [name for name in TOOLS if find_spec(name) is None]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    if MISSING:
        pytest.skip(f"{', '.join(MISSING)} not installed: pip install -e .[docs]")
    folder = tmp_path_factory.mktemp("site")
    command = (sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-d", folder / "doctrees", DOCS, folder)
    environment = {**os.environ, "HMT_DOCS_API": "geometry"}
    built = subprocess.run(
        list(map(str, command)), cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert built.returncode == 0, built.stderr
    return folder


def test_it_builds_without_a_warning_and_has_every_page(site):
    for page in DOCS.rglob("*.md"):
        assert (site / page.relative_to(DOCS)).with_suffix(".html").is_file(), page


def test_it_has_the_api_without_an_import_of_the_package(site):
    page = (site / "reference" / "api" / "hmt_slam_ros" / "geometry" / "se2" / "index.html").read_text(encoding="utf-8")
    assert "compose" in page
    assert not (DOCS / "reference" / "api").exists(), "what is generated for a build stays out of the sources"


def test_every_decision_is_in_the_index_and_has_its_parts():
    index = (DOCS / "decisions" / "index.md").read_text(encoding="utf-8")
    records = sorted((DOCS / "decisions").glob("[0-9]*.md"))
    assert records
    for number, record in enumerate(records, start=1):
        text = record.read_text(encoding="utf-8")
        assert record.name.startswith(f"{number:04d}-"), record.name
        assert f"({record.name})" in index, record.name
        assert re.findall(r"^## (.*)$", text, re.MULTILINE) == ["Context", "Decision", "Evidence", "Rejected"]


def test_every_concept_has_its_picture_and_at_most_ten_steps():
    for page in (DOCS / "concepts").glob("*.md"):
        text = page.read_text(encoding="utf-8")
        assert re.search(r"!\[[^]]+\]\(\.\./images/concept_[a-z_]+\.svg\)", text), page.name
        steps = [int(number) for number in re.findall(r"^(\d+)\. ", text, re.MULTILINE)]
        assert steps == [*range(1, len(steps) + 1)], page.name
        assert len(steps) <= 10, page.name
        assert "## Where it lives" in text, page.name
