"""The description of documents, from the annotations and docstrings of their classes."""

from __future__ import annotations

import inspect
import re
import types
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from hmt_slam_ros.plain_data import field_names, is_record
from hmt_slam_ros.sensors import Scan

_SCALARS = {int: "whole number", float: "number", bool: "true or false", str: "text"}
_IVAR = re.compile(r":ivar (\w+): (.*?)(?=\n:|\n\n|\Z)", re.S)
_ROLE = re.compile(r":\w+:`~?(?:[\w.]+\.)?(\w+)`")


def document_reference(kinds: Mapping[str, type]) -> list[str]:
    """Lines of Markdown: a section for each document, and one for each class of objects in them.

    :param kinds: {name of a document: its class}.
    """
    objects = {inner for kind in kinds.values() for inner in _nested_records(kind)} - set(kinds.values())
    counts = Counter(kind.__name__ for kind in objects)
    names = {kind: kind.__name__ for kind in objects}
    names |= {kind: f"{_module_name(kind)}.{name}" for kind, name in names.items() if counts[name] > 1}
    sections = [line for name, kind in kinds.items() for line in _section_lines(kind, f"Document `{name}`", names)]
    ordered = sorted(objects, key=names.__getitem__)
    return sections + [line for kind in ordered for line in _section_lines(kind, names[kind], names)]


def _module_name(kind: type) -> str:
    return kind.__module__.rsplit(".", 1)[-1]


def _nested_records(kind: type) -> Iterator[type]:
    """The classes of all objects in a document, at any depth."""
    pending: list[Any] = [kind]
    visited: set[Any] = set()
    while pending:
        annotation = pending.pop()
        if annotation in visited or annotation is Scan or get_origin(annotation) is np.ndarray:
            continue
        visited.add(annotation)
        if is_record(annotation):
            yield annotation
            hints = get_type_hints(annotation)
            pending += [hints[name] for name in field_names(annotation)]
        else:
            pending += get_args(annotation)


def _section_lines(kind: type, title: str, names: Mapping[type, str]) -> list[str]:
    meanings, hints = field_meanings(kind), get_type_hints(kind)
    rows = [f"| `{name}` | {_type_text(hints[name], names)} | {meanings.get(name, '')} |" for name in field_names(kind)]
    return [f"### {title}", "", summary(kind), "", "| field | type | meaning |", "|---|---|---|", *rows, ""]


def summary(kind: type) -> str:
    """The first paragraph of the docstring of a class, without markup of roles."""
    return _plain_text((inspect.getdoc(kind) or "").split(":ivar", 1)[0].split("\n\n", 1)[0])


def field_meanings(kind: type) -> dict[str, str]:
    """{field: meaning} of a class, from its docstring."""
    return {name: _plain_text(meaning) for name, meaning in _IVAR.findall(inspect.getdoc(kind) or "")}


def _plain_text(text: str) -> str:
    return " ".join(_ROLE.sub(r"`\1`", text).replace("``", "`").split())


def _type_text(kind: Any, names: Mapping[type, str]) -> str:  # noqa: ANN401  any annotation
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is np.ndarray:
        return f"array of {np.dtype(get_args(arguments[1])[0])}"
    if kind is Scan:
        return "name of a scan"
    if kind in _SCALARS or is_record(kind):
        return _SCALARS.get(kind) or f"`{names[kind]}`"
    if origin in (Union, types.UnionType):
        some = [_type_text(argument, names) for argument in arguments if argument is not type(None)]
        return " or ".join(some) + (", or null" if type(None) in arguments else "")
    return _collection_text(origin, arguments, names)


def _collection_text(origin: Any, arguments: tuple[Any, ...], names: Mapping[type, str]) -> str:  # noqa: ANN401  likewise
    if origin is Literal:
        return " or ".join(f'"{word}"' for word in arguments)
    items = [_type_text(argument, names) for argument in arguments if argument is not Ellipsis]
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return f"list of [{', '.join(items)}]"
    if origin is tuple and Ellipsis not in arguments:
        return f"[{', '.join(items)}]"
    return f"{'ordered ' if origin is frozenset else ''}list of {items[0]}"
