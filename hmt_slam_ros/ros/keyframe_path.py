"""The robot's path as nav_msgs/Path, serialized from arrays: a ROS message for each pose takes far longer."""

from __future__ import annotations

import struct

import numpy as np

from hmt_slam_ros.arrays import Float64, Int64
from hmt_slam_ros.logs.stamps import NANOSECONDS

_ENCAPSULATION = b"\x00\x01\x00\x00"
"""CDR, little-endian, without options."""
_TIME_AND_LENGTH = 12
"""Bytes of a header before the name of its frame."""
_POSE = np.dtype(("<f8", 7))
"""Position and quaternion."""


def serialized_path(stamp: int, frame: str, stamps: Int64, poses: Float64) -> bytes:
    """The serialized path, as ``Publisher.publish`` takes it.

    :param stamp: of the path, ns.
    :param frame: frame of all poses.
    :param stamps: shape (n,), of the poses, ns.
    :param poses: shape (n, 3), ``frame_T_base``, m and rad.
    """
    name = frame.encode() + b"\0"
    head = struct.pack("<iII", *divmod(stamp, NANOSECONDS), len(name)) + name
    head += bytes(-len(head) % 4) + struct.pack("<I", len(stamps))
    # Numbers of 8 bytes are aligned: behind the first pose all others are laid out in one way.
    first = _serialized_poses(name, stamps[:1], poses[:1], len(head))
    others = _serialized_poses(name, stamps[1:], poses[1:], 0)
    return _ENCAPSULATION + head + first + others


def _serialized_poses(name: bytes, stamps: Int64, poses: Float64, start: int) -> bytes:
    """Poses with their headers.

    :param name: of the frame, with its end.
    :param start: bytes before the first one.
    """
    end = _TIME_AND_LENGTH + len(name)
    offset = end + -(start + end) % 8
    row = np.dtype(
        {
            "names": ("seconds", "nanoseconds", "length", "name", "pose"),
            "formats": ("<i4", "<u4", "<u4", f"S{len(name)}", _POSE),
            "offsets": (0, 4, 8, _TIME_AND_LENGTH, offset),
            "itemsize": offset + _POSE.itemsize,
        }
    )
    rows = np.zeros(len(stamps), row)
    rows["seconds"], rows["nanoseconds"] = np.divmod(stamps, NANOSECONDS)
    rows["length"], rows["name"] = len(name), name
    rows["pose"][:, :2] = poses[:, :2]
    rows["pose"][:, 5], rows["pose"][:, 6] = np.sin(0.5 * poses[:, 2]), np.cos(0.5 * poses[:, 2])
    return rows.tobytes()
