"""MRPT rawlogs, from bytes built here field by field."""

import gzip
import struct

import numpy as np
import pytest

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.sensors import Odometry, Scan

TICKS_1970 = 116_444_736_000_000_000


def obj(name, version, *fields):
    name = name.encode()
    return bytes([0x80 | len(name)]) + name + bytes([version]) + b"".join(fields) + b"\x88"


def pack(code, *values):
    return struct.pack("<" + code, *values)


def text(string):
    return pack("I", len(string)) + string.encode()


def pose_2d(x, y, phi):
    return obj("CPose2D", 1, pack("3d", x, y, phi))


def matrix_pose(rotation=((1, 0, 0), (0, 1, 0), (0, 0, 1)), translation=(0, 0, 0)):
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = rotation, translation
    return transform


def pose_3d(transform, version=1):
    if version == 0:
        return obj("CPose3D", 0, obj("CMatrixF", 0, pack("2I", 4, 4), transform.astype("<f4").tobytes()))
    if version == 1:
        return obj("CPose3D", 1, obj("CMatrixD", 0, pack("2I", 4, 4), transform.astype("<f8").tobytes()))
    return obj("CPose3D", 3, transform[:3, 3].astype("<f8").tobytes(), transform[:3, :3].astype("<f8").tobytes())


def movement(increment, version=6, method=0):
    if method == 0:
        what = pose_2d(*increment) + pack("i6f", 0, *[0.01] * 6) + pack("i", 300)
        what += pack("4f", *[0.1] * 4) + (pack("2f", 0, 0) if version >= 5 else b"")
    else:
        what = obj("CPosePDFGaussian", 1, pose_2d(*increment), pack("6f", *[0.01] * 6))
    speeds = pack("?2f?2i", False, 0, 0, False, 0, 0) if version < 7 else pack("?3d?", True, 1, 0, 0, False)
    return obj("CActionRobotMovement2D", version, pack("i", method), what, speeds, pack("Q", 0) if version > 5 else b"")


def actions(*items):
    return obj("CActionCollection", 0, pack("I", len(items)), *items)


def frame(*items):
    return obj("CSensoryFrame", 2, pack("I", len(items)), *items)


def scan(ranges, seconds=1.0, pose=None, version=6, valid=None, right_to_left=True, name="CObservation2DRangeScan"):
    valid = [r < 30.0 for r in ranges] if valid is None else valid
    fields = [pack("f?f", 2.0, right_to_left, 30.0), pose or pose_3d(matrix_pose())]
    fields += [obj("CMatrixF", 0, pack("2I", 0, 0))] if version < 6 else []
    fields += [pack("I", len(ranges)), np.array(ranges, "<f4").tobytes(), bytes(map(int, valid)), pack("f", 0.01)]
    fields += [pack("Q", TICKS_1970 + round(seconds * 1e7)), pack("f", 0.0)]
    fields += [text("FRONT"), pack("d", 0.0)] if version >= 5 else []
    fields += [pack("?", True), pack(f"{len(ranges)}i", *ranges.__len__() * [7])] if version >= 7 else []
    fields += [pack("f", 0.25)] if version >= 8 else []
    return obj(name, version, *fields)


def odometry(pose, seconds, version=2):
    fields = [pose_2d(*pose), text("ODO"), pack("Q", TICKS_1970 + round(seconds * 1e7))]
    fields += {
        0: [],
        1: [pack("?2i?2f", True, 5, 6, True, 0.1, 0.2)],
        2: [pack("?", False), pack("?3d", True, 1, 0, 0)],
    }[version]
    return obj("CObservationOdometry", version, *fields)


def open_bytes(tmp_path, *objects, compress=True):
    path = tmp_path / "drive.rawlog"
    content = b"".join(objects)
    path.write_bytes(gzip.compress(content) if compress else content)
    return open_log(path)


def measurements(log, kind):
    return [record.measurement for record in log.records() if isinstance(record.measurement, kind)]


@pytest.mark.parametrize("compress", [True, False])
@pytest.mark.parametrize("version", [4, 5, 6, 7])
def test_increments_of_actions_add_up_to_the_odometry_of_the_next_scan(tmp_path, compress, version):
    steps = [(1.0, 0.0, 0.5), (0.5, 0.25, -0.25)]
    log = open_bytes(
        tmp_path,
        frame(scan([1.0, 2.0], 1.0)),
        *(actions(movement(step, version)) + frame(scan([1.0, 2.0], 2.0 + k)) for k, step in enumerate(steps)),
        compress=compress,
    )
    expected = [np.zeros(3), np.array(steps[0]), se2.compose(steps[0], steps[1])]
    for reading, pose in zip(measurements(log, Odometry), expected, strict=True):
        assert reading.pose == pytest.approx(pose)
    pairs = list(log.records())
    assert [record.source_stamp for record in pairs] == [k * 10**9 for k in (1, 1, 2, 2, 3, 3)]
    assert [isinstance(record.measurement, Odometry) for record in pairs] == [True, False] * 3
    assert all(a.measurement.stamp == b.measurement.stamp for a, b in zip(pairs[::2], pairs[1::2], strict=True))


def test_a_second_scan_of_a_frame_has_no_odometry_of_its_own(tmp_path):
    log = open_bytes(tmp_path, actions(movement((1, 0, 0))), frame(scan([1.0, 2.0], 1.0), scan([3.0, 4.0], 1.1)))
    assert [type(record.measurement) for record in log.records()] == [Odometry, Scan, Scan]


