"""A hostile participant: it speaks on every topic and calls every service that it finds, with what cannot be right.

Run as ``python hostile.py RESULT.json``, in the domain of running nodes. It makes RESULT.ready when it has found them,
and begins when that file is removed. Topics, types and services come from the ROS graph, documents from what the nodes
send themselves, so that it covers a new topic without a change. It does not send what nobody can tell from the truth: a
plausible scan between two others, or a valid command such as ``slam/reset``.
"""

import json
import math
import os
import sys
import time
from array import array
from collections import Counter
from contextlib import suppress
from functools import partial
from importlib import import_module
from itertools import chain, repeat, zip_longest
from pathlib import Path

# It does not check its fields.
os.environ["ROS_PYTHON_CHECK_FIELDS"] = "0"

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry as OdometryMessage
from rcl_interfaces.msg import Log, Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import ListParameters, SetParameters
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String
from std_srvs.srv import Trigger
from visualization_msgs.msg import Marker, MarkerArray

from hmt_slam_ros.messages.documents import encode
from hmt_slam_ros.messages.messages import Hypotheses, Hypothesis
from hmt_slam_ros.process_table import process_names
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import keyframe_frame, stamp_from_time, time_message
from hmt_slam_ros.ros.topics import DOCUMENTS, TFMessage

NAN, INFINITY, HUGE, DENORMAL = math.nan, math.inf, 1e308, 5e-324
FLOATS = (NAN, INFINITY, -INFINITY, HUGE, -HUGE)
TEXTS = ("", "x" * 5000, "../../..", "\N{PILE OF POO}" * 100, "a\0b")
SECOND = 1_000_000_000
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
NEWEST_ALONE = ("/map", "/pose", "/hmt/graph")
ANSWER_TIMEOUT = 60.0  # s
ATTACK_RATE = 0.2
"""Rate of the robot while it speaks, so that its log lasts as long."""
BEAMS = 91


def leaves(message, path=()):
    """(path, value) of the plain fields of a ROS message, and of the first of its arrays of messages."""
    for name in message.get_fields_and_field_types():
        value = getattr(message, name)
        if hasattr(value, "get_fields_and_field_types"):
            yield from leaves(value, (*path, name))
        else:
            yield (*path, name), value


def with_leaf(kind, path, value):
    """A message that is empty but for one field."""
    message = kind()
    target = message
    for name in path[:-1]:
        target = getattr(target, name)
    setattr(target, path[-1], value)
    if kind is Marker and path != ("ns",):
        message.ns = "areas"
    return message


def extreme_messages(kind):
    """Messages of a type, each with one field that is extreme; markers are those of areas."""
    for path, value in leaves(kind()):
        if isinstance(value, float):
            yield from (with_leaf(kind, path, extreme) for extreme in FLOATS)
        elif isinstance(value, str):
            yield from (with_leaf(kind, path, text) for text in TEXTS[1:])
        elif isinstance(value, int) and not isinstance(value, bool):
            yield from (with_leaf(kind, path, extreme) for extreme in (0, 2**31 - 1) if path[-1] != "nanosec")
            if path[-1] == "sec":
                yield with_leaf(kind, path, -5)
        elif isinstance(value, array) and value.typecode in "fd":
            yield with_leaf(kind, path, array(value.typecode, FLOATS[:4]))


def scan(stamp, frame="laser", count=BEAMS, **fields):
    """A scan that is plausible but for some fields."""
    message = LaserScan(angle_min=-1.5, angle_increment=3.0 / BEAMS, range_min=0.1, range_max=20.0)
    message.header.frame_id, message.header.stamp = frame, time_message(stamp)
    message.ranges = array("f", [2.0]) * count
    for name, value in fields.items():
        setattr(message, name, value)
    return message


