"""Simulated drives as logs: by name, the same for one seed, as bags with their truth, and through one's own worlds."""

import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml
from preloaded import hmt_slam
from rosbags.rosbag2 import Reader
from test_logs_convert import assert_same_log

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.evaluation import read_odometry_poses, read_true_poses, read_tum, true_relations
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.ros_types import deserialize
from hmt_slam_ros.logs.writer import write_bag
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.simulation import FAMILIES, SimulatedLog
from hmt_slam_ros.simulation.building import outline_of_cells
from hmt_slam_ros.simulation.worlds import read_world

MALAGA = Path(__file__).parents[1] / "data" / "malaga_one_loop"


def content(log, count=400):
    """The bytes of the first records."""
    parts = []
    for _, record in zip(range(count), log.records(), strict=False):
        measurement = record.measurement
        values = measurement.ranges if isinstance(measurement, Scan) else measurement.pose
        parts.append((record.source_stamp, measurement.stamp, values.tobytes(), record.true_pose.tobytes()))
    return parts


@pytest.mark.parametrize("family", FAMILIES)
def test_one_seed_gives_the_same_log_bit_for_bit_and_another_seed_another(family):
    one, again, other = (open_log(f"sim:{family},seed={seed},people=2") for seed in (3, 3, 4))
    assert content(one) == content(again) == content(one)
    assert content(one) != content(other)
    assert (one.name, one.scan_count) == (f"{family},seed=3,people=2", again.scan_count)


def test_another_process_makes_the_same_log():
    code = (
        "import hashlib; from test_simulation_log import content; from hmt_slam_ros.open_log import open_log;"
        "print(hashlib.sha256(repr(content(open_log('sim:busy,seed=5'))).encode()).hexdigest())"
    )
    command = [sys.executable, "-c", code]
    runs = [
        subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True).stdout
        for _ in range(2)
    ]
    assert runs[0] == runs[1] != ""


def test_records_follow_the_rules_of_a_log():
    log = open_log("sim:ring,readings=3,rate=4,laps=1")
    records = list(log.records())
    scans = [record.measurement.stamp for record in records if isinstance(record.measurement, Scan)]
    readings = [record.measurement.stamp for record in records if isinstance(record.measurement, Odometry)]
    assert (len(scans), len(readings)) == (log.scan_count, 3 * (log.scan_count - 1) + 1)
    assert set(np.diff(scans)) == {250_000_000}
    assert 83_333_333 <= min(np.diff(readings)) <= max(np.diff(readings)) <= 83_333_334
    assert log.duration == pytest.approx((records[-1].source_stamp - records[0].source_stamp) / 1e9)
    for before, record in pairwise(records):
        if isinstance(record.measurement, Scan):
            assert isinstance(before.measurement, Odometry)
            assert before.measurement.stamp == record.measurement.stamp == record.source_stamp


def test_a_part_of_a_log_is_that_part_of_the_whole():
    whole, part = open_log("sim:office,seed=2"), open_log("sim:office,seed=2", start=10.0, duration=4.0)
    assert part.scan_count == 21
    assert part.duration == pytest.approx(4.0)
    assert content(part) == content(whole)[10 * 15 : 10 * 15 + 4 * 15 + 2]


def test_the_truth_in_a_bag_is_a_topic_that_other_tools_can_read(tmp_path):
    write_bag(open_log("sim:ring", duration=2.0), tmp_path / "bag")
    with Reader(tmp_path / "bag") as reader:
        (topic,) = [connection for connection in reader.connections if connection.topic == "/ground_truth"]
        messages = [deserialize(content, topic.msgtype) for _, _, content in reader.messages([topic])]
    assert topic.msgtype == "geometry_msgs/msg/PoseStamped"
    assert {message.header.frame_id for message in messages} == {"world"}
    stamps = [message.header.stamp.sec * 10**9 + message.header.stamp.nanosec for message in messages]
    # Ten odometry readings a second, of which every second has a scan's stamp.
    assert np.diff(stamps).tolist() == [100_000_000] * 20


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_bag_of_a_simulated_log_is_the_same_log_and_knows_the_truth(tmp_path, storage):
    log = open_log("sim:busy,seed=1,sweep=0.05,forward=0.2", duration=20.0)
    write_bag(log, tmp_path / "bag", storage=storage)
    bag = open_log(tmp_path / "bag")
    assert_same_log(log, bag)
    for one, other in zip(log.records(), bag.records(), strict=True):
        np.testing.assert_allclose(one.true_pose, other.true_pose, rtol=0.0, atol=1e-14)