def test_movement_by_odometry_is_preferred_to_movement_by_scan_matching(tmp_path):
    both = actions(movement((9, 9, 0), method=1), movement((1, 0, 0)))
    log = open_bytes(
        tmp_path, both, frame(scan([1.0, 2.0], 1.0)), actions(movement((2, 0, 0), method=1)), frame(scan([1.0], 2.0))
    )
    assert [reading.pose.tolist() for reading in measurements(log, Odometry)] == [[1, 0, 0], [3, 0, 0]]


@pytest.mark.parametrize("version", [0, 1, 2])
def test_absolute_odometry_between_bare_observations_is_used(tmp_path, version):
    log = open_bytes(
        tmp_path, odometry((1, 2, 0.5), 1.0, version), scan([1.0, 2.0], 1.5), odometry((2, 2, 0.5), 2.0, version)
    )
    records = list(log.records())
    assert [record.source_stamp for record in records] == [10**9, 1_500_000_000, 2 * 10**9]
    assert records[0].measurement.pose.tolist() == [1, 2, 0.5]


@pytest.mark.parametrize("version", [4, 5, 6, 7, 8])
def test_every_known_version_of_a_scan_has_the_same_geometry(tmp_path, version):
    pose = pose_3d(matrix_pose(((0, -1, 0), (1, 0, 0), (0, 0, 1)), (0.5, 0.25, 0.3)))
    (result,) = measurements(open_bytes(tmp_path, frame(scan([1.0, 2.0, 81.83], 1.0, pose, version))), Scan)
    assert (result.angle_min, result.angle_increment, result.range_max) == (-1.0, 1.0, 30.0)
    assert result.laser_pose == pytest.approx([0.5, 0.25, np.pi / 2])
    assert result.ranges.tolist() == [1.0, 2.0, np.float32(81.83)]
    assert result.valid.tolist() == [True, True, False]
    assert result.time_increment == (0.125 if version == 8 else 0.0)


@pytest.mark.parametrize("version", [0, 1, 3])
def test_a_laser_upside_down_sees_its_points_where_they_are(tmp_path, version):
    """Beam angles 1, 0, -1 rad in the laser's frame, which is rolled by 180 degrees and turned by 0.3 rad."""
    turn = np.array([[np.cos(0.3), -np.sin(0.3), 0], [np.sin(0.3), np.cos(0.3), 0], [0, 0, 1]])
    transform = matrix_pose(turn @ np.diag([1.0, -1.0, -1.0]), (0.5, -0.25, 0.3))
    log = open_bytes(tmp_path, frame(scan([1.0, 2.0, 3.0], 1.0, pose_3d(transform, version), right_to_left=False)))
    (result,) = measurements(log, Scan)
    in_laser = [[r * np.cos(a), r * np.sin(a), 0.0, 1.0] for r, a in zip([1, 2, 3], [1, 0, -1], strict=True)]
    expected = (transform @ np.array(in_laser).T).T[:, :2]
    np.testing.assert_allclose(result.points, expected, atol=1e-6)


def test_beams_flagged_as_faulty_have_no_range(tmp_path):
    (result,) = measurements(open_bytes(tmp_path, frame(scan([1.0, 2.0, 40.0], valid=[1, 0, 0]))), Scan)
    np.testing.assert_array_equal(result.ranges, np.array([1.0, np.nan, 40.0], np.float32))


def test_class_names_with_their_namespace_are_understood(tmp_path):
    assert open_bytes(tmp_path, frame(scan([1.0, 2.0], name="mrpt::obs::CObservation2DRangeScan"))).scan_count == 1


@pytest.mark.parametrize(
    ("objects", "sentence"),
    [
        ([obj("CObservationImage", 4)], "object of class 'CObservationImage', which is not known"),
        ([scan([1.0, 2.0], version=9)], "version 9 of CObservation2DRangeScan"),
        ([frame(scan([1.0, 2.0]))[:-1] + b"\x00"], "damaged inside an object of class CSensoryFrame"),
        ([obj("CActionCollection", 0, pack("I", 0)), frame(scan([1.0]))], "an action without a movement"),
        ([frame(scan([1.0], seconds=-11_644_473_600))], "without a time stamp"),
        ([frame()], "holds no laser scan"),
        ([obj("CPosePDFGaussian", 2, frame())], "one object lies where another belongs"),
        ([frame(scan([1.0], pose=pose_3d(matrix_pose(((0, 0, 1), (0, 1, 0), (-1, 0, 0))))))], "tilted by 90 degrees"),
    ],
)
def test_what_cannot_be_used_is_one_sentence(tmp_path, objects, sentence):
    with pytest.raises(HmtSlamError, match=sentence):
        open_bytes(tmp_path, *objects)


@pytest.mark.parametrize("compress", [True, False])
@pytest.mark.parametrize("share", [0.2, 0.55, 0.98])
def test_a_truncated_rawlog_is_refused_on_opening(tmp_path, compress, share):
    content = b"".join(actions(movement((1, 0, 0))) + frame(scan(list(range(1, 30)), k)) for k in range(1, 9))
    content = gzip.compress(content) if compress else content
    path = tmp_path / "drive.rawlog"
    path.write_bytes(content[: int(len(content) * share)])
    with pytest.raises(HmtSlamError, match="truncated"):
        open_log(path)
