"""The configuration tree: checked changes, flat and nested forms, files and settings, generated documents."""

import dataclasses
import importlib.util
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from hmt_slam_ros.configuration import (
    Configuration,
    as_flat,
    as_nested,
    flat_parameters,
    load_configuration,
    with_changes,
)
from hmt_slam_ros.configuration.documents import ros_yaml, yaml_value
from hmt_slam_ros.configuration.flat import FlatParameter, flatten, nest
from hmt_slam_ros.configuration.tree import CONSISTENCY_RULES
from hmt_slam_ros.errors import HmtSlamError

ROOT = Path(__file__).resolve().parents[1]
PARAMETERS = flat_parameters(Configuration())

words = st.text("abcdefgh_", min_size=1, max_size=6)
trees = st.recursive(
    st.dictionaries(words, st.integers() | st.floats(allow_nan=False) | st.booleans(), min_size=1, max_size=4),
    lambda inner: st.dictionaries(words, inner | st.integers(), min_size=1, max_size=4),
    max_leaves=12,
)


def values_of(parameter: FlatParameter) -> st.SearchStrategy:
    if parameter.choices:
        return st.sampled_from(parameter.choices)
    if parameter.kind is bool:
        return st.booleans()
    if parameter.kind is int:
        return st.integers(int(parameter.low), int(parameter.high))
    if parameter.kind is str:
        return words
    return st.floats(parameter.low, parameter.high)


@st.composite
def some_changes(draw: st.DrawFn) -> dict:
    chosen = draw(st.lists(st.sampled_from(PARAMETERS), unique_by=lambda parameter: parameter.name, max_size=6))
    return {parameter.name: draw(values_of(parameter)) for parameter in chosen}


def changed_or_none(changes: dict) -> Configuration | None:
    try:
        return with_changes(Configuration(), changes)
    except HmtSlamError as fault:
        assert "contradicts itself" in str(fault)
        return None


def one_sentence(fault: pytest.ExceptionInfo) -> str:
    text = str(fault.value)
    assert text
    assert "\n" not in text
    return text


@given(trees)
def test_flattening_undoes_nesting(tree: dict) -> None:
    assert nest(flatten(tree)) == tree


@given(some_changes())
def test_changed_values_are_read_back_and_all_others_stay(changes: dict) -> None:
    changed = changed_or_none(changes)
    if changed is not None:
        assert as_flat(changed) == as_flat(Configuration()) | changes
        assert flatten(as_nested(changed)) == as_flat(changed)


@given(some_changes())
def test_the_yaml_of_any_configuration_loads_as_the_same_configuration(
    tmp_path_factory: pytest.TempPathFactory, changes: dict
) -> None:
    changed = changed_or_none(changes)
    if changed is not None:
        file = tmp_path_factory.mktemp("yaml") / "written.yaml"
        file.write_text(ros_yaml(changed))
        assert load_configuration(file) == changed


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_yaml_reads_every_number_back_as_the_same_float(value: float) -> None:
    read = yaml.safe_load(yaml_value(value))
    assert type(read) is float
    assert read == value


@pytest.mark.parametrize("parameter", PARAMETERS, ids=lambda parameter: parameter.name)
def test_every_parameter_is_declared_in_full(parameter: FlatParameter) -> None:
    assert type(parameter.value) in (bool, int, float, str)
    assert parameter.description.endswith(".")
    if parameter.kind in (int, float):
        assert parameter.low is not None
        assert parameter.high is not None
        assert parameter.low <= parameter.value <= parameter.high
    if parameter.choices:
        assert parameter.value in parameter.choices


@pytest.mark.parametrize(
    "parameter",
    [parameter for parameter in PARAMETERS if parameter.kind in (int, float)],
    ids=lambda parameter: parameter.name,
)
def test_a_value_beyond_either_bound_is_refused_with_the_range(parameter: FlatParameter) -> None:
    for value in (parameter.kind(parameter.low - 1), parameter.kind(parameter.high + 1)):
        with pytest.raises(HmtSlamError, match=r"is out of range: use .* from .* to") as fault:
            with_changes(Configuration(), {parameter.name: value})
        assert f"{parameter.name} = {value}" in one_sentence(fault)


def test_the_defaults_obey_every_rule() -> None:
    assert with_changes(Configuration(), {}) == Configuration()
    assert all(rule.holds(Configuration()) for rule in CONSISTENCY_RULES)


def test_values_that_contradict_each_other_are_refused_with_advice() -> None:
    with pytest.raises(HmtSlamError, match="contradicts itself") as fault:
        with_changes(Configuration(), {"local_map.cell": 0.5})
    assert "local_map.field_radius" in one_sentence(fault)


def test_a_contradicting_pair_is_accepted_when_both_sides_change_at_once() -> None:
    changed = with_changes(Configuration(), {"local_map.cell": 0.5, "local_map.field_radius": 2.0})
    assert (changed.local_map.cell, changed.local_map.field_radius) == (0.5, 2.0)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_a_number_that_is_not_finite_is_refused(value: float) -> None:
    with pytest.raises(HmtSlamError, match="out of range"):
        with_changes(Configuration(), {"local_map.cell": value})


