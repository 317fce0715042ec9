"""Logs that are damaged, hostile, or hold numbers that cannot be right."""

import gzip
import lzma
import os
import struct
from pathlib import Path
from zlib import crc32

import numpy as np
import pytest
from test_logs_bag import MOUNT, bag_of, odom, quaternion, scan, tf, usual

from hmt_slam_ros import open_log as opening
from hmt_slam_ros.cli.main import main
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs.mcap_file import check_mcap
from hmt_slam_ros.logs.records import describe_left_out
from hmt_slam_ros.logs.ros_types import deserialize
from hmt_slam_ros.logs.writer import write_bag
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.sensors import Odometry, Scan

MALAGA = Path(__file__).parent.parent / "data" / "malaga_one_loop"
FLASER = "FLASER 3 1 2 3 {pose} {pose} {stamp} host 0\n"


def carmen(path, *lines):
    path.write_text("".join(lines))
    return path


def kinds_and_stamps(log):
    return [(type(record.measurement), record.source_stamp) for record in log.records()]


def measurements_with(change):
    """A bag's messages of which the second scan and the second reading are changed."""
    for topic, stamp, content in usual():
        if stamp == 20:
            change(content)
        yield topic, stamp, content


def turn_nan(content):
    if hasattr(content, "ranges"):
        object.__setattr__(content, "angle_min", np.nan)
    else:
        object.__setattr__(content.pose.pose, "orientation", quaternion((0.0, 0.0, 0.0, 0.5)))


@pytest.mark.parametrize("field", ["angle_increment", "range_max", "angle_min"])
@pytest.mark.parametrize("value", [1e-30, np.nan, np.inf, 1e30])
def test_a_scan_of_a_bag_that_cannot_be_right_is_left_out_and_counted(tmp_path, field, value):
    if field == "range_max" and value in (np.inf, 1e30):
        return  # a laser without a limit

    def change(content):
        if hasattr(content, "ranges"):
            object.__setattr__(content, field, value)

    if (field, value) == ("angle_min", 1e-30):
        return  # almost 0, which is an angle
    log = open_log(bag_of(tmp_path / "bag", measurements_with(change)))
    assert kinds_and_stamps(log) == [(Odometry, 10), (Scan, 10), (Odometry, 20), (Odometry, 30), (Scan, 30)]
    assert (log.scan_count, log.left_out.count) == (2, 1)
    assert f"1 measurements of bag are left out, in the first of them {field} =" in describe_left_out(log)


def test_odometry_of_a_bag_without_a_rotation_is_left_out(tmp_path):
    log = open_log(bag_of(tmp_path / "bag", measurements_with(turn_nan)))
    assert kinds_and_stamps(log) == [(Odometry, 10), (Scan, 10), (Odometry, 30), (Scan, 30)]
    assert log.left_out.count == 2


def test_a_bag_of_which_no_scan_can_be_used_is_refused(tmp_path):
    messages = [("/tf_static", 0, tf(0, MOUNT)), ("/odom", 1, odom(1)), ("/scan", 1, scan(1))]
    turn_nan(messages[2][2])
    with pytest.raises(HmtSlamError, match="holds no laser scan that can be used, in the first of 1"):
        open_log(bag_of(tmp_path / "bag", messages))


def test_convert_and_doctor_say_what_is_left_out(tmp_path, capsys):
    bag = bag_of(tmp_path / "bag", measurements_with(turn_nan))
    assert main(["convert", str(bag), str(tmp_path / "again")]) == 0
    assert capsys.readouterr().err.startswith("hmt_slam convert: 2 measurements of bag are left out")
    assert main(["doctor", str(bag)]) == 1
    assert "measurements: 2 measurements of bag are left out" in capsys.readouterr().out
    assert describe_left_out(open_log(tmp_path / "again")) is None


@pytest.mark.parametrize("cut", [3, 11, 20, 60])
def test_a_damaged_message_is_one_sentence(tmp_path, cut):
    with pytest.raises(HmtSlamError, match="a message of type nav_msgs/msg/Odometry is damaged"):
        deserialize(bytes(cut), "nav_msgs/msg/Odometry")


def test_a_transform_without_a_rotation_is_refused(tmp_path):
    mount = ("base_link", "laser", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))
    messages = [("/tf_static", 0, tf(0, mount)), ("/odom", 1, odom(1)), ("/scan", 1, scan(1))]
    with pytest.raises(HmtSlamError, match="quaternion of norm 1"):
        open_log(bag_of(tmp_path / "bag", messages))


