"""An occupancy grid as a PNG picture of two bits a cell."""

from __future__ import annotations

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

_UNKNOWN, _FREE, _OCCUPIED = 0, 1, 3
# Grayscale of two bits, without interlacing: see section 11.2.2 of the PNG specification, ISO/IEC 15948.
_BITS, _GRAY = 2, 0
_CELLS_IN_BYTE = 4
_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_OCCUPIED_FROM = 50  # of 100


def grid_png(cells: NDArray[np.int8]) -> bytes:
    """Black where nothing is known, dark gray where free, white where occupied; the browser gives it its colours.

    :param cells: shape (height, width), -1 unknown, else 0 to 100; row 0 is the smallest y, and the picture's lowest.
    """
    height, width = cells.shape
    levels = np.full((height, -(-width // _CELLS_IN_BYTE) * _CELLS_IN_BYTE), _UNKNOWN, dtype=np.uint8)
    levels[:, :width][cells >= 0] = _FREE
    levels[:, :width][cells >= _OCCUPIED_FROM] = _OCCUPIED
    quads = levels[::-1].reshape(height, -1, _CELLS_IN_BYTE)
    packed = (quads << np.array([6, 4, 2, 0], dtype=np.uint8)).sum(axis=2, dtype=np.uint8)
    # Every row begins with the number of its filter, 0 for none.
    rows = np.concatenate([np.zeros((height, 1), dtype=np.uint8), packed], axis=1)
    header = struct.pack(">IIBBBBB", width, height, _BITS, _GRAY, 0, 0, 0)
    body = zlib.compress(rows.tobytes(), level=6)
    return _SIGNATURE + _chunk(b"IHDR", header) + _chunk(b"IDAT", body) + _chunk(b"IEND", b"")


def _chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
