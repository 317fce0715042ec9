"""Heap allocations of compiled kernels while a log is mapped, as numba's runtime counts them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import numpy as np
from numba.core.dispatcher import Dispatcher
from numba.core.runtime import _nrt_python, rtsys

from benchmark.report import Requirement, table

PACKAGES = (
    "geometry",
    "sensors",
    "grids",
    "registration.scan_to_map",
    "registration.dynamic_rejection",
    "registration.correlative_search",
    "registration.match_covariance",
    "submap",
)
"""Packages with kernels that run for every scan, particle or beam."""

ARRAYS = {
    "geometry.covariance.propagate_covariance": (2, "the result, half of the product"),
    "geometry.covariance.inverse": (1, "the result"),
    "geometry.covariance.inverse_pose_covariance": (2, "the result, half of the product"),
    "geometry.covariance.rotate_covariance": (2, "the result, half of the product"),
    "geometry.se2._compose_each": (1, "the results"),
    "sensors.scan._beam_ends": (1, "the result"),
    "sensors.scan._valid_mask": (1, "the result"),
    "sensors.scan.extract_surfels": (
        6,
        "the result, the same with shadows, which those are, beams, ranges, running sums",
    ),
    "registration.scan_to_map.propose_all": (4, "the results for all particles"),
    "grids.insertion.cell_coordinates": (1, "the results for all particles"),
    "submap.local_mapping._split_at_range": (7, "the results, distances and what leads to them"),
    "registration.scan_to_map.align": (2, "the results"),
    "registration.dynamic_rejection.reject_dynamic": (
        9,
        "the result, equations of each segment, candidates for rejection",
    ),
    "registration.correlative_search.correlative_search": (5, "the result, scores, a pose, the cells of the points"),
}
"""{kernel: (largest number of arrays of a call, their names)}; all others make none."""

Counts = dict[str, list[int]]


@contextmanager
def count_allocations(packages: Sequence[str] = PACKAGES) -> Iterator[Counts]:
    """Count the allocations of every call of a kernel from Python, including the kernels that it calls.

    numba counts one block for every array argument, which is subtracted. Kernels have to be compiled before, because a
    counting kernel cannot be compiled into another one.

    :param packages: of ``hmt_slam_ros``, whose kernels are counted.
    :returns: {kernel: allocations of each call}, which grows while the context is open.
    """
    counts: Counts = {}
    replaced = []
    for module in [module for name, module in sys.modules.items() if name.startswith("hmt_slam_ros.")]:
        for name, value in list(vars(module).items()):
            kernel = _kernel_name(value)
            if kernel.startswith(tuple(f"{package}." for package in packages)):
                replaced.append((module, name, value))
                setattr(module, name, _wrap_kernel(value, counts.setdefault(kernel, [])))
    enabled = _nrt_python.memsys_stats_enabled()
    _nrt_python.memsys_enable_stats()
    try:
        yield counts
    finally:
        if not enabled:
            _nrt_python.memsys_disable_stats()
        _restore(replaced)


def _restore(replaced: Sequence[tuple[ModuleType, str, object]]) -> None:
    for module, name, value in replaced:
        setattr(module, name, value)


def _kernel_name(value: object) -> str:
    """Module and name of a kernel, without the package; empty for other values."""
    if not isinstance(value, Dispatcher):
        return ""
    return f"{value.py_func.__module__}.{value.py_func.__name__}".removeprefix("hmt_slam_ros.")


def _wrap_kernel(kernel: Callable[..., object], counts: list[int]) -> Callable[..., object]:
    def call(*arguments: object) -> object:
        begin = rtsys.get_allocation_stats().alloc
        result = kernel(*arguments)
        counts.append(rtsys.get_allocation_stats().alloc - begin - _count_arrays(arguments))
        return result

    return call


def _count_arrays(value: object) -> int:
    """The number of arrays in an argument of a kernel."""
    if isinstance(value, tuple):
        return sum(map(_count_arrays, value))
    return int(isinstance(value, np.ndarray))


def requirements_on(counts: Mapping[str, Sequence[int]]) -> list[Requirement]:
    """Requirements that no kernel makes more than its arrays, for any number of beams, particles and steps."""
    return [
        Requirement(f"{kernel}: arrays of a call", max(arrays), ARRAYS.get(kernel, (0, ""))[0])
        for kernel, arrays in sorted(counts.items())
        if arrays
    ]


def describe_counts(counts: Mapping[str, Sequence[int]], scans: int) -> tuple[str, dict[str, Any]]:
    """The counts as a table and for programs.

    :param scans: number of scans that they are from.
    """
    rows, data = [], {}
    for kernel, arrays in sorted(counts.items()):
        if arrays:
            calls, mean, most = len(arrays) / scans, float(np.mean(arrays)), max(arrays)
            data[kernel] = {"calls_per_scan": calls, "mean": mean, "most": most}
            rows.append([f"`{kernel}`", f"{calls:.2f}", f"{mean:.1f}", str(most), ARRAYS.get(kernel, (0, "none"))[1]])
    return table(["kernel", "calls a scan", "arrays a call", "at most", "which"], rows), data
