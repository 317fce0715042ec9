#!/usr/bin/env python3
"""Print the areas and arcs of the map whenever they change.

Usage: graph_consumer.py [TOPIC [NUMBER OF MESSAGES, 0 for no end [SECONDS TO WAIT FOR THE FIRST]]]
"""

from __future__ import annotations

import json
import sys
from contextlib import suppress

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String


def pose_text(pose: list[float]) -> str:
    """A pose as x, y, m, and heading, rad."""
    return "({:.2f}, {:.2f}, {:.2f})".format(*pose)


def print_topology(text: str) -> None:
    """Print a document; docs/reference/schemas/topology.schema.json has its fields."""
    topology = json.loads(text)
    best = topology["hypotheses"][0]
    print(f"event {topology['events']}: {len(topology['hypotheses'])} hypotheses, the best {best['probability']:.3f}")
    print(f"robot: area {topology['area']}, {pose_text(topology['pose'])}")
    for area in topology["areas"]:
        print(f"area {area['area']}: {pose_text(area['pose']['mean'])}, {len(area['keyframes'])} keyframes")
    for arc in topology["arcs"]:
        kind = "closure" if arc["closure"] else "arc"
        ends = f"{arc['source']} -> {arc['target']}"
        print(f"{kind} {ends}: {pose_text(arc['pose']['mean'])}, probability {arc['probability']:.3f}")
    sys.stdout.flush()


def main() -> int:
    """Print messages until there were as many as wanted; return 1 where none came."""
    topic, wanted, patience = [*sys.argv[1:4], *("hmt/topology", "0", "10")[len(sys.argv) - 1 :]]
    rclpy.init()
    node, received = rclpy.create_node("graph_consumer"), []
    profile = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # the newest map, also if it is old
    node.create_subscription(String, topic, lambda message: received.append(print_topology(message.data)), profile)
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin_once(node, timeout_sec=float(patience))
        if not received:
            print(f"nothing came on {topic} within {patience} s: start the nodes, or set ROS_DOMAIN_ID as theirs is")
        while received and len(received) != int(wanted):
            rclpy.spin_once(node)
    return 0 if received else 1


if __name__ == "__main__":
    sys.exit(main())