def test_a_bag_of_a_real_robot_knows_no_truth():
    log = open_log(MALAGA)
    assert all(record.true_pose is None for record in log.records())
    with pytest.raises(HmtSlamError, match="has no true poses"):
        read_true_poses(log)


def test_truth_is_known_at_any_time_and_for_places():
    log = open_log("sim:ring,odometry=0,seed=2")
    assert isinstance(log, SimulatedLog)
    truth, odometry = read_true_poses(log), read_odometry_poses(log)
    np.testing.assert_allclose(log.true_poses(truth.stamps), truth.poses, atol=1e-12)
    moved = se2.between(truth.poses[0], truth.poses)
    np.testing.assert_allclose(moved, odometry.poses[:: log.scenario.settings.readings], atol=1e-9)
    same = log.same_place(truth.stamps[::20], truth.stamps[::20], 2.0)
    near = np.hypot(*(truth.poses[::20, None, :2] - truth.poses[None, ::20, :2]).transpose(2, 0, 1)) <= 2.0
    assert np.array_equal(same, same.T)
    assert same.diagonal().all()
    # In the same corridor whoever is near is in sight; the second lap is in the places of the first.
    assert np.array_equal(same, near)
    half = len(same) // 2
    assert same[half + 3 :, : half - 3].any(axis=1).mean() > 0.9


def test_true_relations_reach_to_the_next_meter_the_tenth_and_the_lap_before():
    truth = read_true_poses(open_log("sim:ring,seed=1"))
    relations = true_relations(truth)
    long = np.abs(relations.ends - relations.starts) > 60_000_000_000
    # Two laps of 55 m: all of the second is near the first.
    assert long.sum() > 50
    assert np.hypot(*relations.poses[long, :2].T).max() < 3.0
    short = np.hypot(*relations.poses[~long, :2].T)
    assert short.size > 200
    index = {stamp: k for k, stamp in enumerate(truth.stamps.tolist())}
    for k in range(0, len(relations.starts), 17):
        a, b = truth.poses[index[relations.starts[k]]], truth.poses[index[relations.ends[k]]]
        np.testing.assert_allclose(se2.compose(a, relations.poses[k]), b, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("sim:", "no simulated world ''"),
        ("sim:castle", "choose one of office, busy"),
        ("sim:office,seeds=3", "did you mean seed"),
        ("sim:office,moat=3", "see docs/guides/simulation_settings.md"),
        ("sim:office,people=-1", "people = -1 is out of range"),
        ("sim:office,people=some", "people = 'some' is not a whole number"),
        ("sim:office,people", "write name=value"),
        ("sim:office,radius=1.5", "radius is 1.5 m"),
        ("sim:nowhere.yaml", "nowhere.yaml cannot be read"),
    ],
)
def test_what_cannot_be_simulated_is_refused_in_one_sentence(name, words):
    with pytest.raises(HmtSlamError, match=words) as refusal:
        open_log(name)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("world", "words"),
    [
        ({"wals": []}, "unknown key 'wals'"),
        ({"walls": [[0, 0, 1]], "route": [[0, 0], [1, 1]]}, "rows of 4 numbers"),
        ({"walls": [["a", 0, 1, 1]], "route": [[0, 0], [1, 1]]}, "rows of 4 numbers"),
        ({"walls": 3, "route": [[0, 0], [1, 1]]}, "rows of 4 numbers"),
        ({"walls": [[0, 0, 1, 1]]}, "two way-points"),
        ({"route": [[0, 0], [1, 1]]}, "no walls"),
        ({"walls": [[0, 0, 1, 1]], "route": [[5, 5], [6, 6]], "settings": 3}, "settings"),
        ({"walls": [[0, 0, 1, 1]], "route": [[5, 5], [6, 6]], "settings": {"rnge": 3}}, "did you mean range"),
        ({"image": "none.pgm", "resolution": 0.05, "route": [[5, 5], [6, 6]]}, "none.pgm cannot be read"),
        ({"image": "none.pgm", "route": [[5, 5], [6, 6]]}, "lacks resolution"),
        ([1, 2], "holds no keys"),
    ],
)
def test_a_world_file_that_makes_no_sense_is_refused(tmp_path, world, words):
    (tmp_path / "world.yaml").write_text(yaml.safe_dump(world))
    with pytest.raises(HmtSlamError, match=words):
        open_log(f"sim:{tmp_path / 'world.yaml'}")


