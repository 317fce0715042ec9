"""Arrays of a document: one after the other in a binary file, little-endian, in C order."""

from __future__ import annotations

import math
from collections.abc import Hashable
from functools import cache
from typing import Any, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.plain_data import Reader

_ALIGNMENT = 8
"""Alignment of arrays in the file, bytes."""


class Sink(Protocol):
    """A file that bytes are appended to."""

    def write(self, content: bytes, /) -> object:
        """Append bytes."""


class ArrayWriter:
    """Writes the arrays of a document, which has {"type", "shape", "at"} for each, with an offset in bytes."""

    def __init__(self, file: Sink) -> None:
        """:param file: file for the arrays."""
        self._file = file
        self._size = 0

    def store(self, value: NDArray[Any]) -> object:
        """Write an array and return its entry in the document."""
        content = np.asarray(value, dtype=value.dtype.newbyteorder("<")).tobytes()
        padded = content + bytes(-len(content) % _ALIGNMENT)
        entry = {"type": _dtype_name(value.dtype), "shape": list(value.shape), "at": self._size}
        self._file.write(padded)
        self._size += len(padded)
        return entry


class ArrayReader:
    """Reads the arrays of a document."""

    def __init__(self, content: bytes) -> None:
        """:param content: content of the file."""
        self._content = content

    def reader(self, field: str, kind: Hashable) -> Reader:  # noqa: ARG002  the annotation has the type
        """The reader of arrays with the annotated type; it makes copies."""
        wanted = np.dtype(get_args(get_args(kind)[1])[0])
        name, size = _dtype_name(wanted), wanted.itemsize

        def read(content: object, path: str) -> NDArray[Any]:
            match content:
                case {"type": str(found), "shape": list(shape), "at": int(at)} if found == name:
                    count = math.prod(shape)
                    if 0 <= at <= len(self._content) - count * size:
                        flat = np.frombuffer(self._content, wanted.newbyteorder("<"), count, at)
                        return flat.reshape(shape).astype(wanted)
            raise HmtSlamError(
                f"{path} = {str(content)[:60]} is not an array of {name}: see docs/reference/map_format.md"
            )

        return read


@cache
def _dtype_name(dtype: np.dtype[Any]) -> str:
    return str(dtype.newbyteorder("="))
