"""rosbag2 recordings as other programs make them: topics, transforms, odd scans, damage."""

from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs import bag_files
from hmt_slam_ros.logs.ros_types import LASER_SCAN, ODOMETRY, TRANSFORMS, typestore
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.sensors import Odometry, Scan

BUNDLED = Path(__file__).resolve().parent.parent / "data" / "malaga_one_loop"
INF, NAN = np.inf, np.nan


def message(kind, **fields):
    return typestore().types[kind](**fields)


def header(stamp, frame):
    time = message("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
    return message("std_msgs/msg/Header", stamp=time, frame_id=frame)


def vector(kind, xyz):
    return message(f"geometry_msgs/msg/{kind}", **dict(zip("xyz", map(float, xyz), strict=True)))


def quaternion(xyzw):
    return message("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, xyzw), strict=True)))


def yaw(theta):
    return (0.0, 0.0, np.sin(theta / 2), np.cos(theta / 2))


def scan(stamp, ranges=(1.0, 2.0, 3.0), frame="laser"):
    return message(
        LASER_SCAN,
        header=header(stamp, frame),
        angle_min=-1.0,
        angle_max=1.0,
        angle_increment=1.0 if len(ranges) < 10 else 0.005,
        time_increment=0.25,
        scan_time=0.5,
        range_min=0.125,
        range_max=20.0,
        ranges=np.array(ranges, dtype=np.float32),
        intensities=np.zeros(0, dtype=np.float32),
    )


def odom(stamp, x=0.0, y=0.0, theta=0.0, child="base_link"):
    pose = message("geometry_msgs/msg/Pose", position=vector("Point", (x, y, 0)), orientation=quaternion(yaw(theta)))
    zero = vector("Vector3", (0, 0, 0))
    twist = message("geometry_msgs/msg/Twist", linear=zero, angular=zero)
    return message(
        ODOMETRY,
        header=header(stamp, "odom"),
        child_frame_id=child,
        pose=message("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
        twist=message("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
    )


def tf(stamp, *joints):
    transforms = [
        message(
            "geometry_msgs/msg/TransformStamped",
            header=header(stamp, parent),
            child_frame_id=child,
            transform=message(
                "geometry_msgs/msg/Transform", translation=vector("Vector3", xyz), rotation=quaternion(xyzw)
            ),
        )
        for parent, child, xyz, xyzw in joints
    ]
    return message(TRANSFORMS, transforms=transforms)


MOUNT = ("base_link", "laser", (0.5, 0.25, 1.0), yaw(0.5))


def bag_of(folder, messages, storage=StoragePlugin.MCAP):
    """A bag with (topic, bag time, message) in the order given."""
    with Writer(folder, version=9, storage_plugin=storage) as writer:
        connections = {}
        for topic, time, content in messages:
            kind = content.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=typestore())
            writer.write(connections[topic], time, typestore().serialize_cdr(content, kind))
    return folder


def usual(stamps=(10, 20, 30), scan_topic="/scan", odom_topic="/odom"):
    yield "/tf_static", 0, tf(0, MOUNT)
    for k in stamps:
        yield odom_topic, k, odom(k, float(k % 10**6), 1.0, 0.5)
        yield scan_topic, k, scan(k)


@pytest.mark.parametrize("storage", list(StoragePlugin))
@pytest.mark.parametrize("single_file", [False, True])
def test_folder_and_single_file_of_both_storages_are_read_alike(tmp_path, storage, single_file):
    path = bag_of(tmp_path / "bag", usual(), storage)
    if single_file:
        path = next(file for file in path.iterdir() if file.suffix in {".mcap", ".db3"})
    log = open_log(path)
    records = list(log.records())
    assert (log.name, log.scan_count, log.duration) == ("bag", 3, 2e-8)
    assert [type(record.measurement) for record in records] == [Odometry, Scan] * 3
    assert [record.source_stamp for record in records] == [10, 10, 20, 20, 30, 30]
    first, second = records[0].measurement, records[1].measurement
    assert first.pose == pytest.approx([10.0, 1.0, 0.5], abs=1e-15)
    assert (second.angle_min, second.angle_increment, second.time_increment) == (-1.0, 1.0, 0.25)
    assert (second.range_min, second.range_max) == (0.125, 20.0)
    assert second.laser_pose == pytest.approx([0.5, 0.25, 0.5], abs=1e-15)


def test_odometry_comes_before_the_scan_of_the_same_bag_time(tmp_path):
    path = bag_of(tmp_path / "bag", [("/tf_static", 0, tf(0, MOUNT)), ("/scan", 9, scan(5)), ("/odom", 9, odom(5))])
    assert [type(record.measurement) for record in open_log(path).records()] == [Odometry, Scan]


def test_headers_that_jump_back_keep_the_order_of_the_bag_and_their_stamps(tmp_path):
    stamps = [50_000, 20_000, 60_000]
    messages = [("/tf_static", 0, tf(0, MOUNT)), ("/odom", 1, odom(10_000))]
    messages += [("/scan", 100 + k, scan(stamp)) for k, stamp in enumerate(stamps)]
    records = list(open_log(bag_of(tmp_path / "bag", messages)).records())
    assert [record.source_stamp for record in records] == [10_000, *stamps]
    assert [record.measurement.stamp for record in records] == [10_000, 50_000, 51_000, 60_000]


def test_nan_inf_zero_and_differing_beam_counts_are_kept(tmp_path):
    sweeps = [[0.0, NAN, INF, -INF, 2.5], [1.0], [], list(np.linspace(0, 30, 897))]
    messages = [("/tf_static", 0, tf(0, MOUNT)), ("/odom", 0, odom(0))]
    messages += [("/scan", k, scan(k, sweep)) for k, sweep in enumerate(sweeps, start=1)]
    scans = [r.measurement for r in open_log(bag_of(tmp_path / "bag", messages)).records() if r.source_stamp]
    for measured, sweep in zip(scans, sweeps, strict=True):
        np.testing.assert_array_equal(measured.ranges, np.array(sweep, dtype=np.float32))


def test_the_only_topic_of_its_type_serves_where_the_default_is_missing(tmp_path):
    path = bag_of(tmp_path / "bag", usual(scan_topic="/front/scan", odom_topic="/wheels"))
    assert open_log(path).scan_count == 3


@pytest.mark.parametrize(
    ("topics", "wanted", "sentence"),
    [
        (["/a", "/b"], {}, "has no topic /scan: choose one of /a, /b"),
        (["/a"], {"scan_topics": "/front"}, "has no topic /front: choose one of /a"),
        (["/scan"], {"scan_topics": "/odom"}, "topic /odom of bag is of type nav_msgs/msg/Odometry"),
        ([], {}, "has no topic of type sensor_msgs/msg/LaserScan"),
        (["/scan"], {"odom_topic": "/wheels"}, "has no topic /wheels: choose one of /odom"),
    ],
)
def test_a_topic_that_is_missing_is_one_sentence(tmp_path, topics, wanted, sentence):
    messages = [("/tf_static", 0, tf(0, MOUNT)), ("/odom", 1, odom(1))]
    path = bag_of(tmp_path / "bag", messages + [(topic, 2, scan(2)) for topic in topics])
    with pytest.raises(HmtSlamError, match=sentence):
        open_log(path, **wanted)


def test_without_an_odometry_topic_the_transform_from_odom_serves(tmp_path):
    def messages():
        yield "/tf_static", 0, tf(0, ("base", "laser", (0.5, 0, 0), yaw(0.0)))
        for k in (10_000, 20_000):
            yield "/tf", k, tf(k, ("map", "odom", (9, 9, 9), yaw(1.0)), ("odom", "base", (k, 2.0, 0), yaw(0.25)))
            yield "/scan", k + 5, scan(k + 5)

    records = list(open_log(bag_of(tmp_path / "bag", messages())).records())
    assert [record.source_stamp for record in records] == [10_000, 10_005, 20_000, 20_005]
    assert records[2].measurement.pose == pytest.approx([20_000.0, 2.0, 0.25])


@pytest.mark.parametrize("others", [[], [("/tf", 1, tf(1, ("map", "base_link", (0, 0, 0), yaw(0.0))))]])
def test_a_bag_without_any_odometry_is_one_sentence(tmp_path, others):
    path = bag_of(tmp_path / "bag", [("/tf_static", 0, tf(0, MOUNT)), ("/scan", 2, scan(2)), *others])
    with pytest.raises(HmtSlamError, match="record the wheel odometry"):
        open_log(path)


def test_the_lasers_pose_is_found_along_a_chain_and_up_a_branch(tmp_path):
    joints = [
        ("base_footprint", "base_link", (0, 0, 0.5), yaw(0.0)),
        ("base_link", "mast", (1.0, 0, 0), yaw(np.pi / 2)),
        ("mast", "/laser", (2.0, 0, 0), yaw(0.0)),
        ("base_footprint", "wheel", (7, 7, 7), yaw(0.0)),
    ]
    messages = [("/odom", 1, odom(1, child="/base_link")), ("/scan", 2, scan(2))]
    messages += [("/tf_static", k, tf(0, joint)) for k, joint in enumerate(joints, start=3)]
    (_, record) = open_log(bag_of(tmp_path / "bag", messages)).records()
    assert record.measurement.laser_pose == pytest.approx([1.0, 2.0, np.pi / 2])


def test_a_laser_joint_on_the_moving_transforms_serves_where_none_is_static(tmp_path):
    messages = [
        ("/odom", 1, odom(1)),
        ("/scan", 2, scan(2)),
        ("/tf", 3, tf(3, ("odom", "base_link", (1, 2, 0), yaw(2.0)))),
    ]
    messages += [("/tf", 4, tf(4, MOUNT))]
    (_, record) = open_log(bag_of(tmp_path / "bag", messages)).records()
    assert record.measurement.laser_pose == pytest.approx([0.5, 0.25, 0.5])


def test_a_laser_upside_down_sees_its_points_where_they_are(tmp_path):
    roll = (1.0, 0.0, 0.0, 0.0)
    messages = [("/tf_static", 0, tf(0, ("base_link", "laser", (0.5, 0, 0), roll)))]
    messages += [("/odom", 1, odom(1)), ("/scan", 2, scan(2))]
    (_, record) = open_log(bag_of(tmp_path / "bag", messages)).records()
    angles = np.array([-1.0, 0.0, 1.0])
    expected = np.array([0.5, 0.0]) + np.array([1, 2, 3])[:, None] * np.column_stack((np.cos(angles), -np.sin(angles)))
    np.testing.assert_allclose(record.measurement.points, expected, atol=1e-12)


def test_scans_in_the_robots_own_frame_need_no_transform(tmp_path):
    messages = [("/odom", 1, odom(1)), ("/scan", 2, scan(2, frame="base_link"))]
    (_, record) = open_log(bag_of(tmp_path / "bag", messages)).records()
    assert record.measurement.laser_pose.tolist() == [0, 0, 0]


def test_a_missing_transform_is_one_sentence(tmp_path):
    path = bag_of(tmp_path / "bag", [("/odom", 1, odom(1)), ("/scan", 2, scan(2))])
    with pytest.raises(
        HmtSlamError, match="no transform from 'base_link' to the scans' frame 'laser': record /tf_static"
    ):
        open_log(path)


def test_a_part_of_a_bag_has_the_stamps_of_the_whole(tmp_path):
    seconds = [k * 10**9 for k in range(10)]
    path = bag_of(tmp_path / "bag", usual(seconds))
    part = open_log(path, start=3.0, duration=2.0)
    assert (part.scan_count, part.duration) == (3, 2.0)
    assert [r.measurement.stamp for r in part.records()] == [s * 10**9 for s in (3, 3, 4, 4, 5, 5)]
    with pytest.raises(HmtSlamError, match="chosen by start and duration"):
        open_log(path, start=100.0)


@pytest.mark.parametrize("storage", list(StoragePlugin))
@pytest.mark.parametrize("share", [0.001, 0.3, 0.7, 0.99])
@pytest.mark.parametrize("single_file", [False, True])
def test_a_truncated_bag_is_refused_on_opening(tmp_path, storage, share, single_file):
    path = bag_of(tmp_path / "bag", usual(range(1, 400)), storage)
    file = next(file for file in path.iterdir() if file.suffix in {".mcap", ".db3"})
    content = file.read_bytes()
    file.write_bytes(content[: max(16, int(len(content) * share))])
    with pytest.raises(HmtSlamError, match="truncated or damaged"):
        open_log(file if single_file else path)


def test_what_is_no_log_is_one_sentence(tmp_path):
    cases = {
        "missing.bag": (None, "cannot be read"),
        "empty.clf": (b"", "is empty"),
        "picture.png": (b"\x89PNG\r\n" + bytes(100), "of no known format"),
        "notes.txt": (b"nothing of interest\n" * 10, "of no known format"),
        "renamed.bag": (b"\x89MCAP0\r\n" + bytes(100), "rename it to renamed.mcap"),
    }
    for name, (content, sentence) in cases.items():
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(HmtSlamError, match=sentence) as caught:
            open_log(tmp_path / name)
        assert "\n" not in str(caught.value)
        assert "\n" not in str(caught.value)
    with pytest.raises(HmtSlamError, match=r"without a bag's metadata\.yaml"):
        open_log(tmp_path)


def test_a_bag_of_which_nobody_reads_the_rest_is_closed_without_a_fault(monkeypatch):
    def fail(_reader):
        raise OSError("the disk is gone")

    messages = bag_files._read_file(BUNDLED, {connection.topic for connection in bag_files._connections(BUNDLED)})
    next(messages)
    monkeypatch.setattr(bag_files.Reader, "close", fail)
    messages.close()
