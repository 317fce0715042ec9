"""Arrays beside the document that names them: one after the other in a file, little-endian, in C order."""

from __future__ import annotations

import math
from collections.abc import Hashable
from functools import cache
from typing import Any, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.plain_data import Reader

_ALIGNED = 8  # bytes


class Sink(Protocol):
    """Takes bytes one after the other."""

    def write(self, content: bytes, /) -> object:
        """Take some."""


class ArrayWriter:
    """Takes the arrays of a document that is written: there they are {"type", "shape", "at"}, an offset in bytes."""

    def __init__(self, file: Sink) -> None:
        """:param file: where the arrays go."""
        self._file = file
        self._size = 0

    def store(self, value: NDArray[Any]) -> object:
        """Where an array is."""
        content = np.asarray(value, dtype=value.dtype.newbyteorder("<")).tobytes()
        at = self._size
        missing = -len(content) % _ALIGNED
        self._file.write(content + bytes(missing))
        self._size += len(content) + missing
        return {"type": _dtype_name(value.dtype), "shape": list(value.shape), "at": at}


class ArrayReader:
    """Finds the arrays of a document that is read."""

    def __init__(self, content: bytes) -> None:
        """:param content: of the file."""
        self._content = content

    def reader(self, field: str, kind: Hashable) -> Reader:  # noqa: ARG002  the annotation tells all
        """What finds an array of the type that is annotated; each is a copy of its own."""
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
