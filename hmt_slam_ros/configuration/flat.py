"""The configuration tree as a list of dotted names, and checked changes to it.

A value that cannot be is refused with one sentence: the name, the value, what is allowed, and what to do.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar, cast

from hmt_slam_ros.configuration.tree import RULES, Configuration
from hmt_slam_ros.errors import HmtSlamError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Value = bool | int | float | str
Node = TypeVar("Node", bound="DataclassInstance")


@dataclass(frozen=True)
class FlatParameter:
    """One parameter with its dotted name, as ROS declares it.

    :ivar name: dotted name such as ``filter.particles``.
    :ivar value: value in the configuration that was asked.
    :ivar default: value where nobody sets one; its type is the type of the parameter.
    :ivar description: one sentence.
    :ivar unit: SI unit or degrees, "" for none.
    :ivar low: smallest value allowed, inclusive, or None.
    :ivar high: largest value allowed, inclusive, or None.
    :ivar choices: the words allowed for a str, () for any.
    """

    name: str
    value: Value
    default: Value
    description: str
    unit: str
    low: float | None
    high: float | None
    choices: tuple[str, ...]

    @property
    def kind(self) -> type:
        """``bool``, ``int``, ``float`` or ``str``."""
        return type(self.default)


def flat_parameters(tree: DataclassInstance) -> list[FlatParameter]:
    """Every parameter of a tree, in the order of declaration."""
    return list(_leaves(tree, ""))


def _leaves(node: DataclassInstance, prefix: str) -> Iterator[FlatParameter]:
    for entry in fields(node):
        name, value = prefix + entry.name, getattr(node, entry.name)
        if is_dataclass(value) and not isinstance(value, type):
            yield from _leaves(value, f"{name}.")
        else:
            yield FlatParameter(name, value, cast(Value, entry.default), **entry.metadata)


def as_flat(configuration: Configuration) -> dict[str, Value]:
    """Dotted name -> value."""
    return {leaf.name: leaf.value for leaf in flat_parameters(configuration)}


def as_nested(configuration: Configuration) -> dict[str, Any]:
    """Nested dictionaries of plain values, for JSON and YAML."""
    return nested(as_flat(configuration))


def nested(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Dictionaries nested at the dots of the names."""
    tree: dict[str, Any] = {}
    for name, value in flat.items():
        *rooms, last = name.split(".")
        node = tree
        for step in rooms:
            node = node.setdefault(step, {})
        node[last] = value
    return tree


def flattened(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """The inverse of :func:`nested`; an empty dictionary vanishes."""
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        if isinstance(value, Mapping):
            flat.update(flattened(value, f"{prefix}{name}."))
        else:
            flat[f"{prefix}{name}"] = value
    return flat


def with_changes(configuration: Configuration, changes: Mapping[str, Any]) -> Configuration:
    """The configuration with some values changed, checked one by one and together.

    :param changes: dotted name -> value; an int serves where a float is expected.
    :raises HmtSlamError: for an unknown name, a value of the wrong type or out of range, or values that do not fit
        together.
    """
    changed = changed_one_by_one(configuration, changes, "docs/parameters.md")
    for rule in RULES:
        if not rule.holds(changed):
            raise HmtSlamError(f"the configuration contradicts itself: {rule.advice}")
    return changed


def changed_one_by_one(tree: Node, changes: Mapping[str, Any], document: str) -> Node:
    """A tree of parameters with some values changed, each checked by itself.

    :param changes: dotted name -> value; an int serves where a float is expected.
    :param document: where the names are described.
    :raises HmtSlamError: for an unknown name, a value of the wrong type or out of range.
    """
    known = {leaf.name: leaf for leaf in flat_parameters(tree)}
    checked = {name: _checked(_named(name, known, document), value) for name, value in changes.items()}
    return _replaced(tree, nested(checked))


def _replaced(node: Node, changes: Mapping[str, Any]) -> Node:
    values = {
        name: _replaced(getattr(node, name), value) if isinstance(value, dict) else value
        for name, value in changes.items()
    }
    return replace(node, **values)


def _named(name: str, known: Mapping[str, FlatParameter], document: str) -> FlatParameter:
    if name in known:
        return known[name]
    near = nearest_names(name, known)
    advice = f"did you mean {' or '.join(near)}?" if near else f"see {document} for the names"
    raise HmtSlamError(f"there is no parameter '{name}': {advice}")


def nearest_names(name: str, known: Mapping[str, FlatParameter]) -> list[str]:
    """At most three known names that look like ``name``, also where only the last part was given."""
    same_ending = [candidate for candidate in known if candidate.rsplit(".", 1)[-1] == name.rsplit(".", 1)[-1]]
    return (same_ending + [near for near in difflib.get_close_matches(name, known) if near not in same_ending])[:3]


def _checked(leaf: FlatParameter, value: object) -> Value:
    typed = _typed(leaf, value)
    if leaf.choices and typed not in leaf.choices:
        raise HmtSlamError(f"{leaf.name} = {value} is not a choice: use {' or '.join(leaf.choices)}")
    if not isinstance(typed, str) and not _within(leaf, typed):
        raise HmtSlamError(
            f"{leaf.name} = {value} is out of range: use {allowed(leaf)} (the default is {leaf.default})"
        )
    return typed


def _typed(leaf: FlatParameter, value: object) -> Value:
    if leaf.kind is float and type(value) is int:
        return float(value)
    if type(value) is leaf.kind:
        return cast(Value, value)
    raise HmtSlamError(f"{leaf.name} = {value!r} is not {_KIND_NAMES[leaf.kind]}: use {allowed(leaf)}")


def _within(leaf: FlatParameter, value: float) -> bool:
    if not math.isfinite(value):
        return False
    return (leaf.low is None or value >= leaf.low) and (leaf.high is None or value <= leaf.high)


_KIND_NAMES = {bool: "true or false", int: "a whole number", float: "a number", str: "a word"}


def allowed(leaf: FlatParameter) -> str:
    """The values that the parameter admits, in words."""
    if leaf.choices:
        return " or ".join(leaf.choices)
    if leaf.low is None and leaf.high is None:
        return _KIND_NAMES[leaf.kind]
    unit = f" {leaf.unit}" if leaf.unit else ""
    if leaf.high is None:
        return f"{_KIND_NAMES[leaf.kind]}, {leaf.low:g}{unit} or more"
    if leaf.low is None:
        return f"{_KIND_NAMES[leaf.kind]}, {leaf.high:g}{unit} or less"
    return f"{_KIND_NAMES[leaf.kind]} from {number(leaf.low)} to {number(leaf.high)}{unit}"


def number(value: float) -> str:
    """A bound as a person would write it: whole numbers in full, others short."""
    return str(int(value)) if float(value).is_integer() else f"{value:.6g}"
