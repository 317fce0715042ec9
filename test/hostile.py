"""A hostile participant: it speaks on every topic and calls every service that it finds, with what cannot be right.

Run as ``python hostile.py RESULT.json``, in the domain of running nodes. It makes RESULT.ready when it has found them,
and begins when that file is removed. Topics, types and services come from the ROS graph, documents from what the nodes
send themselves, so that it covers a new topic without a change. It does not send what nobody can tell from the truth: a
plausible scan between two others, or a valid command such as ``slam/reset``.
"""

import json
import os
import sys
import time
from collections import Counter
from contextlib import suppress
from functools import partial
from importlib import import_module
from itertools import chain, repeat, zip_longest
from pathlib import Path

# It does not check its fields.
os.environ["ROS_PYTHON_CHECK_FIELDS"] = "0"

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from hostile_input import (
    INFINITY,
    NAN,
    TEXTS,
    bad_folders,
    bad_readings,
    bad_scans,
    broken_documents,
    broken_texts,
    diagnostics,
    extreme_messages,
    initial_poses,
    keyframe_scans,
    leaves,
    transforms,
    with_leaf,
    wrong_hypotheses,
)
from rcl_interfaces.msg import Log, Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import ListParameters, SetParameters
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String
from std_srvs.srv import Trigger

from hmt_slam_ros.messages.messages import Hypotheses
from hmt_slam_ros.process_table import process_names
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import stamp_from_time
from hmt_slam_ros.ros.topics import DOCUMENTS, TFMessage

SHARED = {"/rosout", "/parameter_events"}
DIAGNOSTICS = "/diagnostics"
COMMANDS = {"slam/reset", "slam/relocalize"}
"""Services whose every request is a valid command."""
NODES = (*process_names(), "robot", "view", "explorer")
PROFILE = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1000,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""What every subscription accepts."""
PAUSE = 0.01
"""Time between two messages, s, in which the nodes' own messages come between."""
LONG_PAUSE = 0.25
"""The same after a message of which the page takes the newest alone, five times a second, s."""
NEWEST_ALONE = ("/map", "/pose")
ANSWER_TIMEOUT = 60.0  # s
ATTACK_RATE = 0.2
"""Rate of the robot while it speaks, so that its log lasts as long."""


