"""Beside the five processes on their host: receive all estimates, save the map, print the last status of each node.

A process of its own, as Fast DDS knows the network of the first participant of a process for all that follow.
"""

import os
import sys
import traceback

from conftest import Listener
from diagnostic_msgs.msg import DiagnosticArray
from std_msgs.msg import String
from std_srvs.srv import Trigger

from hmt_slam_ros.messages.messages import LocalEstimate
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.topics import DIAGNOSTICS, DOCUMENTS

PATIENCE = 240.0  # s


def main(domain, scans):
    """Fail where the map is not saved."""
    listener = Listener(domain)
    estimates = listener.subscribe(String, DOCUMENTS[LocalEstimate], topics.CHAIN)
    health = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    print("listens", flush=True)
    try:
        # What is lost may be requested again after three seconds only, by Fast DDS's heartbeat.
        listener.until(lambda: len(estimates) == scans, seconds=PATIENCE)
        answer = listener.call(Trigger, "slam/save", Trigger.Request())
    finally:
        print(f"{len(estimates)} of {scans} estimates came")
        for status in {message.status[0].name: message.status[0] for message in health}.values():
            messages = ", ".join(f"{entry.key} {entry.value}" for entry in status.values)
            print(f"{status.name}: {status.message}; {messages}")
    assert answer.success, answer.message


if __name__ == "__main__":
    status = 1
    try:
        main(int(sys.argv[1]), int(sys.argv[2]))
        status = 0
    except Exception:
        traceback.print_exc()
    # Fast DDS may hang in the destruction of a participant while others leave (hmt_slam_ros/ros/execution.py).
    sys.stdout.flush()
    os._exit(status)
