"""Logs of a robot with two lasers, and bags in which each has a topic of its own."""

from rosbags.rosbag2 import StoragePlugin, Writer

from hmt_slam_ros.logs.bag import read_header
from hmt_slam_ros.logs.bag_files import read_messages, read_topics
from hmt_slam_ros.logs.ros_types import LASER_SCAN, typestore
from hmt_slam_ros.logs.writer import write_bag

FRAMES = {"laser": "/front", "laser_1": "/rear"}
"""{frame of a laser: topic of its scans}."""

TOPICS = "front,rear"


def bag_with_two_topics(log, folder):
    """A bag of the log with the scans of each laser on a topic of its own."""
    write_bag(log, folder / "one_topic")
    types = read_topics(folder / "one_topic")
    with Writer(folder / "two_topics", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        names = [*(topic for topic in types if topic != "/scan"), *FRAMES.values()]
        connections = {
            name: writer.add_connection(name, types.get(name, LASER_SCAN), typestore=typestore()) for name in names
        }
        for message in read_messages(folder / "one_topic", types):
            topic = FRAMES[read_header(message.content).frame] if message.topic == "/scan" else message.topic
            writer.write(connections[topic], message.bag_time, message.content)
    return folder / "two_topics"