class Stranger:
    """The participant."""

    def __init__(self):
        rclpy.init()
        self.node = rclpy.create_node("stranger")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.publishers, self.sent, self.called = {}, Counter(), Counter()
        self.documents, self.newest, self.slowest = {}, 0, 0.0
        self.texts = set()
        self.counts, self.sentences, self.unanswered = {}, set(), []
        self.node.create_subscription(LaserScan, "scan", self._on_scan, topics.SENSOR)
        self.node.create_subscription(DiagnosticArray, "diagnostics", self._on_diagnostics, topics.STREAM)
        self.node.create_subscription(Log, "/rosout", lambda log: self.sentences.add(log.msg), topics.STREAM)
        for topic in DOCUMENTS.values():
            self.node.create_subscription(String, topic, partial(self._on_document, topic), topics.CHAIN)

    def _on_scan(self, message):
        # Its own scans are those of a round room.
        if len(message.ranges) > 1 and min(message.ranges) < max(message.ranges):
            self.newest = max(self.newest, stamp_from_time(message.header.stamp))

    def _on_document(self, topic, message):
        if message.data not in self.texts:
            self.documents[topic] = message.data

    def _on_diagnostics(self, message):
        for status in message.status:
            refused = {one.key: one.value for one in status.values if one.key.startswith("refused on ")}
            self.counts.setdefault(status.name, {}).update(refused)

    def spin(self, seconds):
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0.0:
            self.executor.spin_once(timeout_sec=left)

    def topics(self):
        """{topic: type} of what the nodes listen to."""
        found = {}
        for topic, (kind, *_) in self.node.get_topic_names_and_types():
            ends = self.node.get_subscriptions_info_by_topic(topic)
            if topic not in SHARED and any(end.node_name not in ("stranger", "recorder") for end in ends):
                package, _, name = kind.split("/")
                found[topic] = getattr(import_module(f"{package}.msg"), name)
        return found

    def publish(self, topic, message):
        if isinstance(message, String):
            self.texts.add(message.data)
        self.publishers[topic].publish(message)
        self.sent[topic] += 1

    def speak(self):
        """Send messages on all topics: between two on those of which the page takes the newest, all others."""
        found = sorted(self.topics().items())
        for topic, kind in found:
            # A publisher that offers less than the nodes ask for.
            self.node.create_publisher(kind, topic, topics.LIVE_SENSOR)
            self.publishers[topic] = self.node.create_publisher(kind, topic, PROFILE)
        self.spin(1.0)
        # Of the state of the nodes when each is made.
        messages = {topic: self.messages_for(topic, kind) for topic, kind in found}
        seldom = zip_longest(*([(topic, one) for one in messages.pop(topic, ())] for topic in NEWEST_ALONE))
        others = ((topic, one) for topic, several in messages.items() for one in several)
        pause_end = 0.0
        for turn in chain(others, repeat(None)):
            if time.monotonic() >= pause_end:
                pause_end = time.monotonic() + LONG_PAUSE
                newest = next(seldom, None)
                for one in filter(None, newest or ()):
                    self.publish(*one)
                if turn is None and newest is None:
                    return
            if turn is not None:
                self.publish(*turn)
            self.spin(PAUSE)

    def messages_for(self, topic, kind):
        """The messages for a topic."""
        known = {
            "/scan": lambda: bad_scans(lambda: self.newest),
            "/odom": lambda: bad_readings(lambda: self.newest),
            DIAGNOSTICS: lambda: diagnostics(self.system),
            "/initialpose": initial_poses,
            "/hmt/keyframe_scans": lambda: keyframe_scans(lambda: self.newest, self.system),
        }
        if topic in known:
            return known[topic]()
        if kind is TFMessage:
            return (TFMessage(transforms=joints) for joints in transforms())
        if kind is String:
            return (String(data=text) for text in self.texts_for(topic[1:]))
        return extreme_messages(kind)

    def texts_for(self, topic):
        """Texts for a topic of documents or tasks."""
        yield from broken_texts()
        if topic in self.documents:
            yield from broken_documents(self.documents[topic])
        if topic == DOCUMENTS[Hypotheses]:
            yield from wrong_hypotheses(lambda: json.loads(self.documents[topic])["sequence"], self.system)

    @property
    def system(self):
        """Name of the system, which everybody can read."""
        return json.loads(self.documents[DOCUMENTS[Hypotheses]]).get("system", "")

    def call(self, kind, name, request):
        """The answer of a service, None where none came."""
        client = self.node.create_client(kind, name)
        begin = time.monotonic()
        while not client.service_is_ready() and time.monotonic() < begin + ANSWER_TIMEOUT:
            self.spin(0.01)
        begin = time.monotonic()
        future = client.call_async(request)
        while not future.done() and time.monotonic() < begin + ANSWER_TIMEOUT:
            self.executor.spin_once(timeout_sec=0.1)
        self.slowest = max(self.slowest, time.monotonic() - begin)
        self.called[name] += 1
        if not future.done():
            self.unanswered.append(name)
        self.node.destroy_client(client)
        return future.result() if future.done() else None

    def set_rate(self, rate):
        """Set how fast the robot plays its log; 0 for as fast as the nodes answer."""
        self.set_parameter("robot", "robot.rate", type=ParameterType.PARAMETER_DOUBLE, double_value=rate)

    def set_parameter(self, node, name, **value):
        """Set a parameter of a node."""
        request = SetParameters.Request(parameters=[Parameter(name=name, value=ParameterValue(**value))])
        self.call(SetParameters, f"/{node}/set_parameters", request)

    def load_from(self, folders):
        """Let slam load a map from each of some folders."""
        for folder in folders:
            self.set_parameter("slam", "load_from", type=ParameterType.PARAMETER_STRING, string_value=folder)
            self.call(Trigger, "/slam/load", Trigger.Request())

    def services(self):
        """{service: type} of the nodes."""
        found = {}
        for name, namespace in self.node.get_node_names_and_namespaces():
            if name not in ("stranger", "recorder"):
                for service, (kind, *_) in self.node.get_service_names_and_types_by_node(name, namespace):
                    package, _, kind_name = kind.split("/")
                    found[service] = getattr(import_module(f"{package}.srv"), kind_name)
        return found

    def request(self, folder):
        """Call all services."""
        for service, kind in sorted(self.services().items()):
            if service[1:] in COMMANDS:
                continue
            requests = [kind.Request()] if not service.endswith("change_state") else []
            if service == "/slam/load":
                self.load_from(bad_folders(folder))
            elif kind is SetParameters:
                requests = list(self.parameter_requests(service.rpartition("/")[0]))
            else:
                for path, value in leaves(kind.Request()):
                    if isinstance(value, str):
                        requests += [with_leaf(kind.Request, path, text) for text in TEXTS[1:]]
                    elif isinstance(value, int) and not isinstance(value, bool):
                        requests.append(with_leaf(kind.Request, path, 250))
            for request in requests:
                self.call(kind, service, request)

    def parameter_requests(self, node):
        """Requests for parameters with values of every type, that no parameter has."""
        listed = self.call(ListParameters, f"{node}/list_parameters", ListParameters.Request())
        names = sorted(listed.result.names) if listed else []
        values = [
            ParameterValue(type=99),
            ParameterValue(type=ParameterType.PARAMETER_NOT_SET),
            ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=NAN),
            ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=-INFINITY),
            ParameterValue(type=ParameterType.PARAMETER_INTEGER, integer_value=-(2**63)),
            ParameterValue(type=ParameterType.PARAMETER_STRING, string_value="x" * 5000),
            ParameterValue(type=ParameterType.PARAMETER_BYTE_ARRAY, byte_array_value=[b"\0"]),
            ParameterValue(type=ParameterType.PARAMETER_DOUBLE_ARRAY, double_array_value=[NAN]),
            ParameterValue(type=ParameterType.PARAMETER_STRING_ARRAY, string_array_value=["x"]),
        ]
        fixed = [name for name in names if not name.startswith(("rtl.", "robot."))]
        for name in (*fixed[:: max(1, len(fixed) // 2)], "mode", "no.such", "", "x" * 5000):
            for value in values:
                yield SetParameters.Request(parameters=[Parameter(name=name, value=value)])
        # From here on /clock counts, which is then sent with times that are none.
        clock = ParameterValue(type=ParameterType.PARAMETER_BOOL, bool_value=True)
        yield SetParameters.Request(parameters=[Parameter(name="use_sim_time", value=clock)])


def main(result):
    stranger = Stranger()
    while len(stranger.documents) < 3 or DOCUMENTS[Hypotheses] not in stranger.documents or not stranger.newest:
        stranger.spin(0.1)
    while set(NODES) - set(stranger.node.get_node_names()):
        stranger.spin(0.1)
    stranger.spin(1.0)  # for their topics and services
    folder = result.parent / "hostile"
    folder.mkdir()
    stranger.set_rate(ATTACK_RATE)
    ready = result.with_suffix(".ready")
    ready.touch()
    while ready.exists():
        stranger.spin(0.1)
    begin = time.monotonic()
    stranger.request(folder)
    stranger.speak()
    seconds = time.monotonic() - begin
    stranger.spin(3.0)
    stranger.set_rate(0.0)
    report = {
        "sent": stranger.sent, "called": stranger.called, "slowest": stranger.slowest, "seconds": seconds,
        "counts": stranger.counts, "sentences": sorted(stranger.sentences), "unanswered": stranger.unanswered,
    }  # fmt: skip
    result.with_suffix(".partial").write_text(json.dumps(report, indent=1))
    result.with_suffix(".partial").rename(result)
    stranger.spin(600.0)


if __name__ == "__main__":
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        main(Path(sys.argv[1]))
