"""JSON schemas of the documents on topics, draft 2020-12, from the annotations and docstrings of their classes."""

from __future__ import annotations

import types
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from hmt_slam_ros.messages.documents import KeyframeHeader, ScanGeometry, array_shape
from hmt_slam_ros.messages.messages import Keyframe
from hmt_slam_ros.plain_data import field_names, is_record, literal_words
from hmt_slam_ros.process_table import DocumentRow
from hmt_slam_ros.saved_map.reference import field_meanings, summary
from hmt_slam_ros.sensors import Scan

DIALECT = "https://json-schema.org/draft/2020-12/schema"

Schema = dict[str, Any]
"""A JSON schema as plain data."""

_DESCRIBED_BY: dict[type, type] = {KeyframeHeader: Keyframe, ScanGeometry: Scan}
"""{class of a part of another message: class whose docstring has the meanings of its fields}."""

_SCALARS: dict[Any, Schema] = {
    bool: {"type": "boolean"},
    int: {"type": "integer"},
    float: {"type": "number"},
    str: {"type": "string"},
}


def document_schema(row: DocumentRow) -> Schema:
    """The schema of a document.

    :raises KeyError: where a field has no meaning in the docstring of its class.
    """
    definitions: dict[str, Schema] = {}
    record = _record(row.message_class, definitions)
    head = {"document": {"const": row.document}, "version": {"const": row.version}}
    optional = {
        "reset": {**_SCALARS[int], "description": "Number of the last reset of the sender; missing before the first."},
        "system": {**_SCALARS[str], "description": "Name of the sender's system; missing where it has none."},
    }
    return {
        "$schema": DIALECT,
        "title": f"{row.document}, version {row.version}, on {row.topic}",
        **record,
        "properties": {**head, **record["properties"], **optional},
        "required": [*head, *record["required"]],
        "$defs": {name: definitions[name] for name in sorted(definitions)},
    }


def _record(kind: type, definitions: dict[str, Schema]) -> Schema:
    """The schema of a dataclass or named tuple; adds those of its parts to the definitions."""
    hints, meanings = get_type_hints(kind), field_meanings(_DESCRIBED_BY.get(kind, kind))
    properties = {
        name: {**_value(name, hints[name], definitions), "description": meanings[name]} for name in field_names(kind)
    }
    return {
        "description": summary(kind),
        "type": "object",
        "properties": properties,
        "required": list(properties),
        "additionalProperties": False,
    }


def _value(field: str, kind: Any, definitions: dict[str, Schema]) -> Schema:  # noqa: ANN401  any annotation
    """The schema of a value."""
    origin, arguments = get_origin(kind), get_args(kind)
    if kind in _SCALARS:
        return dict(_SCALARS[kind])
    if origin is np.ndarray:
        return _array(array_shape(field))
    if is_record(kind):
        return _reference(kind, definitions)
    if words := literal_words(kind):
        return {"enum": list(words)}
    if origin in (Union, types.UnionType):
        kinds = [argument for argument in arguments if argument is not type(None)]
        options = [_value(field, argument, definitions) for argument in kinds]
        return {"anyOf": [*options, {"type": "null"}]} if len(kinds) < len(arguments) else {"anyOf": options}
    if origin is tuple and arguments[1:] == (Ellipsis,):
        return {"type": "array", "items": _value("", arguments[0], definitions)}
    raise TypeError(f"a document cannot hold a {kind}")


def _reference(kind: type, definitions: dict[str, Schema]) -> Schema:
    if kind.__name__ not in definitions:
        definitions[kind.__name__] = {}  # before its parts, which may refer to it
        definitions[kind.__name__] = _record(kind, definitions)
    return {"$ref": f"#/$defs/{kind.__name__}"}


def _array(shape: tuple[int, ...] | None) -> Schema:
    """The schema of an array: nested lists of numbers, or the bytes of float32 numbers."""
    if shape is None:
        return {"type": "string", "contentEncoding": "base64"}
    schema: Schema = dict(_SCALARS[float])
    for length in reversed(shape):
        schema = {"type": "array", "items": schema, "minItems": length, "maxItems": length}
    return schema
