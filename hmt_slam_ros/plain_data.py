"""Conversion of annotated values to plain data, which JSON can store, and back, with strict checks.

The form follows from the annotations. A dataclass or a named tuple is an object with exactly its fields, a tuple is a
list, a set is a sorted list, a mapping is a list of pairs in its own order. Floats keep their bits. Each dataclass of a
union has a field ``kind`` with a word of its own.
"""

from __future__ import annotations

import math
import types
from collections.abc import Callable, Hashable, Mapping, Set
from dataclasses import fields, is_dataclass
from enum import StrEnum
from functools import cache
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import numpy as np

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.untrusted_input import MAX_INTEGER, shorten

Value = TypeVar("Value")
Reader = Callable[[object, str], object]
"""Converts plain data at a path in a document into a value, or raises an error."""

ReaderFactory = Callable[[str, Hashable], Reader]
"""Makes the reader of a field, by its name and annotation."""


def to_plain(value: object, forms: Mapping[type, Callable[[Any], object]]) -> Any:  # noqa: ANN401  any JSON value
    """A value as plain data.

    :param forms: {type: conversion of its values to plain data}, for other types, such as arrays.
    """
    if value is None or type(value) in (int, float, str, bool):
        return value
    form = forms.get(type(value))
    if form is not None:
        return form(value)
    if is_record(type(value)):
        return {name: to_plain(getattr(value, name), forms) for name in field_names(cast(Any, type(value)))}
    if isinstance(value, tuple | Set):
        return [to_plain(item, forms) for item in (sorted(value) if isinstance(value, Set) else value)]
    if isinstance(value, Mapping):
        return [[to_plain(key, forms), to_plain(item, forms)] for key, item in value.items()]
    return value.item() if isinstance(value, np.generic) else value


