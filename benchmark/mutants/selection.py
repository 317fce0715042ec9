"""Which tests run on a mutant, in which order, and whether their kernels are compiled."""

from __future__ import annotations

import ast
import hashlib
import json
import re
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

from benchmark.mutants.mutations import PACKAGE, Mutant
from benchmark.mutants.sandbox import Sandbox, changes_kernels
from hmt_slam_ros.errors import HmtSlamError

TESTS = (
    "geometry",
    "registration",
    "grids",
    "submap",
    "hybrid_map",
    "area_abstraction",
    "topological_inference",
    "loop_closure",
    "real_time_localization",
    "metric_slam",
    "lifelong",
    "landmarks",
    "places",
)
"""Folders of the package whose tests are run, on any mutant."""

_INTERPRETED_AT_MOST = 12.0
"""Time that a test file may take without compilation, s, to be run so on mutants of kernels."""

_MOST_OTHERS = 6
"""Test files of other folders that run among the first on a mutant, at most."""

_PER_FILE, _COMPILATION, _START = 6.0, 120.0, 30.0
"""Time for a test file, to compile kernels, and to start, s, after which a mutant counts as killed."""


class Trial(NamedTuple):
    """Test files that run in one process.

    :ivar files: names in the folder test.
    :ivar compiled: whether kernels are compiled.
    """

    files: tuple[str, ...]
    compiled: bool


def longest(trial: Trial) -> float:
    """The time after which a mutant counts as killed, s."""
    return (_COMPILATION if trial.compiled else _START) + _PER_FILE * len(trial.files)


class Baseline:
    """How the test files do without a mutant; kept in the copy, for later calls.

    A test that fails without a mutant would count as its killer: all run again where the package has changed.
    """

    def __init__(self, sandbox: Sandbox) -> None:
        self._sandbox = sandbox
        self._path = sandbox.folder / "baseline.json"
        self._package = _digest(*sorted((sandbox.folder / PACKAGE.name).rglob("*.py")))
        self._known: dict[str, bool] = json.loads(self._path.read_text()) if self._path.exists() else {}

    def verify(self, names: Sequence[str]) -> None:
        """Run the test files that are new or have changed, or all for another package; this also caches kernels.

        :raises HmtSlamError: where a test fails.
        """
        keys = {name: f"{self._key(name, 'compiled')} {self._package}" for name in names}
        new = [name for name in names if keys[name] not in self._known]
        if not new:
            return
        run = self._sandbox.run_tests(new, _COMPILATION + 10.0 * _PER_FILE * len(new))
        if run.status != "passed":
            raise HmtSlamError(f"without a mutant {run.failed or run.output} ({run.status}): mend it first")
        self._note(dict.fromkeys((keys[name] for name in new), True))

    def is_interpretable(self, name: str) -> bool:
        """Whether a test file passes without compilation, and soon enough."""
        key = self._key(name, "interpreted")
        if key not in self._known:
            run = self._sandbox.run_tests([name], _INTERPRETED_AT_MOST, compiled=False)
            self._note({key: run.status == "passed"})
        return self._known[key]

    def _key(self, name: str, way: str) -> str:
        return f"{name} {_digest(self._sandbox.folder / 'test' / name)} {way}"

    def _note(self, results: dict[str, bool]) -> None:
        self._known |= results
        self._path.write_text(json.dumps(self._known, indent=1))


def _digest(*paths: Path) -> str:
    return hashlib.sha256(b"".join(path.read_bytes() for path in paths)).hexdigest()[:12]


def plan_near(mutant: Mutant, baseline: Baseline) -> Trial:
    """The tests of a mutant's folder, and those that name something of its module.

    Kernels are interpreted, as compilation takes longer: of their tests, only those that then take little time.
    """
    near = tuple(near_tests(mutant.module))
    interpreted = tuple(name for name in near if baseline.is_interpretable(name)) if changes_kernels(mutant) else ()
    return Trial(interpreted, False) if interpreted else Trial(near, True)


def plan_own(mutant: Mutant, baseline: Baseline) -> Trial:
    """The tests of the module itself, unless they have run."""
    own, done = "test_" + mutant.module.replace("/", "_"), plan_near(mutant, baseline).files
    return Trial((own,) if own in unit_tests() and own not in done else (), True)


def plan_far(mutant: Mutant, baseline: Baseline) -> Trial:
    """All other tests; those that name most of the module come first."""
    done = {*plan_near(mutant, baseline).files, *plan_own(mutant, baseline).files}
    others = [name for name in unit_tests() if name not in done]
    return Trial(tuple(sorted(others, key=lambda name: -relevance(mutant.module, name))), True)


STAGES = (plan_near, plan_own, plan_far)
"""What is run in turn, each on those that survived the stage before."""


@cache
def near_tests(module: str) -> list[str]:
    """The tests of a module's folder, and some that name most of its functions; these come first."""
    prefix = f"test_{module.partition('/')[0]}"
    ordered = sorted(unit_tests(), key=lambda name: -relevance(module, name))
    others = [name for name in ordered if relevance(module, name) and not name.startswith(prefix)][:_MOST_OTHERS]
    return [name for name in ordered if name.startswith(prefix) or name in others]


@cache
def unit_tests() -> list[str]:
    """The test files that run on mutants, names in the folder test."""
    paths = sorted((PACKAGE.parent / "test").glob("test_*.py"))
    return [path.name for path in paths if path.name.startswith(tuple(f"test_{each}" for each in TESTS))]


@cache
def relevance(module: str, name: str) -> int:
    """How many functions and classes of a module a test file names."""
    text = (PACKAGE.parent / "test" / name).read_text(encoding="utf-8")
    words = set(re.findall(r"\w+", text))
    return len(words & _defined_names(PACKAGE / module)) if _imports(text, module) else 0


def _imports(text: str, module: str) -> bool:
    path = "hmt_slam_ros." + module.removesuffix(".py").replace("/", ".")
    parent, _, name = path.rpartition(".")
    return path in text or re.search(rf"from {re.escape(parent)} import .*\b{name}\b", text) is not None


@cache
def _defined_names(path: Path) -> frozenset[str]:
    nodes: Iterable[ast.AST] = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    return frozenset(node.name for node in nodes if isinstance(node, (ast.FunctionDef, ast.ClassDef)))
