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
from hmt_slam_ros.untrusted_input import shorten

_ALIGNMENT = 8
"""Alignment of arrays in the file, bytes."""

_MAX_AXES = 4
"""Axes of an array; none of the package has more than 3."""

_MAX_EMPTY = 4096
"""Largest product of the other sizes of an array without elements, in a file that has fewer bytes."""


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
        self._unread = len(content)

    def reader(self, field: str, kind: Hashable) -> Reader:  # noqa: ARG002  the annotation has the type
        """The reader of arrays with the annotated type; it makes copies."""
        wanted = np.dtype(get_args(get_args(kind)[1])[0])
        name, size = _dtype_name(wanted), wanted.itemsize

        def read(content: object, path: str) -> NDArray[Any]:
            match content:
                case {"type": str(found), "shape": list(shape), "at": int(at)} if found == name and self._is_shape(
                    shape
                ):
                    count = math.prod(shape)
                    # Each byte belongs to one array: a document cannot hold more than its file.
                    self._unread -= count * size
                    if 0 <= at <= len(self._content) - count * size and self._unread >= 0:
                        return self._array(wanted, shape, at)
            raise HmtSlamError(
                f"{path} = {shorten(str(content)[:100])} is not an array of {name}: see docs/reference/map_format.md"
            )

        return read

    def _is_shape(self, shape: list[Any]) -> bool:
        """Whether a list is the shape of an array of the file: at most 4 sizes, each an integer that is not negative.

        An array without elements takes no byte, so that its other sizes are bounded by themselves.
        """
        if len(shape) > _MAX_AXES or not all(type(size) is int and size >= 0 for size in shape):
            return False
        return math.prod(size for size in shape if size) <= max(len(self._content), _MAX_EMPTY)

    def _array(self, wanted: np.dtype[Any], shape: list[int], at: int) -> NDArray[Any]:
        """A copy of the array with a shape at an offset, bytes."""
        count = math.prod(shape)
        if wanted.kind == "b":  # a byte that is neither 0 nor 1 would be no boolean
            return (np.frombuffer(self._content, np.uint8, count, at) != 0).reshape(shape)
        flat = np.frombuffer(self._content, wanted.newbyteorder("<"), count, at)
        return flat.reshape(shape).astype(wanted)


@cache
def _dtype_name(dtype: np.dtype[Any]) -> str:
    return str(dtype.newbyteorder("="))
