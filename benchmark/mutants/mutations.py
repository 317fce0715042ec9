"""Mutants: small faults of one module each, drawn from the operators of cosmic-ray or planted by hand."""

from __future__ import annotations

import ast
import difflib
import hashlib
import re
import tomllib
import zlib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmark.logs import ROOT
from hmt_slam_ros.errors import HmtSlamError

PACKAGE = ROOT / "hmt_slam_ros"

FOLDERS = ("geometry", "registration", "hybrid_map", "topological_inference", "loop_closure", "real_time_localization")
"""Folders of the package whose modules are mutated; hybrid_map has the arcs and surroundings."""

SINGLE_MODULES = ("places/relocalization_prior.py",)
"""Further modules that are mutated."""

LEAST_MUTANTS = 3
"""Mutants of a module, at least."""

_HERE = Path(__file__).parent
PLANTED = _HERE / "planted.toml"
"""Faults that no test noticed once."""

EQUIVALENT = _HERE / "equivalent.toml"
"""Mutants that change no result, each with the reason."""

_ARITHMETIC = "Add|Sub|Mul|Div"
_ORDER = "Lt|LtE|Gt|GtE|Eq|NotEq"
_OPERATORS = re.compile(
    rf"ReplaceBinaryOperator_({_ARITHMETIC}|FloorDiv|Mod|Pow)_({_ARITHMETIC})|ReplaceBinaryOperator_BitAnd_BitOr|"
    rf"ReplaceComparisonOperator_({_ORDER})_({_ORDER})|ReplaceComparisonOperator_(Is_IsNot|IsNot_Is)|"
    "ReplaceUnaryOperator_Delete_(USub|Not|Invert)|ReplaceAndWithOr|ReplaceOrWithAnd|ReplaceTrueWithFalse|"
    "ReplaceFalseWithTrue|AddNot|NumberReplacer|ZeroIterationForLoop|ReplaceBreakWithContinue|ReplaceContinueWithBreak"
)
"""Operators of cosmic-ray that are used. Shifts and bit operations on floats fail at once, and prove nothing."""


class Mutant(NamedTuple):
    """A module with one fault.

    :ivar module: path below the package.
    :ivar line: of the fault, from 1.
    :ivar before: the lines that the fault changes, without indentation.
    :ivar after: the same with the fault.
    :ivar operator: of cosmic-ray, or the name of a planted fault.
    :ivar source: the whole module with the fault.
    """

    module: str
    line: int
    before: str
    after: str
    operator: str
    source: str

    @property
    def key(self) -> str:
        """A name for the mutant, which changes with the module."""
        return hashlib.sha256(f"{self.module}\n{self.source}".encode()).hexdigest()[:16]


def core_modules() -> list[str]:
    """The modules that are mutated, as paths below the package."""
    paths = [path for folder in FOLDERS for path in sorted((PACKAGE / folder).glob("*.py"))]
    names = [path.relative_to(PACKAGE).as_posix() for path in paths if path.name != "__init__.py"]
    return [*names, *SINGLE_MODULES]


def draw_mutants(modules: Sequence[str], count: int, seed: int) -> list[Mutant]:
    """About ``count`` mutants, shared out by the number of places that can be mutated.

    A place is drawn first, without replacement, then one of its mutations: otherwise places with many would prevail.

    :raises HmtSlamError: where cosmic-ray is not installed.
    """
    places = {module: _list_places((PACKAGE / module).read_text(encoding="utf-8")) for module in modules}
    total = sum(map(len, places.values()))
    mutants = []
    for module, own in places.items():
        rng = np.random.default_rng([seed, zlib.crc32(module.encode())])
        share = min(len(own), max(LEAST_MUTANTS, round(count * len(own) / max(1, total))))
        chosen = [own[place][rng.integers(len(own[place]))] for place in rng.permutation(len(own)).tolist()]
        drawn = (_make_mutant(module, operator, occurrence) for operator, occurrence in chosen)
        valid = islice((mutant for mutant in drawn if _is_valid(mutant)), share)
        mutants += sorted(valid, key=lambda mutant: mutant.line)
    return mutants


def _is_valid(mutant: Mutant) -> bool:
    """Whether the fault leaves Python that can be run: cosmic-ray takes the star of ``{*a, b}`` for a product."""
    try:
        ast.parse(mutant.source)
    except SyntaxError:
        return False
    return True


