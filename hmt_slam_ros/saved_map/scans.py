"""Scans, each stored once for all documents."""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from dataclasses import dataclass

import numpy as np

from hmt_slam_ros.arrays import Float32, Float64, Int64
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.plain_data import Reader
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.plausibility import check_scan
from hmt_slam_ros.untrusted_input import shorten

_TABLE = "scans"

_GEOMETRY = ("angle_min", "angle_increment", "range_min", "range_max", "time_increment")
"""Fields of a scan in the columns of ``ScanTable.geometry``."""


@dataclass(frozen=True, eq=False)
class ScanTable:
    """The fields of n scans (:class:`~hmt_slam_ros.sensors.Scan`).

    :ivar names: shape (n,), names of the scans in other documents: their stamps, or for an equal stamp the next free
        number.
    :ivar stamps: shape (n,), time of the first beam, ns.
    :ivar beams: shape (n,), number of beams.
    :ivar ranges: shape (sum of the beams,), m, scan by scan; NaN or out of the limits for no return.
    :ivar geometry: shape (n, 5): angle of the first beam in the laser's frame and from one beam to the next, rad,
        smallest valid range and smallest range that means "no return", m, time from one beam to the next, s.
    :ivar laser_poses: shape (n, 3), ``base_T_laser``, m and rad.
    :ivar motions: shape (n, 3), the base's motion from the first beam to the last as a twist, m, m, rad.
    :ivar partial_beams: shape (c,), indices into ``ranges`` of beams that are not valid from the laser on.
    :ivar partial_starts: shape (c,), distance from the laser from which each of these is valid, m.
    """

    names: Int64
    stamps: Int64
    beams: Int64
    ranges: Float32
    geometry: Float64
    laser_poses: Float64
    motions: Float64
    partial_beams: Int64
    partial_starts: Float32

    @classmethod
    def from_scans(cls, names: Iterable[int], scans: Iterable[Scan]) -> ScanTable:
        """The table of scans with their names."""
        rows = list(scans)
        starts = [np.zeros_like(scan.ranges) if scan.starts is None else scan.starts for scan in rows]
        all_starts = np.concatenate([np.zeros(0, np.float32), *starts], dtype=np.float32)
        partial = np.flatnonzero(all_starts)
        return cls(
            np.array(list(names), dtype=np.int64),
            np.array([scan.stamp for scan in rows], dtype=np.int64),
            np.array([scan.ranges.size for scan in rows], dtype=np.int64),
            np.concatenate([np.zeros(0, np.float32), *(scan.ranges for scan in rows)], dtype=np.float32),
            np.array([[getattr(scan, name) for name in _GEOMETRY] for scan in rows]).reshape(-1, len(_GEOMETRY)),
            np.array([scan.laser_pose for scan in rows], dtype=np.float64).reshape(-1, 3),
            np.array([scan.motion for scan in rows], dtype=np.float64).reshape(-1, 3),
            partial,
            all_starts[partial],
        )

    def to_scans(self) -> dict[int, Scan]:
        """{name: scan}."""
        ends = np.cumsum(self.beams)
        starts = np.zeros(self.ranges.size, dtype=np.float32)
        starts[self.partial_beams] = self.partial_starts
        rows = zip(
            self.names.tolist(),
            self.stamps.tolist(),
            (ends - self.beams).tolist(),
            ends.tolist(),
            self.geometry.tolist(),
            self.laser_poses,
            self.motions,
            strict=True,
        )
        return {
            name: Scan(
                stamp=stamp,
                ranges=self.ranges[begin:end],
                laser_pose=laser_pose,
                motion=motion,
                starts=starts[begin:end] if starts[begin:end].any() else None,
                **dict(zip(_GEOMETRY, geometry, strict=True)),
            )
            for name, stamp, begin, end, geometry, laser_pose, motion in rows
        }


class ScanWriter:
    """Collects the scans of documents, in which they have names."""

    def __init__(self) -> None:
        """A writer without scans."""
        self._names: dict[int, int] = {}
        self._scans: dict[int, Scan] = {}
        # A number of an object may be given to another where it is deleted.
        self._kept: list[Scan] = []

    @property
    def table(self) -> ScanTable:
        """The table of all scans."""
        return ScanTable.from_scans(self._scans.keys(), self._scans.values())

    def store(self, value: Scan) -> object:
        """The name of a scan; copies of a scan have one name."""
        name = self._names.get(id(value), value.stamp)
        while id(value) not in self._names:
            stored = self._scans.setdefault(name, value)
            if stored is value or _is_copy(stored, value):
                self._names[id(value)] = name
                self._kept.append(value)
            else:
                name += 1
        return name


def _is_copy(scan: Scan, other: Scan) -> bool:
    """Whether two scans of one stamp are the same in all fields."""
    starts = scan.starts if scan.starts is not None else np.zeros(0, np.float32)
    others = other.starts if other.starts is not None else np.zeros(0, np.float32)
    arrays = (scan.ranges, other.ranges), (scan.laser_pose, other.laser_pose), (scan.motion, other.motion)
    return all(getattr(scan, name) == getattr(other, name) for name in ("stamp", *_GEOMETRY)) and all(
        own.tobytes() == theirs.tobytes() for own, theirs in (*arrays, (starts, others))
    )


class ScanReader:
    """Reads the scans of documents: the same object for the same name."""

    def __init__(self, table: ScanTable) -> None:
        """:param table: table of all scans, of which the sizes are checked.

        :raises HmtSlamError: where one is none that the readers of logs would let pass.
        """
        self._scans = table.to_scans()
        for name, scan in self._scans.items():
            try:
                check_scan(scan)
            except HmtSlamError as fault:
                raise HmtSlamError(
                    f"{_TABLE}[{name}] of the map is no scan ({fault}): take a copy that is whole, or map the log again"
                ) from fault

    def reader(self, field: str, kind: Hashable) -> Reader:  # noqa: ARG002  all scans have one type
        """The reader of scans by their names."""

        def read(content: object, path: str) -> Scan:
            if type(content) is not int or content not in self._scans:
                raise HmtSlamError(
                    f"{path} = {shorten(content)} is no scan of the map: see docs/reference/map_format.md"
                )
            return self._scans[content]

        return read
