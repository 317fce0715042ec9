"""Files and documents of strangers: read within limits, or refused in one sentence.

Nothing else in the package opens a file of a user or parses a text that came over a topic. Sizes, depths and numbers
are bounded here, so that what comes after need not fear a device file, a bomb of aliases or an integer of 5000 digits.
"""

from __future__ import annotations

import json
import os
import reprlib
import stat
from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

import yaml

from hmt_slam_ros.errors import HmtSlamError

MAX_DEPTH = 64
"""Lists and objects within each other; the deepest document of the package has 12."""

MAX_INTEGER = 2**63 - 1
"""Magnitude of an integer: what an int64 holds."""

MAX_YAML_BYTES = 500_000
"""Of a YAML file; the file of all parameters has 25,000."""

MAX_TEXT_BYTES = 500_000_000
"""Of a file of lines of numbers, such as a trajectory of 5 million poses."""

MAX_DOCUMENT_BYTES = 64_000_000
"""Of a JSON document on a topic, beyond what a map of 10,000 areas needs."""

MAX_FILE_BYTES = 4_000_000_000
"""Of a file that is read as a whole."""


def read_file(path: Path, limit: int = MAX_FILE_BYTES) -> bytes:
    """The content of a regular file.

    :param limit: bytes that it may have.
    :raises HmtSlamError: where it cannot be opened, is a device or a pipe, or is larger.
    """
    with open_regular(path) as file:
        size = file_size(file)
        if size > limit:
            raise HmtSlamError(f"{shorten(path)} has {size} bytes, more than {limit}: give a smaller file")
        return file.read(size)


def file_size(file: BinaryIO) -> int:
    """Bytes of an open file."""
    return os.fstat(file.fileno()).st_size


@contextmanager
def open_regular(path: Path) -> Iterator[BinaryIO]:
    """A regular file, open for reading.

    :raises HmtSlamError: where it cannot be opened or read, or is a device or a pipe.
    """
    try:
        # Without O_NONBLOCK, opening a pipe would wait for whoever writes into it.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except (OSError, ValueError) as fault:  # ValueError: a null character
        reason = getattr(fault, "strerror", None) or fault
        raise HmtSlamError(f"{shorten(path)} cannot be read ({reason}): give an existing file") from fault
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise HmtSlamError(f"{shorten(path)} is no regular file: give one that can be read to its end")
    with os.fdopen(descriptor, "rb") as file:
        try:
            yield file
        except OSError as fault:
            raise HmtSlamError(f"{shorten(path)} cannot be read ({fault.strerror}): look at the disk") from fault


def read_text(path: Path, limit: int = MAX_FILE_BYTES) -> str:
    """The content of a file of UTF-8 text.

    :raises HmtSlamError: as :func:`read_file`, and where it is no such text.
    """
    try:
        return read_file(path, limit).decode("utf-8")
    except UnicodeDecodeError as fault:
        raise HmtSlamError(f"{shorten(path)} is no UTF-8 text ({fault.reason}): give a text file") from fault


def parse_json(text: str | bytes, name: str, limit: int = MAX_DOCUMENT_BYTES) -> Any:  # noqa: ANN401  any JSON
    """The value of a JSON document; numbers are finite, integers fit into 64 bits.

    :param name: what the document is called in a complaint.
    :param limit: characters that it may have.
    :raises HmtSlamError: where it is none, too large or too deep.
    """
    if len(text) > limit:
        raise HmtSlamError(f"{name} has {len(text)} characters, more than {limit}: it is left out")
    try:
        value = json.loads(text, parse_constant=_refuse_constant, parse_int=_bounded_integer)
    except RecursionError:
        raise HmtSlamError(f"{name} nests deeper than {MAX_DEPTH} levels: it is left out") from None
    except ValueError as fault:  # JSONDecodeError, UnicodeDecodeError
        raise HmtSlamError(f"{name} is no JSON ({shorten(fault)}): send or copy it anew") from fault
    _check_depth(value, name)
    return value


def _refuse_constant(word: str) -> NoReturn:
    raise ValueError(f"{word} is no finite number")


def _bounded_integer(digits: str) -> int:
    value = int(digits) if len(digits) < 25 else MAX_INTEGER + 1
    if not -MAX_INTEGER - 1 <= value <= MAX_INTEGER:
        raise ValueError(f"an integer of {len(digits)} digits needs more than 64 bits")
    return value


