"""One language: names and prose use the terms of the field and American spelling; a class name has one meaning."""

import ast
import io
import re
import tokenize
from collections import Counter
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

import hmt_slam_ros

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = Path(hmt_slam_ros.__file__).parent

PROSE_FOLDERS = (PACKAGE, ROOT / "benchmark", ROOT / "scripts", ROOT / "test")
"""Folders whose docstrings, comments and locals have no retired words, and whose functions are verbs or nouns."""

NAME_FOLDERS = (PACKAGE, ROOT / "benchmark", ROOT / "scripts")
"""Folders whose names of classes and functions are those of the field."""

BRITISH = re.compile(
    r"(ali|lli|mali|iti|ari|ymmetri|chroni|timi|teri|ogni|rmali|ocali)s(e|ed|es|ing|ation|er)(?![a-z])"
    r"|colour|neighbour|centre|\bgrey|metre(?!rs)|travell|labell|modell(?!i$)|behaviour"
)

# Names of functions that do not say what is returned or done.
BARE = {"of", "told", "said", "asked", "heard", "left", "seen", "looked", "compared", "moved", "carried", "settle"}

IRREGULAR = re.compile(
    "begun|bought|broken|brought|built|caught|chosen|done|drawn|driven|fallen|felt|forgot|forgotten|found|given|gone|grown"
    "|heard|held|hidden|kept|known|laid|learnt|left|lost|made|meant|met|ran|risen|said|seen|sent|shown|sought|spoilt|spoken"
    "|stood|struck|stuck|taken|taught|thought|thrown|told|torn|woken|worn|written"
)
PREPOSITIONS = re.compile(
    "above|after|ahead|along|apart|around|aside|at|away|back|before|behind|below|beside|between|beyond|by|for|from|in|into|of"
    "|off|on|once|onto|over|through|to|towards?|twice|under|upon|with|within|without"
)
NOUNS_IN_ED = {"bed", "feed", "need", "seed", "shed", "speed"}

ALLOWED_FUNCTIONS = {
    "between": "the motion from one pose to another, as in ``se2``",
    "nested": "a family of simulated buildings, by its name in logs",
    "to": "the drive to a pose, in the play of a test",
}
"""{bare name of a function in ``PROSE_FOLDERS`` that stays: reason}."""

RETIRED = re.compile(
    r"(?<![\w`/\"=.-])(told|foretold|said|asked|heard|hears?|whereabouts|errands?|awakenings?|astray|carried|news|beheld"
    r"|leaf|claims?|claimed|doubts?|doubted|doubtful|anew|somebody)(?![\w`/\"=-])",
    re.IGNORECASE,
)
RETIRED_NAMES = {"told", "said", "asked", "heard", "leaf", "leaves", "news", "whereabouts", "errand", "errands"}
RETIRED_NAMES |= {"astray", "doubts", "spots"}

DOCTOR = ("beams", "finding", "odometry", "readings", "running", "timing")

ALLOWED_PROSE = {
    "benchmark/awakening.py": {"awakening"},  # Robot awakening [B], the kind of the measurement
    "benchmark/__main__.py": {"awakening"},
    **{f"hmt_slam_ros/doctor/{name}.py": {"doubtful"} for name in DOCTOR},  # a severity of findings
    "hmt_slam_ros/topological_inference/global_localization.py": {"awakening"},  # the paper's word
    "test/test_configuration_tree.py": {"leaf", "leaves"},  # of the tree of parameters
    "test/test_ros_parameters.py": {"leaf", "leaves"},
    "test/test_saved_map.py": {"doubt"},  # a field of the example
    "test/logs_for_nodes.py": {"carried"},  # a setting of simulated worlds
}
"""{file: retired words that are terms there}."""


def python_files(*folders):
    return [path for folder in folders for path in sorted(folder.rglob("*.py"))]


def name_of(path):
    """The path of a file below the root, for reports and ``ALLOWED_PROSE``."""
    return path.relative_to(ROOT if path.is_relative_to(ROOT) else PACKAGE.parent).as_posix()


class Words(NamedTuple):
    """What is named and written in a file.

    :ivar classes: names of classes at any depth.
    :ivar functions: names of functions at any depth.
    :ivar prose: docstrings and comments, each as (line, text).
    :ivar identifiers: parameters and variables, each as (line, name).
    """

    classes: list[str]
    functions: list[str]
    prose: list[tuple[int, str]]
    identifiers: list[tuple[int, str]]


@cache
def words_of(path):
    """The words of a file."""
    source, words = path.read_text(), Words([], [], [], [])
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ClassDef):
            words.classes.append(node.name)
        elif isinstance(node, ast.FunctionDef):
            words.functions.append(node.name)
        elif isinstance(node, ast.arg):
            words.identifiers.append((node.lineno, node.arg))
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            words.identifiers.append((node.lineno, node.id))
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            words.prose.extend(strings_of(node))
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            words.prose.append((token.start[0], token.string))
    return words


def strings_of(node):
    """Strings that are statements of their own in a module, a class or a function, each as (line, text)."""
    for statement in node.body:
        if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
            yield statement.lineno, str(statement.value.value)


def is_bare(name):
    """Whether the name of a function is a participle, an adverb or a preposition alone."""
    word = name.strip("_")
    participle = IRREGULAR.fullmatch(word) or (word.endswith("ed") and word.isalpha() and word not in NOUNS_IN_ED)
    return bool(participle or PREPOSITIONS.fullmatch(word))


@pytest.mark.parametrize("folder", (PACKAGE, ROOT / "benchmark"), ids=lambda folder: folder.name)
def test_a_class_name_has_one_meaning(folder):
    names = Counter(
        node.name.lstrip("_")
        for path in python_files(folder)
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.ClassDef)
    )
    assert not {name for name, count in names.items() if count > 1}


@pytest.mark.parametrize("path", python_files(*NAME_FOLDERS), ids=name_of)
def test_names_are_the_fields_and_american(path):
    words = words_of(path)
    names = {name.lstrip("_") for name in words.classes + words.functions}
    assert not names & BARE
    assert not {name for name in names if BRITISH.search(name.replace("_", " "))}


@pytest.mark.parametrize("path", python_files(*PROSE_FOLDERS), ids=name_of)
def test_functions_are_verbs_or_nouns(path):
    assert not {name for name in words_of(path).functions if is_bare(name)} - ALLOWED_FUNCTIONS.keys()


@pytest.mark.parametrize("path", python_files(*PROSE_FOLDERS), ids=name_of)
def test_prose_and_locals_have_no_retired_words(path):
    if path == Path(__file__).resolve():
        return
    allowed = ALLOWED_PROSE.get(name_of(path), set())
    words = [
        (line, match.group())
        for line, text in words_of(path).prose
        for pattern in (RETIRED, BRITISH)
        for match in pattern.finditer(text)
        if match.group().lower() not in allowed
    ]
    names = [(line, name) for line, name in words_of(path).identifiers if name in RETIRED_NAMES - allowed]
    assert not words + names


@pytest.mark.parametrize("path", python_files(ROOT / "test"), ids=name_of)
def test_the_names_of_tests_have_no_retired_words(path):
    words = words_of(path)
    names = [name.replace("_", " ") for name in words.classes + words.functions if name.startswith("test_")]
    assert not [name for name in names if RETIRED.search(name) or BRITISH.search(name)]