def planted_mutants() -> list[Mutant]:
    """The faults of `PLANTED`.

    :raises HmtSlamError: where a module has not exactly one place for its fault.
    """
    mutants = []
    for entry in read_entries(PLANTED):
        source = (PACKAGE / entry["module"]).read_text(encoding="utf-8")
        if source.count(entry["before"]) != 1:
            raise HmtSlamError(f"{PLANTED.name}: {entry['module']} has not exactly one {entry['before']!r}: adapt it")
        mutated = source.replace(entry["before"], entry["after"])
        mutants.append(_describe(entry["module"], entry["name"], source, mutated))
    return mutants


def equivalent_reasons() -> dict[tuple[str, str, str], str]:
    """{(module, before, after): why the mutant changes no result}."""
    return {(each["module"], each["before"], each["after"]): each["reason"] for each in read_entries(EQUIVALENT)}


def read_entries(path: Path) -> list[dict[str, str]]:
    """The entries of `PLANTED` or `EQUIVALENT`."""
    entries: list[dict[str, str]] = tomllib.loads(path.read_text(encoding="utf-8"))["mutant"]
    return entries


def _make_mutant(module: str, operator: str, occurrence: int) -> Mutant:
    source = (PACKAGE / module).read_text(encoding="utf-8")
    mutated = _load_cosmic_ray().mutate_code(source, _load_operators()[operator], occurrence)
    return _describe(module, operator, source, mutated)


def _describe(module: str, operator: str, source: str, mutated: str) -> Mutant:
    old, new = source.splitlines(), mutated.splitlines()
    changes = [code for code in difflib.SequenceMatcher(None, old, new, False).get_opcodes() if code[0] != "equal"]
    begin, end = changes[0][1], changes[-1][2]
    new_begin, new_end = changes[0][3], changes[-1][4]
    before, after = ("\n".join(line.strip() for line in lines) for lines in (old[begin:end], new[new_begin:new_end]))
    return Mutant(module, begin + 1, before, after, operator, mutated)


def _list_places(source: str) -> list[list[tuple[str, int]]]:
    """The mutations (operator, occurrence) of every place of a module, in the order of places."""
    tree = _load_cosmic_ray().get_ast(source)
    nodes = list(_walk(tree))
    left_out = _declaration_lines(source)
    places: dict[tuple[int, int], list[tuple[str, int]]] = defaultdict(list)
    for name, operator in _load_operators().items():
        positions = [position for node in nodes for position in operator.mutation_positions(node)]
        for occurrence, (begin, _) in enumerate(positions):
            if begin[0] not in left_out:
                places[begin].append((name, occurrence))
    return [places[begin] for begin in sorted(places)]


def _declaration_lines(source: str) -> set[int]:
    """Lines of decorators and ``__slots__``: caches, immutability and comparison, which are no numerics."""
    decorators = (each for node in ast.walk(ast.parse(source)) for each in getattr(node, "decorator_list", ()))
    return {line for each in decorators for line in range(each.lineno, (each.end_lineno or each.lineno) + 1)}


def _walk(node: Any) -> Iterator[Any]:  # noqa: ANN401  a node of parso, which has no types here
    """A tree of parso in the order in which cosmic-ray counts occurrences."""
    yield node
    for child in getattr(node, "children", ()):
        yield from _walk(child)


class _CosmicRay(NamedTuple):
    get_ast: Any
    mutate_code: Any
    operators: Any


def _load_cosmic_ray() -> _CosmicRay:
    try:
        from cosmic_ray.ast import get_ast  # noqa: PLC0415  only this measurement needs it
        from cosmic_ray.mutating import mutate_code  # noqa: PLC0415
        from cosmic_ray.operators.provider import OperatorProvider  # noqa: PLC0415
    except ImportError as fault:
        raise HmtSlamError(
            f"mutants need cosmic-ray ({fault}): install it with pip install -r requirements/mutants.txt"
        ) from fault
    return _CosmicRay(get_ast, mutate_code, OperatorProvider())


@cache
def _load_operators() -> dict[str, Any]:
    """{name: operator} of cosmic-ray that are used, in alphabetical order."""
    provider = _load_cosmic_ray().operators
    return {name: provider[name]() for name in sorted(provider) if _OPERATORS.fullmatch(name)}
