"""The table of kernels that Python calls, with the types of their arguments: what is loaded before the first scan.

``kernel_table.txt`` has a line for each: the nodes and commands that call it, the seconds of its compilation, its
module and name, and its arguments. ``scripts/record_kernels.py`` writes it. A kernel that is called by kernels alone is
part of theirs.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

TABLE = Path(__file__).with_suffix(".txt")

COMMAND = "hmt_slam"
"""User of what only commands call."""

_TOKEN = re.compile(r"[\w.:]+|[][(),]")
_LAYOUT = re.compile(r"(\d)([ACF])(r?)")


@dataclass(frozen=True)
class KernelCall:
    """A kernel, and types of arguments with which Python calls it.

    :ivar users: names of the nodes that call it, and :data:`COMMAND`.
    :ivar seconds: time that its compilation takes beside that of the ones before it, s.
    :ivar kernel: "module:name".
    :ivar arguments: the types, as :func:`describe_types` writes them.
    """

    users: tuple[str, ...]
    seconds: float
    kernel: str
    arguments: str

    @property
    def module(self) -> str:
        """The module of the kernel."""
        return self.kernel.partition(":")[0]

    def resolve(self) -> tuple[Any, tuple[Any, ...]]:
        """The kernel, as numba's dispatcher, and the types of its arguments."""
        module, _, name = self.kernel.partition(":")
        return getattr(import_module(module), name), parse_types(self.arguments)

    def line(self) -> str:
        """The line of the table."""
        return f"{','.join(self.users)} {self.seconds:.2f} {self.kernel} {self.arguments}"


@cache
def known_calls() -> tuple[KernelCall, ...]:
    """All calls of the table; none where there is no table."""
    if not TABLE.exists():
        return ()
    lines = TABLE.read_text(encoding="utf-8").splitlines()
    return tuple(_parse_line(line) for line in lines if line and not line.startswith("#"))


def _parse_line(line: str) -> KernelCall:
    users, seconds, kernel, arguments = line.split(maxsplit=3)
    return KernelCall(tuple(users.split(",")), float(seconds), kernel, arguments)


def describe_types(types: tuple[Any, ...]) -> str:
    """Types of arguments, such as ``(int64, float64[2C], (bool, bool), package.module:Class(float32[1Ar]))``.

    An array has the number of its axes and its layout: C, F (Fortran) or A (any), and r where it is read-only.

    :raises TypeError: for a type that has no notation here.
    """
    return f"({', '.join(_describe(one) for one in types)})"


def _describe(one: Any) -> str:  # noqa: ANN401  numba has no types
    from numba import types  # noqa: PLC0415  the command line has no need of numba for --help

    if isinstance(one, types.Array) and one.aligned:
        return f"{_describe(one.dtype)}[{one.ndim}{one.layout}{'' if one.mutable else 'r'}]"
    if isinstance(one, types.BaseTuple):
        inner = describe_types(tuple(one.types))
        made_of = getattr(one, "instance_class", None)
        return inner if made_of is None else f"{made_of.__module__}:{made_of.__qualname__}{inner}"
    if one == types.none or isinstance(one, types.Number | types.Boolean):
        return str(one.name)
    raise TypeError(f"there is no notation for {one}")


def parse_types(text: str) -> tuple[Any, ...]:
    """The types that :func:`describe_types` wrote, as those of numba."""
    tokens = _TOKEN.findall(text)[::-1]
    assert tokens.pop() == "("
    return _parse_tuple(tokens)


def _parse_tuple(tokens: list[str]) -> tuple[Any, ...]:
    """The types up to a closing parenthesis.

    :param tokens: the rest of the text, reversed; what is read is removed.
    """
    parsed = []
    while tokens[-1] != ")":
        parsed.append(_parse_type(tokens))
        if tokens[-1] == ",":
            tokens.pop()
    tokens.pop()
    return tuple(parsed)


def _parse_type(tokens: list[str]) -> Any:  # noqa: ANN401  numba has no types
    from numba import types  # noqa: PLC0415  see above

    word = tokens.pop()
    if word == "(":
        return types.BaseTuple.from_types(_parse_tuple(tokens))
    if ":" in word:
        module, _, name = word.partition(":")
        tokens.pop()
        return types.BaseTuple.from_types(_parse_tuple(tokens), getattr(import_module(module), name))
    scalar = getattr(types, "boolean" if word == "bool" else word)
    if not tokens or tokens[-1] != "[":
        return scalar
    _, layout, _ = tokens.pop(), tokens.pop(), tokens.pop()
    axes, order, read_only = _LAYOUT.fullmatch(layout).groups()  # type: ignore[union-attr]
    return types.Array(scalar, int(axes), order, readonly=bool(read_only))
