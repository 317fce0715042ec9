"""Names of the code in the documents exist: classes, files, measurements."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

import hmt_slam_ros
from benchmark.__main__ import _GROUPS, MEASUREMENTS
from benchmark.report import ACCURACY, VALIDATION
from hmt_slam_ros.process_table import DOCUMENTS

PACKAGE = Path(hmt_slam_ros.__file__).parent
ROOT = PACKAGE.parent
DOCS = ROOT / "docs"
FOLDERS = ("concepts", "decisions", "guides", "reference")
PAGES = [ROOT / "CONTRIBUTING.md", *sorted(path for folder in FOLDERS for path in (DOCS / folder).rglob("*.md"))]
# ROS's own, and what is written in the same way.
FOREIGN = {"GraphML", "LaserScan", "MathJax", "OccupancyGrid", "PoseArray", "TFMessage"}


def attributes(node):
    """Members of a class, by the names under which they are declared or assigned."""
    for child in ast.walk(node):
        if isinstance(child, ast.FunctionDef):
            yield child.name
        elif isinstance(child, ast.AnnAssign) and isinstance(child.target, ast.Name):
            yield child.target.id
        elif isinstance(child, ast.Attribute) and isinstance(child.value, ast.Name) and child.value.id == "self":
            yield child.attr


@cache
def classes():
    """{class, or alias of a type, of the package or the benchmark: its members}."""
    found = {}
    for folder in (PACKAGE, ROOT / "benchmark"):
        for path in folder.rglob("*.py"):
            for node in ast.parse(path.read_text(encoding="utf-8")).body:
                if isinstance(node, ast.ClassDef):
                    found[node.name] = set(attributes(node))
                elif isinstance(node, ast.Assign):
                    found |= {target.id: set() for target in node.targets if isinstance(target, ast.Name)}
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_every_class_that_is_named_exists(page):
    text = page.read_text(encoding="utf-8")
    named = re.findall(r"`([A-Z][A-Za-z]*[a-z])(?:\.([a-z_]+))?(?:\([^`]*\))?`", text)
    for name, member in named:
        if name in FOREIGN or re.match("C[A-Z]", name):  # those of MRPT
            continue
        assert name in classes(), name
        assert not member or member in classes()[name], f"{name}.{member}"


@pytest.mark.parametrize("page", [ACCURACY, VALIDATION, *PAGES], ids=lambda path: path.name)
def test_every_file_that_is_named_exists(page):
    text = page.read_text(encoding="utf-8")
    for name in re.findall(r"`((?:[a-z_]+/)*[a-z_0-9]+\.py)`", text):
        assert any((folder / name).is_file() for folder in (PACKAGE, ROOT)), name


@pytest.mark.parametrize("page", sorted((DOCS / "concepts").glob("*.md")), ids=lambda path: path.name)
def test_a_concept_lists_each_of_its_files_once(page):
    _, _, table = page.read_text(encoding="utf-8").partition("## Where it lives")
    listed = re.findall(r"`([a-z_/0-9]+\.py)`", "\n".join(re.findall(r"^\|([^|]*)\|", table, re.MULTILINE)))
    assert len(listed) >= 5
    assert len(listed) == len(set(listed))
    assert all((PACKAGE / name).is_file() for name in listed)


@pytest.mark.parametrize("page", [ROOT / "README.md", ACCURACY, VALIDATION, *PAGES], ids=str)
def test_every_measurement_that_is_named_exists(page):
    text = page.read_text(encoding="utf-8")
    kinds = {kind for names in re.findall(r"-m benchmark ((?:[a-z]+ ?)+)", text) for kind in names.split()}
    assert kinds <= {*MEASUREMENTS, *_GROUPS}


def test_every_topic_and_every_document_is_in_the_reference():
    text = (DOCS / "reference" / "messages.md").read_text(encoding="utf-8")
    tree = ast.parse((PACKAGE / "ros" / "topics.py").read_text(encoding="utf-8"))
    constants = {
        node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    topics = {value for value in constants if re.fullmatch(r"[a-z_]+/[a-z_]+", value)} | {
        row.topic for row in DOCUMENTS
    }
    assert len(topics) > 20
    assert {topic for topic in topics if f"| {topic} |" not in text} == set()
    for row in DOCUMENTS:
        assert f'{{"document":"{row.document}","version":{row.version},' in text, row.document
