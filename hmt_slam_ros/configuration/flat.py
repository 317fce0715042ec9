"""The configuration tree as a list of dotted names, checked changes to it, and its reading from a YAML file.

An impossible value is refused with one sentence: the name, the value, the allowed values, and the remedy.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

from hmt_slam_ros.configuration.tree import CONSISTENCY_RULES, Configuration
from hmt_slam_ros.errors import HmtSlamError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Value = bool | int | float | str
Node = TypeVar("Node", bound="DataclassInstance")


@dataclass(frozen=True)
class FlatParameter:
    """One parameter with its dotted name, as ROS declares it.

    :ivar name: dotted name such as ``filter.particles``.
    :ivar value: value in the given configuration.
    :ivar default: value where nobody sets one; its type is the type of the parameter.
    :ivar description: one sentence.
    :ivar unit: SI unit or degrees, "" for none.
    :ivar low: smallest value allowed, inclusive, or None.
    :ivar high: largest value allowed, inclusive, or None.
    :ivar choices: the words allowed for a str, () for any.
    :ivar expert: whether it is a threshold that few robots need to change.
    """

    name: str
    value: Value
    default: Value
    description: str
    unit: str
    low: float | None
    high: float | None
    choices: tuple[str, ...]
    expert: bool

    @property
    def kind(self) -> type:
        """``bool``, ``int``, ``float`` or ``str``."""
        return type(self.default)


def flat_parameters(tree: DataclassInstance) -> list[FlatParameter]:
    """Every parameter of a tree, in the order of declaration."""
    return list(_parameters_below(tree, ""))


def _parameters_below(node: DataclassInstance, prefix: str) -> Iterator[FlatParameter]:
    for entry in fields(node):
        name, value = prefix + entry.name, getattr(node, entry.name)
        if is_dataclass(value) and not isinstance(value, type):
            yield from _parameters_below(value, f"{name}.")
        else:
            yield FlatParameter(name, value, cast(Value, entry.default), **entry.metadata)


def as_flat(configuration: Configuration) -> dict[str, Value]:
    """Dotted name -> value."""
    return {parameter.name: parameter.value for parameter in flat_parameters(configuration)}


def as_nested(configuration: Configuration) -> dict[str, Any]:
    """Nested dictionaries of plain values, for JSON and YAML."""
    return nest(as_flat(configuration))


def nest(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Dictionaries nested at the dots of the names."""
    tree: dict[str, Any] = {}
    for name, value in flat.items():
        *groups, last = name.split(".")
        node = tree
        for step in groups:
            node = node.setdefault(step, {})
        node[last] = value
    return tree


