"""Log-ratio grids that are packed: a quarter of the memory, and a tenth of the time that it takes to make a grid."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float32, Float64, UInt8
from hmt_slam_ros.registration.search_bounds import LogRatioGrid


class PackedRatios(NamedTuple):
    """n log-ratios, of which most are 0, in unknown space, or the smallest one, in free space.

    :ivar shape: rows and columns.
    :ivar smallest: the smallest log-ratio.
    :ivar known: shape (ceil(n / 8),), bits of those that are not 0.
    :ivar others: likewise, bits of those that are neither 0 nor the smallest one.
    :ivar values: shape (k,), these.
    """

    shape: tuple[int, int]
    smallest: np.float32
    known: UInt8
    others: UInt8
    values: Float32

    def unpack(self) -> Float32:
        """The log-ratios, each with the same bits."""
        ratios = np.zeros(self.shape, dtype=np.float32)
        ratios[unpack_flags(self.known, self.shape)] = self.smallest
        ratios[unpack_flags(self.others, self.shape)] = self.values
        return ratios


def pack_ratios(ratios: Float32) -> PackedRatios:
    """Pack log-ratios of some cells, shape (rows, columns)."""
    rows, columns = ratios.shape
    smallest = ratios.min()
    bits = np.ascontiguousarray(ratios).view(np.uint32)
    known = bits != 0
    others = known & (bits != smallest.view(np.uint32))
    return PackedRatios((rows, columns), smallest, np.packbits(known), np.packbits(others), ratios[others])


def unpack_flags(bits: UInt8, shape: tuple[int, int]) -> Bool:
    """The flags, of a shape, of which numpy packed the bits."""
    return np.unpackbits(bits, count=shape[0] * shape[1]).view(np.bool_).reshape(shape)


class PackedLogRatioGrid(NamedTuple):
    """A packed :class:`LogRatioGrid`."""

    log_ratio: PackedRatios
    origin: Float64
    cell: float

    def unpack(self) -> LogRatioGrid:
        """The grid."""
        return LogRatioGrid(self.log_ratio.unpack(), self.origin, self.cell)


def pack_log_ratio_grid(grid: LogRatioGrid) -> PackedLogRatioGrid:
    """Pack a grid."""
    return PackedLogRatioGrid(pack_ratios(grid.log_ratio), grid.origin, grid.cell)
