"""Odometry readings and the increments between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Odometry:
    """A reading of the wheel odometry.

    :ivar stamp: integer nanoseconds, increasing within one source.
    :ivar pose: shape (3,), ``odom_T_base`` as (x, y, theta) in m and rad.
    """

    stamp: int
    pose: NDArray[np.float64]
