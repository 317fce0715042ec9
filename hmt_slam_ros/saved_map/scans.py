"""Scans, each stored once however many documents speak of it."""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from dataclasses import dataclass

import numpy as np

from hmt_slam_ros.arrays import Float32, Float64, Int64
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.plain_data import Reader
from hmt_slam_ros.sensors import Scan

_GEOMETRY = ("angle_min", "angle_increment", "range_min", "range_max", "time_increment")


@dataclass(frozen=True, eq=False)
class ScanTable:
    """Scans, as :class:`~hmt_slam_ros.sensors.Scan` describes them.

    :ivar names: shape (n,), by which the other documents refer to them: their stamps, or where two have the same stamp
        the next number that is free.
    :ivar stamps: shape (n,), time of the first beam, ns.
    :ivar beams: shape (n,), how many beams each has.
    :ivar ranges: shape (sum of the beams,), m, scan by scan; NaN or out of the limits where nothing came back.
    :ivar geometry: shape (n, 5): angle of the first beam in the laser's frame and from one beam to the next, rad,
        smallest valid range and smallest range that means "no return", m, time from one beam to the next, s.
    :ivar laser_poses: shape (n, 3), ``base_T_laser``, m and rad.
    :ivar motions: shape (n, 3), the base's motion from the first beam to the last as a twist, m, m, rad.
    :ivar partial_beams: shape (c,), beams of all scans, counted through as in ``ranges``, that do not hold from the
        laser on.
    :ivar partial_starts: shape (c,), from where on each of these holds, m.
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
        """Of some scans."""
        rows = list(scans)
        starts = [np.zeros_like(scan.ranges) if scan.starts is None else scan.starts for scan in rows]
        begins = np.concatenate([np.zeros(0, np.float32), *starts], dtype=np.float32)
        cut = np.flatnonzero(begins)
        return cls(
            np.array(list(names), dtype=np.int64),
            np.array([scan.stamp for scan in rows], dtype=np.int64),
            np.array([scan.ranges.size for scan in rows], dtype=np.int64),
            np.concatenate([np.zeros(0, np.float32), *(scan.ranges for scan in rows)], dtype=np.float32),
            np.array([[getattr(scan, name) for name in _GEOMETRY] for scan in rows]).reshape(-1, len(_GEOMETRY)),
            np.array([scan.laser_pose for scan in rows], dtype=np.float64).reshape(-1, 3),
            np.array([scan.motion for scan in rows], dtype=np.float64).reshape(-1, 3),
            cut,
            begins[cut],
        )

    def to_scans(self) -> dict[int, Scan]:
        """{name: scan}."""
        ends = np.cumsum(self.beams)
        begins = np.zeros(self.ranges.size, dtype=np.float32)
        begins[self.partial_beams] = self.partial_starts
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
                starts=begins[begin:end] if begins[begin:end].any() else None,
                **dict(zip(_GEOMETRY, geometry, strict=True)),
            )
            for name, stamp, begin, end, geometry, laser_pose, motion in rows
        }


class ScanWriter:
    """Takes the scans of documents that are written; there they have names."""

    def __init__(self) -> None:
        """Without any."""
        self._names: dict[int, int] = {}
        self._scans: dict[int, Scan] = {}

    @property
    def table(self) -> ScanTable:
        """All that were named."""
        return ScanTable.from_scans(self._scans.keys(), self._scans.values())

    def store(self, value: Scan) -> object:
        """The name of a scan, the same for one and the same object."""
        name = self._names.get(id(value), value.stamp)
        while id(value) not in self._names:
            if name not in self._scans:
                self._names[id(value)], self._scans[name] = name, value
            else:
                name += 1
        return name


class ScanReader:
    """Finds the scans of documents that are read, one and the same object for a name."""

    def __init__(self, table: ScanTable) -> None:
        """:param table: of all scans."""
        self._scans = table.to_scans()

    def reader(self, field: str, kind: Hashable) -> Reader:  # noqa: ARG002  all are of one kind
        """What finds a scan by its name."""

        def read(content: object, path: str) -> Scan:
            if not isinstance(content, int) or content not in self._scans:
                raise HmtSlamError(
                    f"{path} = {str(content)[:60]} is no scan of the map: see docs/reference/map_format.md"
                )
            return self._scans[content]

        return read