def flatten(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """The inverse of :func:`nest`; an empty dictionary vanishes."""
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        if isinstance(value, Mapping):
            flat.update(flatten(value, f"{prefix}{name}."))
        else:
            flat[f"{prefix}{name}"] = value
    return flat


def with_changes(configuration: Configuration, changes: Mapping[str, Any]) -> Configuration:
    """The configuration with some values changed, checked one by one and together.

    :param changes: dotted name -> value; an int serves where a float is expected.
    :raises HmtSlamError: for an unknown name, a value of the wrong type or out of range, or values that do not fit
        together.
    """
    changed = apply_changes(configuration, changes, "docs/reference/parameters.md")
    for rule in CONSISTENCY_RULES:
        if not rule.holds(changed):
            raise HmtSlamError(f"the configuration contradicts itself: {rule.advice}")
    return changed


def apply_changes(tree: Node, changes: Mapping[str, Any], document: str) -> Node:
    """A tree of parameters with some values changed, each checked by itself.

    :param changes: dotted name -> value; an int serves where a float is expected.
    :param document: where the names are described.
    :raises HmtSlamError: for an unknown name, a value of the wrong type or out of range.
    """
    known = {parameter.name: parameter for parameter in flat_parameters(tree)}
    checked = {name: _check_value(_find_parameter(name, known, document), value) for name, value in changes.items()}
    return _replace_values(tree, nest(checked))


def _replace_values(node: Node, changes: Mapping[str, Any]) -> Node:
    values = {
        name: _replace_values(getattr(node, name), value) if isinstance(value, dict) else value
        for name, value in changes.items()
    }
    return replace(node, **values)


def _find_parameter(name: str, known: Mapping[str, FlatParameter], document: str) -> FlatParameter:
    if name in known:
        return known[name]
    near = nearest_names(name, known) if len(name) <= _LONGEST_SHOWN else []
    advice = f"did you mean {' or '.join(near)}?" if near else f"see {document} for the names"
    raise HmtSlamError(f"there is no parameter {_show(name)}: {advice}")


def nearest_names(name: str, known: Mapping[str, FlatParameter]) -> list[str]:
    """At most three known names that look like ``name``, also where only the last part was given."""
    same_ending = [candidate for candidate in known if candidate.rsplit(".", 1)[-1] == name.rsplit(".", 1)[-1]]
    return (same_ending + [near for near in difflib.get_close_matches(name, known) if near not in same_ending])[:3]


def _check_value(parameter: FlatParameter, value: object) -> Value:
    typed = _convert_type(parameter, value)
    if parameter.choices and typed not in parameter.choices:
        raise HmtSlamError(
            f"{parameter.name} = {_show(value, str)} is not a choice: use {' or '.join(parameter.choices)}"
        )
    if not isinstance(typed, str) and not _is_in_range(parameter, typed):
        allowed, default = allowed_values(parameter), parameter.default
        raise HmtSlamError(f"{parameter.name} = {value} is out of range: use {allowed} (the default is {default})")
    return typed


def _convert_type(parameter: FlatParameter, value: object) -> Value:
    if parameter.kind is float and type(value) is int:
        return float(value)
    if type(value) is parameter.kind:
        return cast(Value, value)
    raise HmtSlamError(
        f"{parameter.name} = {_show(value)} is not {_KIND_NAMES[parameter.kind]}: use {allowed_values(parameter)}"
    )


def _show(value: object, form: Callable[[object], str] = repr) -> str:
    """A value as a complaint names it, cut off where it is long."""
    text = form(value)
    return text if len(text) <= _LONGEST_SHOWN else f"{text[:_LONGEST_SHOWN]}..."


def _is_in_range(parameter: FlatParameter, value: float) -> bool:
    if not math.isfinite(value):
        return False
    return (parameter.low is None or value >= parameter.low) and (parameter.high is None or value <= parameter.high)


_LONGEST_SHOWN = 80
"""Characters of a value in a complaint."""

_KIND_NAMES = {bool: "true or false", int: "a whole number", float: "a number", str: "a word"}


def allowed_values(parameter: FlatParameter) -> str:
    """The values that the parameter admits, in words."""
    if parameter.choices:
        return " or ".join(parameter.choices)
    if parameter.low is None and parameter.high is None:
        return _KIND_NAMES[parameter.kind]
    unit = f" {parameter.unit}" if parameter.unit else ""
    if parameter.high is None:
        return f"{_KIND_NAMES[parameter.kind]}, {parameter.low:g}{unit} or more"
    if parameter.low is None:
        return f"{_KIND_NAMES[parameter.kind]}, {parameter.high:g}{unit} or less"
    return f"{_KIND_NAMES[parameter.kind]} from {format_number(parameter.low)} to {format_number(parameter.high)}{unit}"


def format_number(value: float) -> str:
    """A bound as a person would write it: whole numbers in full, others short."""
    return str(int(value)) if float(value).is_integer() else f"{value:.6g}"


# Parameters that every ROS node has and that a params file may set beside ours.
_FOREIGN = ("use_sim_time", "start_type_description_service", "qos_overrides.")


def load_configuration(
    file: Path | None = None,
    settings: Iterable[str] = (),
    seed: int | None = None,
    base: Configuration | None = None,
) -> Configuration:
    """The configuration of a run.

    :param file: YAML, either plain (``filter: {particles: 12}``) or as ROS reads it (``/**: ros__parameters: ...``).
    :param settings: texts ``name=value`` with dotted names, later ones winning.
    :param seed: the value of ``--seed``, which wins over both.
    :param base: what they change, None for the defaults.
    :raises HmtSlamError: for a file that cannot be read, an unknown name or a value that cannot be.
    """
    configuration = base or Configuration()
    if file is not None:
        configuration = with_changes(configuration, read_parameter_file(file))
    changes = dict(parse_setting(setting) for setting in settings)
    if seed is not None:
        changes["seed"] = seed
    return with_changes(configuration, changes)


def read_parameter_file(file: Path) -> dict[str, Any]:
    """Dotted name -> value as written in a YAML file, unchecked but for its form.

    :raises HmtSlamError: where the file cannot be read or is no mapping.
    """
    tree = _parse_yaml(file)
    if not isinstance(tree, Mapping):
        raise HmtSlamError(f"{file} holds no parameters: write lines such as 'filter: {{particles: 12}}'")
    sections = [section["ros__parameters"] for section in tree.values() if _is_ros_section(section)]
    if not sections:
        return flatten(_text_keys(tree))
    if len(sections) < len(tree):
        raise HmtSlamError(f"{file} mixes ROS sections (ros__parameters) with plain parameters: use one form only")
    return _merge_sections(file, [_without_foreign(flatten(_text_keys(section or {}))) for section in sections])


def _parse_yaml(file: Path) -> object:
    from hmt_slam_ros.untrusted_input import read_yaml  # noqa: PLC0415  commands that read no file start faster

    return read_yaml(file)


def _is_ros_section(section: object) -> bool:
    return isinstance(section, Mapping) and "ros__parameters" in section


def _text_keys(tree: Mapping[Any, Any]) -> dict[str, Any]:
    return {str(key): _text_keys(value) if isinstance(value, Mapping) else value for key, value in tree.items()}


def _without_foreign(flat: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in flat.items() if not name.startswith(_FOREIGN)}


def _merge_sections(file: Path, sections: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    merged: dict[str, Any] = {}
    for section in sections:
        for name, value in section.items():
            if merged.setdefault(name, value) != value:
                raise HmtSlamError(
                    f"{file} gives {name} two values, {merged[name]} and {value}: all nodes of a run share one"
                )
    return merged


def parse_setting(setting: str, tree: DataclassInstance | None = None) -> tuple[str, Value]:
    """Name and value of a text ``name=value``, the value read as the type that the parameter has.

    :param tree: of the parameters, None for the configuration.

    An unknown name passes, for :func:`hmt_slam_ros.configuration.flat.with_changes` to refuse it with advice.

    :raises HmtSlamError: where there is no ``=``.
    """
    name, equals, text = setting.partition("=")
    if not equals:
        raise HmtSlamError(f"'{setting}' is no setting: write name=value, such as filter.particles=12")
    name, text = name.strip(), text.strip()
    kinds = {parameter.name: parameter.kind for parameter in flat_parameters(tree or Configuration())}
    try:
        return name, _READERS[kinds.get(name, str)](text)
    except ValueError:
        return name, text


def _parse_bool(text: str) -> bool:
    if text.lower() not in ("true", "false"):
        raise ValueError(text)
    return text.lower() == "true"


_READERS: dict[type, Callable[[str], Value]] = {bool: _parse_bool, int: int, float: float, str: str}
