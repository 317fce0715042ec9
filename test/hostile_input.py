"""What a hostile participant sends: scans, odometry, poses, transforms, documents and folders that cannot be right."""

import json
import math
import os
from array import array

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry as OdometryMessage
from sensor_msgs.msg import LaserScan
from visualization_msgs.msg import Marker

from hmt_slam_ros.messages.documents import encode
from hmt_slam_ros.messages.messages import Hypotheses, Hypothesis
from hmt_slam_ros.ros.conversions import keyframe_frame, time_message

NAN, INFINITY, HUGE, DENORMAL = math.nan, math.inf, 1e308, 5e-324
FLOATS = (NAN, INFINITY, -INFINITY, HUGE, -HUGE)
TEXTS = ("", "x" * 5000, "../../..", "\N{PILE OF POO}" * 100, "a\0b")
SECOND = 1_000_000_000
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