def bad_scans(newest):
    """Scans that can be refused; ``newest()`` is the stamp of the robot's last one, ns."""
    due = lambda: newest() + SECOND // 20  # noqa: E731
    for fields in (
        {"angle_min": NAN}, {"angle_min": INFINITY}, {"angle_increment": 1e-30}, {"angle_increment": 0.0},
        {"angle_increment": NAN}, {"angle_increment": INFINITY}, {"angle_increment": HUGE}, {"range_max": NAN},
        {"range_min": INFINITY, "range_max": INFINITY}, {"range_min": -1.0}, {"range_min": NAN},
        {"range_max": -INFINITY}, {"time_increment": NAN}, {"time_increment": -1.0}, {"time_increment": 1e9},
    ):  # fmt: skip
        yield scan(due(), **fields)
        yield scan(due(), intensities=array("f", [1.0] * 3), **fields)
    yield scan(due(), count=1_000_000)
    for frame in ("", "x" * 5000, "nobody's", "line\nbreak"):
        yield scan(due(), frame)
    yield scan(0)
    yield from (scan(newest() + late * SECOND) for late in (-3600, -2, 0, 3600))
    yield scan((2**31 - 1) * SECOND)
    # Two that confirm each other.
    yield from (scan(newest() + 7200 * SECOND + k * SECOND // 5) for k in range(4))
    before = scan(due())
    before.header.stamp.sec = -5
    yield before


def bad_readings(newest):
    """Odometry that can be refused; ``newest()`` is the stamp of the robot's last scan, ns."""
    for part in ("x", "y", "z"):
        for value in FLOATS if part != "z" else ():
            message = reading(newest() + SECOND // 20)
            setattr(message.pose.pose.position, part, value)
            yield message
    for w in (0.0, NAN, INFINITY, 2.0, 1e-3, DENORMAL):
        message = reading(newest() + SECOND // 20)
        message.pose.pose.orientation.w = w
        yield message
    yield reading(0)
    yield from (reading(newest() + late * SECOND) for late in (-3600, 0, 3600))
    yield reading((2**31 - 1) * SECOND)
    yield from (reading(newest() + 7200 * SECOND + k * SECOND // 20) for k in range(4))


def reading(stamp):
    message = OdometryMessage()
    message.header.stamp, message.pose.pose.orientation.w = time_message(stamp), 1.0
    return message


def diagnostics(system):
    """Faults of nodes that are well, and values that are none."""
    for name in ("/slam", "/view", "x" * 5000, ""):
        values = [KeyValue(key="system", value=system), KeyValue(key="busy", value="nan s"), KeyValue(key="\0" * 9)]
        for level in (DiagnosticStatus.ERROR, b"\xff"):
            status = DiagnosticStatus(level=level, name=name, message="hello", hardware_id="hmt_slam_ros")
            yield DiagnosticArray(status=[status])
            status.values = values
            yield DiagnosticArray(status=[status] * 50)


def initial_poses():
    """Initial poses that can be refused."""

    def pose(frame="map", x=0.0, w=1.0, variance=0.1):
        message = PoseWithCovarianceStamped()
        message.header.frame_id, message.pose.pose.position.x, message.pose.pose.orientation.w = frame, x, w
        for k in (0, 7, 35):
            message.pose.covariance[k] = variance
        return message

    yield from (pose(x=x) for x in (*FLOATS, 1e6))
    yield from (pose(w=w) for w in (0.0, NAN, 2.0))
    yield from (pose(variance=variance) for variance in (NAN, INFINITY, -1.0, HUGE))
    yield from (pose(frame=frame) for frame in TEXTS)


def transforms():
    """Transforms that tilt, move or lose the laser, or are none."""

    def joint(parent="base_link", child="laser", x=0.1, turn=(0.0, 0.0, 0.0, 1.0)):
        stamped = TransformStamped(child_frame_id=child)
        stamped.header.frame_id, stamped.transform.translation.x = parent, x
        rotation = stamped.transform.rotation
        rotation.x, rotation.y, rotation.z, rotation.w = turn
        return stamped

    half = math.sqrt(0.5)
    for turn in ((half, 0.0, 0.0, half), (0.0, half, 0.0, half), (0.0, 0.0, 0.0, 0.0), (NAN, 0.0, 0.0, 1.0)):
        yield [joint(turn=turn)]
    yield from ([joint(x=x)] for x in (NAN, INFINITY, HUGE, 1000.0))
    yield [joint(parent="x" * 5000), joint(child="")]
    yield [joint(parent="loose", child="loose")]
    yield [joint(parent="a", child="b"), joint(parent="b", child="c"), joint(parent="c", child="a")]
    yield [joint(parent="base_link", child=f"frame_{k}") for k in range(10_000)]


def broken_texts():
    """Texts that are no documents."""
    yield from ("hello", "", "null", "[]", "{}", "0", '"text"', "NaN", "[" * 100_000, "1" + "0" * 400, "9" * 5000)
    yield '{"document":' * 200 + "1" + "}" * 200
    yield '{"document":"stranger","version":1}'


def broken_documents(document):
    """Forms of a document with one thing that is wrong, wherever it stands."""
    plain = json.loads(document)
    yield json.dumps({**plain, "version": 10**6})
    yield json.dumps({**plain, "strange": 1})
    yield json.dumps({**plain, "system": "another"})
    yield json.dumps({name: value for name, value in plain.items() if name != "system"})
    yield json.dumps({name: value for name, value in plain.items() if name in ("document", "version", "system")})
    for name, value in plain.items():
        if name in ("document", "version", "system"):
            continue
        marked = json.dumps({**plain, name: "MARK"})
        wrong = ["NaN", "Infinity", "1" + "0" * 400, "9" * 5000, "[" * 2000 + "]" * 2000]
        if isinstance(value, int) and not isinstance(value, bool):
            wrong += ["-1", '"text"', "1.5", str(10**30)]
        elif not isinstance(value, str):
            wrong += ['"text"', "7"]
        yield from (marked.replace('"MARK"', text) for text in wrong)


def wrong_hypotheses(sequence, system):
    """Documents of hypotheses that make no sense at the next keyframe event, or are far from it.

    :param sequence: returns the number of the last keyframe event.
    """

    def alone(identity=0, parent=0, probability=1.0):
        return (Hypothesis(identity, parent, probability, 0),)

    for ahead in (0, 1):
        for hypotheses in ((), alone(7, 99), alone() + alone(), alone(probability=7.0), alone(probability=-1.0)):
            yield encode(Hypotheses(sequence() + ahead, hypotheses), 0, system)
    yield from (encode(Hypotheses(event, alone()), 0, system) for event in (0, 10**6, 10**18))
    yield encode(Hypotheses(sequence() + 50, alone()), 0, system)
    for reset_number in (5, 2**62):
        yield encode(Hypotheses(sequence() + 1, alone()), reset_number, system)
    yield encode(Hypotheses(sequence() + 1, alone()), 0, "another")
    yield encode(Hypotheses(sequence() + 1, alone()), 0, "")


def keyframe_scans(newest, system):
    """Scans of keyframes that are none; ``newest()`` is the stamp of the robot's last scan, ns."""
    strange = (keyframe_frame(10**6, 0, system), keyframe_frame(1, 0, "another"))
    yield from (scan(newest(), frame) for frame in ("keyframe_1", *strange, "keyframe_x", "x" * 5000))
    yield scan(newest(), keyframe_frame(0, 0, system), ranges=array("f"))


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
            "/hmt/graph": lambda: (MarkerArray(markers=[marker]) for marker in extreme_messages(Marker)),
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


def bad_folders(folder):
    """Names of maps that are none."""
    os.mkfifo(folder / "pipe")
    (folder / "zero").symlink_to("/dev/zero")
    (folder / "locked").mkdir(mode=0)
    (folder / "map").mkdir()
    os.mkfifo(folder / "map" / "hmt_map.json")
    (folder / "strange").mkdir()
    (folder / "strange" / "manifest.json").symlink_to("/dev/zero")
    paths = [str(folder / name) for name in ("pipe", "zero", "locked", "map", "strange", "none")]
    return [*paths, *(f"file://{path}" for path in paths), *TEXTS, "[" * 100_000, "..", "/", "/dev/zero"]


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
