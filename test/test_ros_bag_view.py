"""The live page of a bag that cannot be shown, without other nodes."""

import json

import pytest

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

import preloaded
from rosbags.rosbag2 import StoragePlugin, Writer
from test_logs_bag import message

from hmt_slam_ros.cli.main import main
from hmt_slam_ros.logs.bag_files import BagMessage
from hmt_slam_ros.logs.ros_types import typestore
from hmt_slam_ros.ros.bag_view_node import batches

S = 10**9
STRING = "std_msgs/msg/String"
HYPOTHESES = {"document": "hypotheses", "version": 99}


def bag_of(folder, *topics):
    """A bag with a document on each topic."""
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for k, topic in enumerate(topics):
            connection = writer.add_connection(topic, STRING, typestore=typestore())
            content = typestore().serialize_cdr(message(STRING, data=json.dumps(HYPOTHESES)), STRING)
            writer.write(connection, k * S, content)
    return folder


@pytest.mark.parametrize(
    ("topics", "arguments", "sentence"),
    [
        (("/chatter",), (), "has no topics of the nodes, such as /hmt/hypotheses: record the run with"),
        (("/a/hmt/pose", "/b/hmt/pose"), (), "has runs in 2 namespaces: choose one by --namespace, of /a, /b"),
        (("/a/hmt/pose",), ("--namespace", "c"), "has no run in the namespace /c: choose one by --namespace, of /a"),
    ],
)
def test_a_bag_without_the_run_that_is_wanted_is_refused(tmp_path, capsys, topics, arguments, sentence):
    assert main(["view", str(bag_of(tmp_path / "bag", *topics)), *arguments]) == 2
    assert sentence in capsys.readouterr().err


def test_what_is_no_whole_bag_is_refused(tmp_path, capsys):
    bag = bag_of(tmp_path / "bag", "/hmt/hypotheses")
    (file,) = bag.glob("*.mcap")
    file.write_bytes(file.read_bytes()[:-40])
    other = tmp_path / "notes.txt"
    other.write_text("no bag")
    for path, sentence in ((bag, "is truncated or damaged"), (other, "is no rosbag2: give a bag folder")):
        assert main(["view", str(path)]) == 2
        assert sentence in capsys.readouterr().err


def test_a_bag_of_another_version_is_refused(tmp_path):
    bag = bag_of(tmp_path / "bag", "/robot1/hmt/hypotheses")
    answer = preloaded.hmt_slam("view", bag, "--port", 0, timeout=60.0)
    assert answer.returncode == 2
    assert "is of another version of hmt_slam_ros, a hypotheses document has version 99" in answer.stderr
    assert answer.stderr.count("\n") == 2  # with the address of the page


def test_time_goes_on_between_messages_but_not_for_long():
    times = (100 * S, 100 * S + 1, 101 * S, 5000 * S, 5001 * S)
    steps = list(batches(BagMessage(time, "/pose", "", b"") for time in times))
    assert [message.bag_time for _, batch in steps for message in batch] == list(times)
    assert all(message.bag_time < end for end, batch in steps for message in batch)
    assert len(steps) == 5 + 1 + (5 * 60 + 1) + 5 + 1
    assert list(batches([])) == []