@pytest.mark.parametrize("value", ["nan", "inf", "1e308"])
def test_a_line_of_carmen_with_an_impossible_pose_is_left_out(tmp_path, value):
    lines = [FLASER.format(pose=f"{value if k == 5 else k} 0 0", stamp=k) for k in range(1, 13)]
    log = open_log(carmen(tmp_path / "log.clf", *lines))
    assert (log.scan_count, log.left_out.count) == (11, 1)
    assert 5 * 10**9 not in {record.source_stamp for record in log.records()}


@pytest.mark.parametrize("pack", [gzip.compress, lzma.compress])
def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path, pack, monkeypatch):
    monkeypatch.setattr(opening, "MAX_CONTENT_BYTES", 1_000_000)
    (tmp_path / "bomb").write_bytes(pack(b"\n" * 1_000_001))
    with pytest.raises(HmtSlamError, match="has more than 1000000 bytes of content: give a shorter log"):
        open_log(tmp_path / "bomb")


@pytest.mark.parametrize("pack", [gzip.compress, lzma.compress])
def test_several_streams_are_read_and_damaged_ones_refused(tmp_path, pack):
    line = FLASER.format(pose="1 0 0", stamp=1).encode()
    (tmp_path / "log").write_bytes(pack(line) + pack(line))
    assert open_log(tmp_path / "log").scan_count == 2
    (tmp_path / "log").write_bytes(pack(line * 9)[:-6])
    with pytest.raises(HmtSlamError, match="truncated or damaged"):
        open_log(tmp_path / "log")


def test_a_pipe_is_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "log.clf")
    with pytest.raises(HmtSlamError, match="is no regular file"):
        open_log(tmp_path / "log.clf")


def object_of(name, version, content):
    return bytes([0x80 | len(name)]) + name + bytes([version]) + content + b"\x88"


def test_a_rawlog_that_nests_without_end_is_refused(tmp_path):
    content = b""
    for _ in range(3000):
        content = object_of(b"CSensoryFrame", 2, struct.pack("<I", 1) + content)
    (tmp_path / "log.rawlog").write_bytes(content)
    with pytest.raises(HmtSlamError, match="its objects nest deeper than 16"):
        open_log(tmp_path / "log.rawlog")


@pytest.fixture(scope="module")
def mcap_file(tmp_path_factory):
    """The bytes of an mcap file that the package wrote, and a folder."""
    folder = tmp_path_factory.mktemp("mcap")
    write_bag(open_log(MALAGA, duration=3.0), folder / "bag")
    return (folder / "bag" / "bag.mcap").read_bytes(), folder


def test_the_chunks_that_are_written_have_checksums(mcap_file):
    content, _ = mcap_file
    assert content[8 + 9 :].find(b"zstd") > 0
    chunk = content.index(b"zstd") - 32
    assert struct.unpack_from("<I", content, chunk + 24) != (0,)
    (start,) = struct.unpack_from("<Q", content, len(content) - 28)
    assert struct.unpack_from("<I", content, len(content) - 12) == (crc32(content[start:-12]),)


def test_the_bundled_bag_has_checksums():
    content = (MALAGA / "malaga_one_loop.mcap").read_bytes()
    assert struct.unpack_from("<I", content, content.index(b"zstd") - 8) != (0,)
    (start,) = struct.unpack_from("<Q", content, len(content) - 28)
    assert struct.unpack_from("<I", content, len(content) - 12) == (crc32(content[start:-12]),)


def test_a_flipped_bit_never_changes_a_measurement(mcap_file, tmp_path):
    content, folder = mcap_file
    rng = np.random.default_rng(3)
    truth = digest(folder / "bag" / "bag.mcap")
    for at in rng.integers(len(content), size=60).tolist():
        changed = bytearray(content)
        changed[at] ^= 1 << int(rng.integers(8))
        path = tmp_path / "bag.mcap"
        path.write_bytes(changed)
        try:
            assert digest(path) == truth, at
        except HmtSlamError:
            continue


def digest(path):
    measurements = [record.measurement for record in open_log(path).records()]
    parts = [m.ranges if isinstance(m, Scan) else m.pose for m in measurements]
    return crc32(b"".join(part.tobytes() + str(m.stamp).encode() for part, m in zip(parts, measurements, strict=True)))


def test_a_length_beyond_the_file_is_refused_without_memory(mcap_file, tmp_path):
    content, _ = mcap_file
    for at in (9, content.index(b"zstd") - 40, content.index(b"zstd") - 4, content.index(b"zstd") + 4):
        for length in (2**62, 2**40, 2**31):
            changed = bytearray(content)
            changed[at : at + 8] = struct.pack("<Q", length)
            (tmp_path / "bag.mcap").write_bytes(changed)
            with pytest.raises(HmtSlamError, match="is truncated or damaged"):
                check_mcap(tmp_path / "bag.mcap")
