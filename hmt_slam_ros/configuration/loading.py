"""Configuration from a YAML file and from ``--set``: defaults, then the file, then the settings."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hmt_slam_ros.configuration.flat import Value, flat_parameters, flattened, with_changes
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.errors import HmtSlamError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

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
        configuration = with_changes(configuration, read_file(file))
    changes = dict(parse_setting(setting) for setting in settings)
    if seed is not None:
        changes["seed"] = seed
    return with_changes(configuration, changes)


def read_file(file: Path) -> dict[str, Any]:
    """Dotted name -> value as written in a YAML file, unchecked but for its form.

    :raises HmtSlamError: where the file cannot be read or is no mapping.
    """
    tree = _parsed(file)
    if not isinstance(tree, Mapping):
        raise HmtSlamError(f"{file} holds no parameters: write lines such as 'filter: {{particles: 12}}'")
    sections = [section["ros__parameters"] for section in tree.values() if _is_ros_section(section)]
    if not sections:
        return flattened(_text_keys(tree))
    if len(sections) < len(tree):
        raise HmtSlamError(f"{file} mixes ROS sections (ros__parameters) with plain parameters: use one form only")
    return _merged(file, [_own(flattened(_text_keys(section or {}))) for section in sections])


def _parsed(file: Path) -> object:
    import yaml  # noqa: PLC0415  the commands that read no file start faster without it

    try:
        return yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as fault:
        raise HmtSlamError(f"the configuration {file} cannot be read ({_reason(fault)}): check the path") from fault
    except yaml.YAMLError as fault:
        mark = getattr(fault, "problem_mark", None)
        place = f" at line {mark.line + 1}" if mark is not None else ""
        raise HmtSlamError(f"the configuration {file} is no valid YAML{place}: correct it there") from fault


def _reason(fault: OSError | UnicodeDecodeError) -> str:
    return fault.strerror or "unknown reason" if isinstance(fault, OSError) else "it is no UTF-8 text"


def _is_ros_section(section: object) -> bool:
    return isinstance(section, Mapping) and "ros__parameters" in section


def _text_keys(tree: Mapping[Any, Any]) -> dict[str, Any]:
    return {str(key): _text_keys(value) if isinstance(value, Mapping) else value for key, value in tree.items()}


def _own(flat: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in flat.items() if not name.startswith(_FOREIGN)}


def _merged(file: Path, sections: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
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
    kinds = {leaf.name: leaf.kind for leaf in flat_parameters(tree or Configuration())}
    try:
        return name, _READERS[kinds.get(name, str)](text)
    except ValueError:
        return name, text


def _truth(text: str) -> bool:
    if text.lower() not in ("true", "false"):
        raise ValueError(text)
    return text.lower() == "true"


_READERS: dict[type, Callable[[str], Value]] = {bool: _truth, int: int, float: float, str: str}