def _check_depth(value: object, name: str) -> None:
    """Refuse a value that nests too deep, level by level instead of by recursion."""
    level = [value]
    for _ in range(MAX_DEPTH):
        level = [
            item
            for container in level
            if isinstance(container, dict | list)
            for item in (container.values() if isinstance(container, dict) else container)
            if isinstance(item, dict | list)
        ]
        if not level:
            return
    raise HmtSlamError(f"{name} nests deeper than {MAX_DEPTH} levels: it is left out")


# The parser in C, where PyYAML was built with it, is 20 times as fast: a megabyte takes 3 s instead of 11.
class _BoundedLoader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """YAML's JSON: null, booleans, integers, floats, texts, lists and mappings, without tags."""

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        """An integer of at most 64 bits."""
        text = self.construct_scalar(node)
        value = super().construct_yaml_int(node) if len(text) < 100 else MAX_INTEGER + 1
        if abs(value) > MAX_INTEGER:
            message = f"an integer of {len(text)} digits needs more than 64 bits"
            raise yaml.constructor.ConstructorError(None, None, message, node.start_mark)
        return int(value)


_PLAIN_TAGS = ("null", "bool", "int", "float", "str", "seq", "map")
_BoundedLoader.yaml_constructors = {
    f"tag:yaml.org,2002:{tag}": yaml.SafeLoader.yaml_constructors[f"tag:yaml.org,2002:{tag}"] for tag in _PLAIN_TAGS
} | {
    "tag:yaml.org,2002:int": _BoundedLoader.construct_yaml_int,
    None: yaml.SafeLoader.construct_undefined,
}
_BoundedLoader.yaml_implicit_resolvers = {
    letter: [(tag, form) for tag, form in resolvers if tag.rsplit(":", 1)[-1] in _PLAIN_TAGS]
    for letter, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


def parse_yaml(text: str, name: str) -> Any:  # noqa: ANN401  any YAML
    """The value of a YAML document without aliases and tags; a date is a text.

    :param name: what the document is called in a complaint.
    :raises HmtSlamError: where it is none, too large or too deep.
    """
    if len(text) > MAX_YAML_BYTES:
        raise HmtSlamError(f"{name} has {len(text)} characters, more than {MAX_YAML_BYTES}: give a smaller file")
    try:
        _check_events(text)
        return yaml.load(text, _BoundedLoader)
    except Exception as fault:  # the library has classes of its own, and lets others through: KeyError at !!bool x
        raise HmtSlamError(f"{name} is no valid YAML{_yaml_fault(fault)}: correct it") from fault


def _check_events(text: str) -> None:
    """Refuse aliases, and what nests too deep, before anything is made of them."""
    depth = 0
    for event in yaml.parse(text, _BoundedLoader):
        if isinstance(event, yaml.AliasEvent):
            raise yaml.MarkedYAMLError(
                problem="an alias (*name) is not supported, write the value", problem_mark=event.start_mark
            )
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        if depth > MAX_DEPTH:
            raise yaml.MarkedYAMLError(problem=f"nests deeper than {MAX_DEPTH} levels", problem_mark=event.start_mark)


def _yaml_fault(fault: Exception) -> str:
    """What is wrong with a YAML document, and in which line, as the end of a sentence."""
    mark, problem = getattr(fault, "problem_mark", None), getattr(fault, "problem", None)
    reason = " ".join(str(problem or fault).split())[:200]
    return f" ({reason})" if mark is None else f" at line {mark.line + 1} ({reason})"


def read_yaml(path: Path) -> Any:  # noqa: ANN401  any YAML
    """The value of a YAML file.

    :raises HmtSlamError: as :func:`read_text` and :func:`parse_yaml`.
    """
    return parse_yaml(read_text(path, MAX_YAML_BYTES), shorten(path))


def shorten(value: object) -> str:
    """A value as a complaint names it: printable, in at most 80 characters, a path in 300."""
    is_readable = isinstance(value, str | Path | Exception)
    text, limit = str(value) if is_readable else _SHORT.repr(value), 300 if isinstance(value, Path) else 80
    printable = "".join(letter if letter.isprintable() else "?" for letter in text[: limit + 1])
    return printable if len(printable) <= limit else f"{printable[: limit - 3]}..."


def one_sentence(fault: object) -> str:
    """What a fault says, as one printable line of at most 900 characters."""
    text = "".join(letter if letter.isprintable() else "?" for letter in str(fault)[:901])
    return text if len(text) <= 900 else f"{text[:897]}..."


_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 60


def is_short_text(value: Hashable, limit: int = 255) -> bool:
    """Whether a value is a text of printable characters that a file name or a topic could be."""
    return isinstance(value, str) and len(value) <= limit and value.isprintable()
