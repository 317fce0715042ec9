"""Files and documents of strangers: sizes, depths, numbers, devices and pipes."""

import json
import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.untrusted_input import parse_json, parse_yaml, read_file, read_text, read_yaml, shorten

_PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63) + 1, 2**63 - 1) | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=20,
)  # fmt: skip


@given(_PLAIN)
def test_a_document_within_the_limits_is_read_as_it_is(value):
    assert parse_json(json.dumps(value), "a document") == value


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("hello", "no JSON"),
        ("", "no JSON"),
        ("[" * 100_000, "deeper than 64"),
        ("[" * 100 + "]" * 100, "deeper than 64"),
        ("NaN", "no finite number"),
        ("[Infinity]", "no finite number"),
        (str(10**400), "more than 64 bits"),
        ("9" * 5000, "more than 64 bits"),
        (str(2**63), "more than 64 bits"),
        (b"\xff", "no JSON"),
    ],
)
def test_a_document_beyond_the_limits_is_refused_in_one_sentence(text, reason):
    with pytest.raises(HmtSlamError, match=reason) as refusal:
        parse_json(text, "a document")
    assert len(str(refusal.value)) < 300
    assert "\n" not in str(refusal.value)


def test_a_document_that_is_too_large_is_not_parsed():
    with pytest.raises(HmtSlamError, match="has 30 characters, more than 10"):
        parse_json(" " * 30, "a document", limit=10)


_BOMB = "a: &a [x]\n" + "".join(
    f"{new}: &{new} [*{old}, *{old}]\n" for old, new in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (_BOMB, "alias"),
        ("&a [*a]", "alias"),
        ("[" * 5000, "deeper than 64"),
        ("{a: " * 3000, "deeper than 64"),
        ("seed: 1" + "0" * 400, "more than 64 bits"),
        ("seed: 0x" + "f" * 6000, "more than 64 bits"),
        ("? [a, b]\n: c", "unhashable"),
        ("a: !!python/object/apply:os.system [ls]", "constructor"),
        ("a: !!binary x", "constructor"),
        ("a: !!timestamp x", "constructor"),
        ("\x00", "control characters"),
        ("--- a\n--- b", "another document"),
    ],
)
def test_yaml_beyond_the_limits_is_refused_in_one_sentence(text, reason):
    with pytest.raises(HmtSlamError, match=reason) as refusal:
        parse_yaml(text, "the file")
    assert len(str(refusal.value)) < 500
    assert "\n" not in str(refusal.value)


def test_a_date_is_a_text_and_numbers_are_numbers():
    text = "a: 2001-99-99\nb: 2001-12-14\nc: 3\nd: 1.5\ne: yes\nf: ~\ng: 0x1F\n"
    values = {"a": "2001-99-99", "b": "2001-12-14", "c": 3, "d": 1.5, "e": True, "f": None, "g": 31}
    assert parse_yaml(text, "the file") == values


def test_a_pipe_a_device_a_folder_and_a_missing_file_are_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zero").symlink_to("/dev/zero")
    for name, reason in (("pipe", "no regular file"), ("zero", "no regular file"), ("none", "No such file")):
        with pytest.raises(HmtSlamError, match=reason):
            read_file(tmp_path / name)
    with pytest.raises(HmtSlamError, match="no regular file"):
        read_file(tmp_path)
    with pytest.raises(HmtSlamError, match="too long"):
        read_file(tmp_path / ("a" * 5000))
    with pytest.raises(HmtSlamError, match="null"):
        read_file(Path("a\x00b"))


def test_a_file_that_is_too_large_is_refused_before_it_is_read(tmp_path):
    (tmp_path / "sparse").touch()
    os.truncate(tmp_path / "sparse", 10**13)
    with pytest.raises(HmtSlamError, match="10000000000000 bytes"):
        read_file(tmp_path / "sparse")


def test_text_and_yaml_files_are_read(tmp_path):
    (tmp_path / "a.yaml").write_text("seed: 3\n", encoding="utf-8")
    (tmp_path / "b.yaml").write_bytes(b"\xff\xfe")
    assert read_yaml(tmp_path / "a.yaml") == {"seed": 3}
    with pytest.raises(HmtSlamError, match="no UTF-8"):
        read_text(tmp_path / "b.yaml")


@given(_PLAIN)
def test_what_a_complaint_names_is_short_and_printable(value):
    assert len(shorten(value)) <= 80
    assert shorten(value).isprintable()
    nested = [[[[[[[[[value]]]]]]]]]
    assert len(shorten(nested)) <= 80
