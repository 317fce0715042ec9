"""One language: a class name means one thing in the whole package, and names are spelled as ROS spells them."""

import ast
import re
from collections import Counter
from pathlib import Path

import pytest

import hmt_slam_ros

FILES = sorted(Path(hmt_slam_ros.__file__).parent.rglob("*.py"))
BRITISH = re.compile(
    r"(ali|lli|mali|iti|ari|ymmetri|chroni|timi|teri|ogni)s(e|ed|es|ing|ation|er)(_|$)|colour|neighbour|centre|grey"
)
# Names of functions that say nothing of what is returned or done.
BARE = {"of", "told", "said", "asked", "heard", "left", "seen", "looked", "compared", "moved", "carried", "settle"}


def definitions(path):
    """Classes and functions of a file at any depth."""
    return [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ClassDef | ast.FunctionDef)]


def test_a_class_name_has_one_meaning():
    names = Counter(
        node.name.lstrip("_")
        for path in FILES
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.ClassDef)
    )
    assert not {name for name, count in names.items() if count > 1}


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(FILES[0].parent)))
def test_names_are_the_fields_and_american(path):
    names = {node.name.lstrip("_") for node in definitions(path)}
    assert not names & BARE
    assert not {name for name in names if BRITISH.search(name)}
