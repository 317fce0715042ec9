"""Time stamps as integer nanoseconds, and the running clock of a log."""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal

import numpy as np
from numpy.typing import NDArray

NANOSECONDS = 1_000_000_000
"""Nanoseconds in a second."""

_LARGEST = 2**62
"""Largest stamp, ns, in the year 2116: sums of two fit into 64 bits."""

_STEP = 1_000
"""Time between two readings of one kind where the source's clock does not advance, ns."""


def stamp_from_seconds(text: str) -> int:
    """Nanoseconds of a decimal number of seconds, exact. A float64 would round a stamp of today to 100 ns.

    :param text: such as ``976052857.337284`` or ``1.4e3``; digits after the ninth decimal are ignored.
    :raises ValueError: where the text is no number, or too large.
    """
    whole, _, fraction = text.partition(".")
    try:
        if whole.isdecimal() and (fraction.isdecimal() or not fraction):
            stamp = int(whole) * NANOSECONDS + int(fraction[:9].ljust(9, "0"))
        else:
            stamp = int(Decimal(text) * NANOSECONDS)
    except (ArithmeticError, ValueError):
        raise ValueError(f"{text!r} is no time in seconds") from None
    if abs(stamp) > _LARGEST:
        raise ValueError(f"{text!r} is no time in seconds")
    return stamp


def seconds_from_stamp(stamp: int) -> str:
    """Decimal seconds with nine decimals, from which `stamp_from_seconds` recovers the stamp exactly."""
    whole, fraction = divmod(abs(stamp), NANOSECONDS)
    return f"{'-' if stamp < 0 else ''}{whole}.{fraction:09d}"


def running_stamps(
    sources: Sequence[int], is_scan: Sequence[bool], precedes_its_scan: Sequence[bool]
) -> NDArray[np.int64]:
    """Stamps of the running clock that `LogRecord` describes, for all readings of a log, shape (n,), ns.

    :param sources: the log's own stamps in file order, ns.
    :param is_scan: whether each reading is a scan, else odometry.
    :param precedes_its_scan: whether each reading is odometry that belongs to the scan directly after it.
    """
    stamps = np.empty(len(sources), dtype=np.int64)
    last_scan = last_odometry = last = min(sources, default=0) - _STEP
    for k, (source, scan, paired) in enumerate(zip(sources, is_scan, precedes_its_scan, strict=True)):
        if scan and k and precedes_its_scan[k - 1]:
            stamp = last
        else:
            stamp = max(source, last)
            if ((scan or paired) and stamp <= last_scan) or (not scan and stamp <= last_odometry):
                stamp = last + _STEP
        last_scan = stamp if scan else last_scan
        last_odometry = last_odometry if scan else stamp
        stamps[k] = last = stamp
    return stamps
