"""The messages of a rosbag2 in a fixed order, and the choice among its topics."""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

from rosbags.rosbag2 import Reader

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs.ros_types import LASER_SCAN, ODOMETRY, TRANSFORMS
from hmt_slam_ros.logs.stamps import NANOSECONDS

DEFAULT_SCAN_TOPIC, DEFAULT_ODOM_TOPIC = "/scan", "/odom"


class BagMessage(NamedTuple):
    """A message as it lies in the bag: its bag time in ns, its type, its bytes (CDR)."""

    bag_time: int
    kind: str
    content: bytes


class Header(NamedTuple):
    """A message's header: its stamp in ns and its frame."""

    stamp: int
    frame: str


def header_of(content: bytes) -> Header:
    """The header that a message begins with, without reading the rest."""
    order = "<" if content[1] & 1 else ">"
    seconds, nanoseconds, length = struct.unpack_from(order + "iII", content, 4)
    return Header(seconds * NANOSECONDS + nanoseconds, content[16 : 15 + length].decode())


def read_topics(path: Path) -> dict[str, str]:
    """Message type of every topic.

    :raises HmtSlamError: where the bag cannot be opened.
    """
    with _damage_told(path), Reader(path) as reader:
        return {connection.topic: connection.msgtype for connection in reader.connections}


def read_messages(path: Path, topics: Collection[str]) -> Iterator[BagMessage]:
    """All messages of some topics in the order of their bag times; at one bag time, scans come last.

    :raises HmtSlamError: where the bag is damaged.
    """
    with _damage_told(path), Reader(path) as reader:
        connections = [connection for connection in reader.connections if connection.topic in topics]
        if not connections:
            return
        messages = (
            BagMessage(bag_time, connection.msgtype, bytes(content))
            for connection, bag_time, content in reader.messages(connections)
        )
        for _, simultaneous in groupby(messages, key=lambda message: message.bag_time):
            yield from sorted(simultaneous, key=lambda message: message.kind == LASER_SCAN)


@contextmanager
def _damage_told(path: Path) -> Iterator[None]:
    """Turn whatever a reader stumbles over into one sentence."""
    try:
        yield
    except HmtSlamError:
        raise
    except Exception as error:
        cause = str(error).strip().rstrip(".") or type(error).__name__
        raise HmtSlamError(
            f"{path} is no complete rosbag2, truncated or damaged ({cause}): copy or record it anew, "
            "or repair it with 'ros2 bag reindex'."
        ) from error


def choose_scan_topic(topics: Mapping[str, str], wanted: str, name: str) -> str:
    """The topic wanted; where that is the default and missing, the only one of its type.

    :param topics: message type of every topic.
    :param wanted: the topic asked for.
    :param name: of the bag, for messages.
    :raises HmtSlamError: where there is none, or more than one to choose from.
    """
    found = _choose(topics, wanted, DEFAULT_SCAN_TOPIC, LASER_SCAN, name)
    if found is None:
        raise HmtSlamError(f"{name} has no topic of type {LASER_SCAN}: record the laser's scans in it.")
    return found


def choose_odom_topic(topics: Mapping[str, str], wanted: str, name: str) -> str | None:
    """As `choose_scan_topic`; None where the bag has no odometry topic, but /tf to take it from.

    :raises HmtSlamError: where there is neither, or more than one to choose from.
    """
    found = _choose(topics, wanted, DEFAULT_ODOM_TOPIC, ODOMETRY, name)
    if found is None and topics.get("/tf") != TRANSFORMS:
        raise HmtSlamError(f"{name} has neither a topic of type {ODOMETRY} nor /tf: record the wheel odometry in it.")
    return found


def _choose(topics: Mapping[str, str], wanted: str, default: str, kind: str, name: str) -> str | None:
    of_kind = sorted(topic for topic, topic_kind in topics.items() if topic_kind == kind)
    if wanted in of_kind:
        return wanted
    choice = f"choose one of {', '.join(of_kind)}." if of_kind else f"it has no topic of type {kind}."
    if wanted in topics:
        raise HmtSlamError(f"topic {wanted} of {name} is of type {topics[wanted]}, not {kind}: {choice}")
    if wanted != default or len(of_kind) > 1:
        raise HmtSlamError(f"{name} has no topic {wanted}: {choice}")
    return of_kind[0] if of_kind else None