class PlainDataReader:
    """Converts plain data into values.

    :ivar format_reference: description of the documents, for error messages.
    """

    def __init__(
        self,
        format_reference: str,
        forms: Mapping[type, ReaderFactory],
        check: Callable[[Any, str], None] | None = None,
    ) -> None:
        """:param forms: {type: factory of readers}, for other types, such as arrays.

        :param check: called with each dataclass or named tuple that was read and its path; raises HmtSlamError where
            it is not as it has to be.
        """
        self.format_reference = format_reference
        self._forms, self._check = forms, check
        self._readers: dict[tuple[str, Hashable], Reader] = {}

    def read(self, content: object, kind: type[Value], path: str) -> Value:
        """The value of plain data.

        :param kind: type of the value.
        :param path: name of the document, for error messages.
        :raises HmtSlamError: where the data has another form; names the field.
        """
        return cast(Value, self._reader("", cast(Hashable, kind))(content, path))

    def _reader(self, field: str, kind: Hashable) -> Reader:
        reader = self._readers.get((field, kind))
        if reader is None:
            reader = self._readers[field, kind] = self._new_reader(field, kind)
        return reader

    def _new_reader(self, field: str, kind: Hashable) -> Reader:
        origin, arguments = get_origin(kind), get_args(kind)
        factory = self._forms.get(cast(type, origin or kind))
        if factory is not None:
            return factory(field, kind)
        if kind in _SCALARS:
            return self._number if kind is float else self._scalar(*_SCALARS[kind])
        if is_record(kind):
            return self._object(cast(type, kind))
        if origin in (Union, types.UnionType):
            return self._union(field, arguments)
        words = literal_words(kind)
        return self._literal(words) if words else self._collection(origin, arguments)

    def _collection(self, origin: object, arguments: tuple[Any, ...]) -> Reader:
        if origin is tuple and len(arguments) == 2 and arguments[1] is Ellipsis:
            return self._list(self._reader("", arguments[0]), tuple)
        if origin is tuple:
            return self._fixed_tuple([self._reader("", argument) for argument in arguments])
        if origin is frozenset:
            return self._list(self._reader("", arguments[0]), frozenset)
        if isinstance(origin, type) and issubclass(origin, Mapping):
            return self._mapping(*(self._reader("", argument) for argument in arguments))
        raise TypeError(f"a document cannot hold a {origin}[{arguments}]")

    def _object(self, kind: type) -> Reader:
        hints = get_type_hints(kind)
        readers = {name: self._reader(name, hints[name]) for name in field_names(kind)}
        check = self._check

        def read(content: object, path: str) -> object:
            if not isinstance(content, dict):
                raise self.error_at(path, content, "an object")
            for name in readers.keys() - content.keys():
                raise HmtSlamError(
                    f"{path}.{name} is missing: see {self.format_reference} for the form of the document"
                )
            for name in content.keys() - readers.keys():
                raise HmtSlamError(
                    f"{path}.{shorten(name)} is unknown: see {self.format_reference} for the form of the document"
                )
            record = kind(**{name: reader(content[name], f"{path}.{name}") for name, reader in readers.items()})
            if check is not None:
                check(record, path)
            return record

        return read

    def _list(self, item: Reader, collection: Callable[..., object]) -> Reader:
        def read(content: object, path: str) -> object:
            if not isinstance(content, list):
                raise self.error_at(path, content, "a list")
            return collection(item(entry, f"{path}[{k}]") for k, entry in enumerate(content))

        return read

    def _fixed_tuple(self, items: list[Reader]) -> Reader:
        def read(content: object, path: str) -> tuple[object, ...]:
            if not isinstance(content, list) or len(content) != len(items):
                raise self.error_at(path, content, f"a list of {len(items)}")
            return tuple(item(content[k], f"{path}[{k}]") for k, item in enumerate(items))

        return read

    def _mapping(self, key: Reader, item: Reader) -> Reader:
        pairs = self._list(self._fixed_tuple([key, item]), dict)

        def read(content: object, path: str) -> object:
            mapping = pairs(content, path)
            if len(cast(dict[Any, Any], mapping)) < len(cast(list[Any], content)):
                raise self.error_at(path, content, "a list of pairs with different keys")
            return mapping

        return read

    def _union(self, field: str, arguments: tuple[Any, ...]) -> Reader:
        kinds = [argument for argument in arguments if argument is not type(None)]
        reader = self._reader(field, kinds[0]) if len(kinds) == 1 else self._tagged_union(kinds)
        if len(kinds) == len(arguments):
            return reader
        return lambda content, path: None if content is None else reader(content, path)

    def _tagged_union(self, kinds: list[type]) -> Reader:
        """The reader of a union of dataclasses, by the word in the field ``kind``."""
        readers = {get_args(get_type_hints(kind)["kind"])[0]: self._reader("", kind) for kind in kinds}

        def read(content: object, path: str) -> object:
            if not isinstance(content, dict):
                raise self.error_at(path, content, "an object")
            kind = content.get("kind")
            if not isinstance(kind, str) or kind not in readers:
                raise self.error_at(f"{path}.kind", kind, " or ".join(readers))
            return readers[kind](content, path)

        return read

    def _literal(self, values: Mapping[str, object]) -> Reader:
        def read(content: object, path: str) -> object:
            if not isinstance(content, str) or content not in values:
                raise self.error_at(path, content, " or ".join(values))
            return values[content]

        return read

    def _scalar(self, kind: type, name: str) -> Reader:
        def read(content: object, path: str) -> object:
            if type(content) is not kind:
                raise self.error_at(path, content, name)
            return content

        return read

    def _number(self, content: object, path: str) -> float:
        if type(content) is int and abs(content) <= MAX_INTEGER:
            return float(content)
        if not isinstance(content, float) or not math.isfinite(content):
            raise self.error_at(path, content, _SCALARS[float][1])
        return content

    def error_at(self, path: str, content: object, wanted: str) -> HmtSlamError:
        """The error for content at a path that is not as wanted."""
        return HmtSlamError(
            f"{path} = {shorten(content)} is not {wanted}: see {self.format_reference} for the document's form"
        )


def literal_words(kind: Hashable) -> dict[str, object]:
    """{word in a document: value} of a literal or an enumeration, empty for other types."""
    if isinstance(kind, type) and issubclass(kind, StrEnum):
        return {member.value: member for member in kind}
    return {word: word for word in get_args(kind)} if get_origin(kind) is Literal else {}


def is_record(kind: object) -> bool:
    """Whether a type is a dataclass or a named tuple."""
    return isinstance(kind, type) and (is_dataclass(kind) or hasattr(kind, "_fields"))


@cache
def field_names(kind: type) -> tuple[str, ...]:
    """Names of the fields of a dataclass or named tuple, without those that are no arguments of the class."""
    return tuple(entry.name for entry in fields(kind) if entry.init) if is_dataclass(kind) else cast(Any, kind)._fields


_SCALARS: dict[Hashable, tuple[type, str]] = {
    bool: (bool, "true or false"),
    int: (int, "a whole number"),
    float: (float, "a finite number"),
    str: (str, "a text"),
}
"""{annotation: (exact type, description)} of scalars."""