@pytest.mark.parametrize("suffix", ["pgm", "png"])
def test_an_occupancy_image_becomes_walls_where_its_pixels_are_black(tmp_path, suffix):
    pixels = np.full((40, 60), 254, dtype=np.uint8)
    pixels[[0, -1]], pixels[:, [0, -1]] = 0, 0
    pixels[10:20, 30:32] = 0
    pixels[30:35, 5:9] = 205  # unknown, which is no wall
    if suffix == "pgm":
        (tmp_path / "map.pgm").write_bytes(b"P5\n60 40\n255\n" + pixels.tobytes())
    else:
        from matplotlib.image import imsave  # noqa: PLC0415

        imsave(tmp_path / "map.png", pixels, cmap="gray", vmin=0, vmax=255)
    world = {
        "image": f"map.{suffix}",
        "resolution": 0.1,
        "origin": [-1.0, -2.0, 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.25,
        "route": [[0.0, 0.55], [1.0, 0.55]],
    }
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(world))
    building, _ = read_world(tmp_path / "map.yaml")
    occupied = pixels[::-1] == 0
    expected = outline_of_cells(occupied, 0.1 * np.arange(61.0) - 1.0, 0.1 * np.arange(41.0) - 2.0)
    np.testing.assert_allclose(building.walls, expected, atol=1e-12)
    scan = open_log(f"sim:{tmp_path / 'map.yaml'},range_noise=0,dropout=0").scenario.scan(0)
    # From (0, 0.55) ahead to the pillar, which is in the upper half of the image,.
    assert scan.ranges[180] == pytest.approx(2.0, abs=1e-6)


def test_the_map_that_a_run_leaves_can_be_driven_through(tmp_path):
    hmt_slam("map", MALAGA, "--out", tmp_path / "out", "--duration", 10, check=True)
    path = read_tum(tmp_path / "out" / "trajectory.tum").poses
    world = yaml.safe_load((tmp_path / "out" / "map.yaml").read_text())
    # The robot stands for a while first, and millimeters of a route would turn it anywhere.
    way = path[np.hypot(path[:, 0], path[:, 1]) > 0.05]
    world["route"] = way[:: len(way) // 6, :2].tolist()
    (tmp_path / "out" / "world.yaml").write_text(yaml.safe_dump(world))
    log = open_log(f"sim:{tmp_path / 'out' / 'world.yaml'},radius=0.1")
    assert log.scan_count > 20
    assert log.scenario.scan(0).valid.mean() > 0.5


def test_simulate_writes_bag_and_truth_and_evaluate_takes_either(tmp_path):
    words = ["simulate", "ring", "--seed", "3", "--set", "laps=1", "--duration", "20", "--out", tmp_path / "bag"]
    sent = hmt_slam(*words, check=True).stdout
    assert "101 scans, 20.0 s" in sent
    assert "sim:ring,laps=1,seed=3" in sent
    log = open_log("sim:ring,laps=1,seed=3", duration=20.0)
    truth = read_tum(tmp_path / "bag" / "ground_truth.tum")
    assert np.array_equal(truth.stamps, read_true_poses(log).stamps)
    np.testing.assert_allclose(truth.poses, read_true_poses(open_log(tmp_path / "bag")).poses, atol=1e-8)
    (tmp_path / "trajectory.tum").write_text((tmp_path / "bag" / "ground_truth.tum").read_text())
    for source in (tmp_path / "bag", "sim:ring,laps=1,seed=3"):
        assert "0.000 +- 0.000" in hmt_slam("evaluate", tmp_path, "--truth", source, check=True).stdout
