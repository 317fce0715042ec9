"""Mutations of bytes, of lines of numbers and of JSON documents, drawn by a seeded generator."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np

Mutation = Callable[[bytes, np.random.Generator], bytes]

NUMBERS = (
    b"nan", b"inf", b"-inf", b"1e308", b"-1e308", b"1e-308", b"1e-30", b"0", b"-1", b"-0.0", b"1e400", b"2147483648",
    b"9223372036854775807", b"18446744073709551616", b"1" + b"0" * 400, b"7" * 5000, b"1e9999999999", b"0x10", b"1_000",
    "٣".encode(), b"", b"-", b"abc", b"\xff\xfe", b"[" * 1000,
)  # fmt: skip
"""What stands in the place of a number."""

VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2**31, 2**63, 10**20, 10**400, 0.5, -0.0, 1e308, -1e308, 1e-308, float("nan"),
    float("inf"), "", "nan", "a" * 5000, "\ud800", "../../etc", "\x00", [], {}, [[]], [None], {"a": {}}, [0] * 1000,
)  # fmt: skip
"""What stands in the place of a value of a document."""

_WORDS = (
    b"\x00",
    b"\xff",
    b"\x80",
    b"\x7f",
    b"\xff\xff\xff\x7f",
    b"\xff\xff\xff\xff",
    b"\x00\x00\xc0\x7f",
    b"\xf0\x7f",
)


def mutate_bytes(content: bytes, rng: np.random.Generator) -> bytes:
    """Flip bits, cut, double, remove or overwrite pieces, one to four times."""
    for _ in range(rng.integers(1, 5)):
        content = _BYTE_MUTATIONS[rng.integers(len(_BYTE_MUTATIONS))](content, rng)
    return content


def _flip_bits(content: bytes, rng: np.random.Generator) -> bytes:
    changed = bytearray(content)
    for at in rng.integers(0, max(len(content), 1), rng.integers(1, 8)):
        if at < len(changed):
            changed[at] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def _cut(content: bytes, rng: np.random.Generator) -> bytes:
    return content[: rng.integers(0, len(content) + 1)]


def _slice(content: bytes, rng: np.random.Generator) -> tuple[int, int]:
    begin = int(rng.integers(0, len(content) + 1))
    return begin, min(len(content), begin + int(2 ** rng.uniform(0.0, 12.0)))


def _double(content: bytes, rng: np.random.Generator) -> bytes:
    begin, end = _slice(content, rng)
    return content[:end] + content[begin:]


def _remove(content: bytes, rng: np.random.Generator) -> bytes:
    begin, end = _slice(content, rng)
    return content[:begin] + content[end:]


def _overwrite(content: bytes, rng: np.random.Generator) -> bytes:
    word = _WORDS[rng.integers(len(_WORDS))] * int(rng.integers(1, 9))
    at = int(rng.integers(0, len(content) + 1))
    return content[:at] + word + content[at + len(word) :]


_BYTE_MUTATIONS: tuple[Mutation, ...] = (_flip_bits, _flip_bits, _cut, _double, _remove, _overwrite, _overwrite)


def mutate_lines(content: bytes, rng: np.random.Generator) -> bytes:
    """Replace, remove or double words and lines, one to four times."""
    lines = content.split(b"\n")
    for _ in range(rng.integers(1, 5)):
        at = int(rng.integers(len(lines)))
        kind = rng.integers(6)
        if kind == 0:
            lines.insert(at, lines[rng.integers(len(lines))])
        elif kind == 1 and len(lines) > 1:
            del lines[at]
        else:
            lines[at] = _mutate_words(lines[at], rng, remove=kind == 2)
    return b"\n".join(lines)


def _mutate_words(line: bytes, rng: np.random.Generator, *, remove: bool) -> bytes:
    separator = next((mark for mark in (b" ", b",", b": ") if mark in line), b" ")
    words = line.split(separator)
    at = int(rng.integers(len(words)))
    words[at : at + 1] = [] if remove else [NUMBERS[rng.integers(len(NUMBERS))]]
    return separator.join(words)


def mutate_json(content: bytes, rng: np.random.Generator) -> bytes:
    """Replace, remove, add or nest values anywhere in a document, one to three times."""
    document = json.loads(content)
    for _ in range(rng.integers(1, 4)):
        document = _mutate_value(document, rng)
    return json.dumps(document).encode("utf-8", "surrogatepass")


def _mutate_value(value: Any, rng: np.random.Generator) -> Any:  # noqa: ANN401, PLR0911  any JSON, one case a return
    """Change the value itself or, more often, one within it."""
    if isinstance(value, dict) and value and rng.random() < 0.93:
        key = list(value)[rng.integers(len(value))]
        if rng.random() < 0.1:
            return {name: item for name, item in value.items() if name != key}
        return {**value, key: _mutate_value(value[key], rng)}
    if isinstance(value, list) and value and rng.random() < 0.93:
        at = int(rng.integers(len(value)))
        if rng.random() < 0.1:
            return value[:at] + value[at + 1 :] if rng.random() < 0.5 else [*value, value[at]]
        return [*value[:at], _mutate_value(value[at], rng), *value[at + 1 :]]
    if isinstance(value, int) and not isinstance(value, bool) and rng.random() < 0.5:
        return value + int(rng.integers(-2, 3))
    if isinstance(value, float) and rng.random() < 0.3:
        return value * float(rng.choice([-1.0, 1e6, 1e-6, 0.0]))
    if rng.random() < 0.02:
        return json.loads("[" * 500 + "]" * 500)
    return VALUES[rng.integers(len(VALUES))]
