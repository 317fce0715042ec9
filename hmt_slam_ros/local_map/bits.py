"""Words of 32 bits as sets of columns."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from hmt_slam_ros.arrays import UInt32


@intrinsic
def lowest(_context: Any, word: Any) -> Any:  # noqa: ANN401  numba's own types
    """The number of the lowest bit that is set; a word without any has no answer."""

    def count_trailing_zeros(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:  # noqa: ANN401
        zeros = builder.cttz(arguments[0], cgutils.true_bit)
        return builder.zext(zeros, context.get_value_type(types.int64))

    return types.int64(word), count_trailing_zeros


@njit(cache=True)
def any_set(words: UInt32) -> bool:
    """Whether a bit is set in any of the words (n,)."""
    found = np.uint32(0)
    for word in words:
        found |= word
    return found != 0