@pytest.mark.parametrize(
    ("name", "value", "wanted"),
    [
        ("filter.particles", 12.5, "whole number"),
        ("filter.particles", True, "whole number"),
        ("filter.particles", "many", "whole number"),
        ("local_map.cell", "small", "a number"),
        ("local_map.cell", False, "a number"),
        ("robot.loop", 1, "true or false"),
        ("robot.loop", "yes", "true or false"),
        ("filter.particles", None, "whole number"),
        ("filter.particles", [1, 2], "whole number"),
    ],
)
def test_a_value_of_the_wrong_type_is_refused(name: str, value: object, wanted: str) -> None:
    with pytest.raises(HmtSlamError, match=wanted) as fault:
        with_changes(Configuration(), {name: value})
    assert name in one_sentence(fault)


def test_a_whole_number_serves_as_a_number() -> None:
    value = with_changes(Configuration(), {"local_map.cell": 1, "local_map.field_radius": 2}).local_map.cell
    assert type(value) is float


@pytest.mark.parametrize(
    ("name", "near"),
    [("filter.particels", "filter.particles"), ("particles", "filter.particles"), ("filter", "did you mean|names")],
)
def test_an_unknown_name_is_refused_with_the_nearest_ones(name: str, near: str) -> None:
    with pytest.raises(HmtSlamError, match=f"no parameter '{name}'.*({near})") as fault:
        with_changes(Configuration(), {name: 1})
    one_sentence(fault)


def test_a_name_like_no_other_points_to_the_reference() -> None:
    with pytest.raises(HmtSlamError, match=r"docs/reference/parameters\.md"):
        with_changes(Configuration(), {"zzzzzz": 1})


def test_settings_win_over_the_file_and_the_file_over_the_defaults(tmp_path: Path) -> None:
    file = tmp_path / "some.yaml"
    file.write_text("filter: {particles: 30, ess_fraction: 0.4}\nseed: 5\n")
    loaded = load_configuration(file, ["filter.particles=7", "filter.particles = 8"], seed=9)
    assert (loaded.filter.particles, loaded.filter.ess_fraction, loaded.seed) == (8, 0.4, 9)
    assert loaded.robot == Configuration().robot


@pytest.mark.parametrize(
    ("setting", "value"),
    [("filter.particles=1e1", None), ("robot.loop=TRUE", True), ("local_map.cell=4e-2", 0.04), ("seed=7", 7)],
)
def test_settings_are_read_as_the_type_of_their_parameter(setting: str, value: object) -> None:
    name = setting.partition("=")[0]
    if value is None:
        with pytest.raises(HmtSlamError, match="whole number"):
            load_configuration(settings=[setting])
    else:
        assert as_flat(load_configuration(settings=[setting]))[name] == value


def test_a_setting_without_an_equals_sign_is_refused() -> None:
    with pytest.raises(HmtSlamError, match="name=value"):
        load_configuration(settings=["filter.particles"])


@pytest.mark.parametrize(
    "text",
    [
        "filter:\n  particles: 30\n",
        "filter.particles: 30\n",
        "/**:\n  ros__parameters:\n    use_sim_time: true\n    filter: {particles: 30}\n",
        "/**:\n  ros__parameters:\n    filter.particles: 30\nrtl:\n  ros__parameters:\n",
        "/**:\n  ros__parameters: {filter.particles: 30}\nslam:\n  ros__parameters: {filter: {particles: 30}}\n",
    ],
)
def test_plain_and_ros_files_are_equivalent(tmp_path: Path, text: str) -> None:
    file = tmp_path / "some.yaml"
    file.write_text(text)
    assert load_configuration(file) == with_changes(Configuration(), {"filter.particles": 30})


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "holds no parameters"),
        ("- 1\n- 2\n", "holds no parameters"),
        ("filter: {particles: [\n", "no valid YAML at line"),
        ("seed: 1\n/**:\n  ros__parameters: {seed: 2}\n", "one form only"),
        ("a:\n  ros__parameters: {seed: 1}\nb:\n  ros__parameters: {seed: 2}\n", "two values"),
        ("filter: 3\n", "no parameter 'filter'"),
        ("filter: {particles: {deep: 1}}\n", "no parameter 'filter.particles.deep'"),
        ("filter: {particles: 0}\n", "out of range"),
        ("3: 4\n", "no parameter '3'"),
    ],
)
def test_a_file_that_makes_no_sense_is_refused_with_a_sentence(tmp_path: Path, text: str, sentence: str) -> None:
    file = tmp_path / "some.yaml"
    file.write_text(text)
    with pytest.raises(HmtSlamError, match=sentence) as fault:
        load_configuration(file)
    one_sentence(fault)


def test_a_file_that_is_missing_or_no_text_is_refused_with_its_path(tmp_path: Path) -> None:
    binary = tmp_path / "binary.yaml"
    binary.write_bytes(b"\xff\xfe\x00\x80")
    for file in (tmp_path / "missing.yaml", binary, tmp_path):
        with pytest.raises(HmtSlamError, match=r"cannot be read|is no UTF-8 text|is no regular file") as fault:
            load_configuration(file)
        assert str(file) in one_sentence(fault)


def test_the_tree_is_immutable() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        Configuration().filter.particles = 3  # type: ignore[misc]


def test_the_generated_files_are_up_to_date() -> None:
    specification = importlib.util.spec_from_file_location("generate_docs", ROOT / "scripts" / "generate_docs.py")
    generate_docs = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(generate_docs)
    for name, text in generate_docs.GENERATED.items():
        assert (ROOT / name).read_text() == text(Configuration()), f"run scripts/generate_docs.py: {name} is old"


def test_the_shipped_yaml_is_the_defaults() -> None:
    assert load_configuration(ROOT / "config" / "hmt_slam.yaml") == Configuration()
