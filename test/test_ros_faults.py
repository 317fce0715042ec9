"""What goes wrong on a robot: nodes that are killed, disks that are full, lasers that fall silent."""

import resource
import signal

import numpy as np
import pytest
from conftest import Listener
from logs_for_nodes import BEAMS, LASER, PACE, SECOND, START, Corridor, corridor_bag
from ring_for_tsbi import RING, Run, ring_drive
from test_ros_localization import NODES, SCANS, Nodes, assert_true
from test_ros_quarantine import poison
from test_topological_inference_ring import DRIFT

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from nav_msgs.msg import Odometry as OdometryMessage
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String
from std_srvs.srv import Trigger

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.documents import ResetRequest, ResetResponse, decode, encode
from hmt_slam_ros.messages.evidence import Evidence
from hmt_slam_ros.messages.messages import AreaEvents, ClosureDecision, Keyframe, LocalEstimate
from hmt_slam_ros.messages.system_name import SystemName
from hmt_slam_ros.process_table import participant_names
from hmt_slam_ros.ros import conversions, topics
from hmt_slam_ros.ros.diagnostics import NodeDiagnostics
from hmt_slam_ros.ros.guarded_node import GuardedNode
from hmt_slam_ros.ros.message_io import Outbox
from hmt_slam_ros.ros.topics import DIAGNOSTICS, DOCUMENTS, KEYFRAMES, MAP, ODOM, POSE, ROBOT_STATUS, SCAN, TFMessage
from hmt_slam_ros.saved_map.folder import FORMAT, VERSION, FolderReader
from hmt_slam_ros.sensors import Odometry, Scan


def kill(process):
    process.send_signal(signal.SIGKILL)
    process.communicate()


def restart(nodes, name, before, **parameters):
    """Start a node that was killed; wait until it has taken over."""
    status_message = len(nodes.diagnostics)
    nodes.alive[before] = nodes.start(name, **parameters)
    nodes.until(lambda: any(m.status[0].name == f"/{name}" for m in nodes.diagnostics[status_message:]))


def corridor_measurements(scans):
    """Scans and odometry readings along the corridor, in the order of their stamps."""
    return [record.measurement for record in Corridor(scans).records()]


class Driver:
    """Laser and wheels that are drivers' own, which keep nothing for late comers, in a process that is younger."""

    def __init__(self, nodes, domain):
        self._nodes, self._own = nodes, Listener(domain)
        self._scans = self._own.node.create_publisher(LaserScan, SCAN, topics.SENSOR)
        self._odom = self._own.node.create_publisher(OdometryMessage, "odom", topics.SENSOR)
        listening = (self._scans.get_subscription_count, self._odom.get_subscription_count)
        nodes.until(lambda: [count() for count in listening] == [1, 2])

    def send(self, measurement):
        """Publish a scan or an odometry reading."""
        if isinstance(measurement, Scan):
            self._scans.publish(conversions.scan_message(measurement, "laser"))
        else:
            self._odom.publish(conversions.odometry_message(measurement, "odom", "base_link"))

    def close(self):
        self._own.close()

    def answered_stamps(self):
        """Stamps of the scans that have a pose, ns."""
        return [decode(message.data, LocalEstimate).stamp for message in self._nodes.estimates]


def test_rtl_that_is_killed_goes_on_with_the_pose_and_the_parameters_that_it_had(tmp_path, listener, start):
    reported = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    odom = listener.node.create_publisher(OdometryMessage, "odom", topics.SENSOR)
    estimates = listener.node.create_publisher(String, DOCUMENTS[LocalEstimate], topics.CHAIN)
    placed = listener.subscribe(PoseWithCovarianceStamped, POSE, topics.STREAM)
    process = start("rtl", recovery=tmp_path)
    listener.until(lambda: odom.get_subscription_count() and estimates.get_subscription_count(), alive=[process])
    belief = PoseGaussian(np.array([1.0, 2.0, 0.0]), 1e-4 * np.eye(3))
    step = 0

    def drive():
        nonlocal step
        step += 1
        reading = Odometry(20_000_000 * step, np.array([0.01 * step, 0.0, 0.0]))
        odom.publish(conversions.odometry_message(reading, "odom", "base_link"))
        return reading

    first = drive()
    estimates.publish(String(data=encode(LocalEstimate(first.stamp, 0, 0, belief, first.pose, 0))))
    while len(placed) < 3:
        drive()
        listener.spin(0.05)
    parameters = [Parameter("rtl.publish_tf", value=False).to_parameter_msg()]
    changed = listener.call(SetParameters, "rtl/set_parameters", SetParameters.Request(parameters=parameters))
    assert changed.results[0].successful
    kill(process)
    assert list(tmp_path.iterdir())

    status_message, received = len(placed), len(reported)
    process = start("rtl", recovery=tmp_path)
    listener.until(lambda: len(reported) > received, alive=[process])
    assert len(placed) == status_message  # nothing that is past
    while len(placed) < status_message + 1:
        drive()
        listener.spin(0.05)
    moved = conversions.stamp_from_time(placed[status_message].header.stamp) / 20_000_000 - 1
    assert conversions.pose_from_message(placed[status_message].pose.pose) == pytest.approx(
        [1.0 + 0.01 * moved, 2.0, 0.0]
    )
    # The answer of the dead one would be waited for.
    client = listener.node.create_client(GetParameters, "rtl/get_parameters")
    future = client.call_async(GetParameters.Request(names=["rtl.publish_tf"]))
    listener.until(future.done, alive=[process])
    assert future.result().values[0].bool_value is False
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=20)
    assert not list(tmp_path.iterdir())


@pytest.mark.long
def test_a_process_that_was_dead_while_the_others_restarted_restarts_too(corridor, listener, start, tmp_path):
    log, out = corridor
    parameters = {"start_from": out, "start_lost": False, "recovery": tmp_path}
    nodes = Nodes(start, listener, **parameters)
    nodes.drive(log, first=90, robot__duration=3.0)
    nodes.until(lambda: len(nodes.estimates) == 15)
    nodes.park()
    kill(nodes.alive[1])
    requested = listener.node.create_client(Trigger, "slam/reset").call_async(Trigger.Request())
    listener.spin(0.5)
    assert not requested.done()
    restart(nodes, "aam", 1, **parameters)
    nodes.until(requested.done)
    assert requested.result().success, requested.result().message
    nodes.drive(log, first=0, robot__duration=6.0)
    nodes.until(lambda: len(nodes.estimates) == 15 + 30)
    # Of the new map, though slam sent keyframes of the same numbers before the reset.
    kill(nodes.alive[1])
    restart(nodes, "aam", 1, **parameters)
    nodes.park()
    nodes.drive(log, first=31, rate=8.0)
    nodes.until(lambda: len(nodes.estimates) == 15 + 30 + SCANS - 31)
    end = 4 * (SCANS - 1) * PACE
    nodes.until(
        lambda: nodes.poses and np.abs(conversions.pose_from_message(nodes.poses[-1].pose.pose) - end).max() < 0.3
    )


def test_a_reset_counts_answers_from_before_slam_was_known_to_those_who_answer(domain, listener, start):
    slam = start("slam")
    requests = [listener.subscribe(String, topics.RESET_REQUEST, topics.CHAIN) for _ in participant_names()]
    client = listener.node.create_client(Trigger, "slam/reset")
    listener.until(client.service_is_ready, alive=[slam])
    requested = client.call_async(Trigger.Request())
    listener.until(lambda: all(requests), alive=[slam])
    number = decode(requests[0][0].data, ResetRequest).number
    # While slam is stopped, DDS makes it known to nobody.
    slam.send_signal(signal.SIGSTOP)
    late = Listener(domain)
    responses = late.node.create_publisher(String, topics.RESET_RESPONSE, topics.CHAIN)
    for name in participant_names():
        responses.publish(String(data=encode(ResetResponse(number, name))))
    assert not responses.get_subscription_count()
    slam.send_signal(signal.SIGCONT)
    listener.until(requested.done, alive=[slam])
    assert requested.result().success, requested.result().message
    late.close()


def test_a_process_that_is_killed_after_a_reset_answers_it_again_without_another_one(listener, start, tmp_path):
    requests = listener.node.create_publisher(String, topics.RESET_REQUEST, topics.CHAIN)
    responses = listener.subscribe(String, topics.RESET_RESPONSE, topics.CHAIN)
    aam = start("aam", recovery=tmp_path)
    listener.until(requests.get_subscription_count, alive=[aam])
    for number in (1, 2):
        requests.publish(String(data=encode(ResetRequest(number, 0, ""))))
    listener.until(lambda: len(responses) == 2, alive=[aam])
    kill(aam)
    generations = {path.name for path in (tmp_path / "aam").iterdir()}
    aam = start("aam", recovery=tmp_path)
    listener.until(lambda: len(responses) == 3, alive=[aam])
    answered = [decode(message.data, ResetResponse) for message in responses]
    assert [(one.number, one.process, one.error) for one in answered] == [(k, "aam", "") for k in (1, 2, 2)]
    # A reset starts another journal.
    assert {path.name for path in (tmp_path / "aam").iterdir()} == generations


@pytest.mark.skipif(TFMessage is None, reason="tf2_msgs is not installed: run scripts/test.sh, which builds it")
def test_all_are_killed_with_the_transform_of_the_laser_and_continue_without_it(domain, listener, start, tmp_path):
    nodes = Nodes(start, listener, recovery=tmp_path / "recovery")
    nodes.drive(corridor_bag(tmp_path, scans=60), first=0, robot__duration=5.9)
    nodes.until(lambda: len(nodes.estimates) == 30)
    for process in nodes.alive:
        kill(process)
    status_message = len(nodes.diagnostics)
    nodes.alive = [start(name, recovery=tmp_path / "recovery") for name in NODES]
    nodes.until(
        lambda: {m.status[0].name for m in nodes.diagnostics[status_message:]} >= {f"/{name}" for name in NODES}
    )
    driver = Driver(nodes, domain)
    for one in corridor_measurements(60)[150:]:
        driver.send(one)
    nodes.until(lambda: driver.answered_stamps()[-1] == START + 59 * 200_000_000)
    # What was under way when they were killed is reported again.
    assert sorted(set(driver.answered_stamps())) == [START + k * 200_000_000 for k in range(60)]
    end = 4 * 59 * PACE
    nodes.until(
        lambda: nodes.poses and np.abs(conversions.pose_from_message(nodes.poses[-1].pose.pose) - end).max() < 0.1
    )
    assert "no transform" not in nodes.diagnosis("slam")["last error"]
    driver.close()
    for process in nodes.alive:
        process.send_signal(signal.SIGINT)
    for process in nodes.alive:
        assert "was killed and goes on where it was" in process.communicate(timeout=20)[1]


def disturb(measurements, period):
    """Measurements of one kind, ``period`` ns apart, as (time of arrival, measurement).

    Some come after their successor, some 0.3 s late, some twice, and one 5 s late.
    """
    for number, one in enumerate(measurements):
        late = SECOND * (5 if number == 12 else 0.3 if number % 13 == 7 else 0)
        yield one.stamp + max(late, 1.5 * period if number % 5 == 2 else 0), one
        if number % 4 == 0:
            yield one.stamp + 0.5 * period, one


def in_order(stamps):
    """Those that are greater than all before."""
    highest = np.maximum.accumulate([0, *stamps])
    return [stamp for stamp, before in zip(stamps, highest, strict=False) if stamp > before]


def test_what_comes_late_twice_or_out_of_order_is_left_out_and_counted_and_all_else_is_used(domain, listener, start):
    nodes = Nodes(start, listener, laser_pose=LASER.tolist())
    driver = Driver(nodes, domain)
    kinds = {Scan: SECOND // 5, Odometry: SECOND // 20}
    sent = {kind: [one for one in corridor_measurements(60) if isinstance(one, kind)] for kind in kinds}
    arrivals = sorted((entry for kind in kinds for entry in disturb(sent[kind], kinds[kind])), key=lambda e: e[0])
    came = {kind: [one.stamp for _, one in arrivals if isinstance(one, kind)] for kind in kinds}
    used = {kind: in_order(came[kind]) for kind in kinds}
    assert all(len(came[kind]) > len(sent[kind]) > len(used[kind]) for kind in kinds)
    for number, (_, one) in enumerate(arrivals):
        driver.send(one)
        # As a laser does, which waits for nobody, but no faster than slam is on a computer that is busy.
        nodes.until(lambda now=one.stamp: now < 2 * SECOND + (driver.answered_stamps() or [START])[-1])
        if number == len(arrivals) // 2:
            nodes.until(lambda: nodes.diagnosis("rtl")["received LocalEstimate"])
    nodes.until(lambda: driver.answered_stamps() == used[Scan])
    nodes.until(lambda: nodes.poses and conversions.stamp_from_time(nodes.poses[-1].header.stamp) == used[Odometry][-1])
    for message in nodes.poses:
        assert_true(message, START)
    stamps = [conversions.stamp_from_time(message.header.stamp) for message in nodes.poses]
    assert in_order(stamps) == stamps
    refused = {kind: str(len(came[kind]) - len(used[kind])) for kind in kinds}
    nodes.until(lambda: nodes.diagnosis("slam")["refused on scan"] == refused[Scan])
    for name in ("slam", "rtl"):
        nodes.until(lambda name=name: nodes.diagnosis(name)["refused on odom"] == refused[Odometry])
        assert nodes.diagnosis(name)["received Odometry"] == str(len(used[Odometry]))
        assert " came late, twice or far ahead, beside that of " in nodes.diagnosis(name)["last error"]
    assert not nodes.notices
    driver.close()


@pytest.mark.usefixtures("corridor")  # with which the kernels are compiled: this laser does not wait for that
def test_a_laser_falls_silent_a_disk_is_full_and_time_jumps_back(listener, start, tmp_path):
    silent = range(10, 60)
    log = corridor_bag(tmp_path, scans=SCANS, silent=silent)
    nodes = Nodes(start, listener, save_to=tmp_path / "map", recovery=tmp_path / "recovery")
    slam = nodes.alive[0]
    nodes.drive(log, first=0, rate=2.0, robot__flow_control=False)
    nodes.until(lambda: len(nodes.estimates) == 10)
    nodes.until(lambda: "no scan came for 3 s, while odometry does" in nodes.diagnosis("slam")["last error"])
    nodes.until(lambda: len(nodes.estimates) == SCANS - len(silent))
    nodes.until_at(4 * (SCANS - 1))

    def save():
        return listener.call(Trigger, "slam/save", Trigger.Request())

    assert save().success
    before = {path.name: path.read_bytes() for path in (tmp_path / "map").iterdir()}
    unlimited = resource.prlimit(slam.pid, resource.RLIMIT_FSIZE)
    resource.prlimit(slam.pid, resource.RLIMIT_FSIZE, (1000, unlimited[1]))
    full = save()
    assert not full.success
    assert "File too large; the map of before stays; make room, or set save_to of slam to another" in full.message
    assert {path.name: path.read_bytes() for path in (tmp_path / "map").iterdir()} == before
    assert {path.name for path in tmp_path.iterdir()} == {"corridor", "map", "recovery"}

    # The same log once more: its stamps go back, and its odometry is elsewhere.
    nodes.park()
    nodes.drive(log, first=61, rate=4.0)
    nodes.until(lambda: not nodes.is_localized())
    nodes.until(nodes.is_localized)
    nodes.until(lambda: len(nodes.estimates) == SCANS - len(silent) + SCANS - 61)
    # The journal had no room either; slam went on without.
    assert not (tmp_path / "recovery" / "slam").exists()
    resource.prlimit(slam.pid, resource.RLIMIT_FSIZE, unlimited)
    assert save().success
    FolderReader(tmp_path / "map", FORMAT, VERSION)
    for process in nodes.alive[:5]:
        process.send_signal(signal.SIGINT)
    reported = slam.communicate(timeout=20)[1]
    assert "scans come again on scan, after" in reported
    assert "time went back by" in reported
    assert "the node goes on, but if it is killed all have to be restarted; make room there" in reported


@pytest.mark.skipif(TFMessage is None, reason="tf2_msgs is not installed: run scripts/test.sh, which builds it")
def test_a_missing_transform_and_clocks_that_are_apart_are_reported_with_the_remedy(listener, start):
    reported = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    keyframes = listener.subscribe(String, KEYFRAMES, topics.CHAIN)
    scans = listener.node.create_publisher(LaserScan, SCAN, topics.SENSOR)
    odom = listener.node.create_publisher(OdometryMessage, "odom", topics.SENSOR)
    static = listener.node.create_publisher(TFMessage, "tf_static", topics.LATCHED)
    process = start("slam", filter__max_scans_waiting_for_odometry=8)
    listener.until(lambda: scans.get_subscription_count() and odom.get_subscription_count(), alive=[process])
    hour = 3600 * SECOND
    measurements = [record.measurement for record in Corridor(55).records()]
    for one in measurements:
        if isinstance(one, Scan):
            late = Scan(one.stamp + hour, one.ranges, one.angle_min, one.angle_increment, one.range_min, one.range_max)
            assert late.ranges.size == BEAMS
            scans.publish(conversions.scan_message(late, "laser"))
        else:
            odom.publish(conversions.odometry_message(one, "odom", "base_link"))

    def status_message():
        return next((m.status[0].message for m in reversed(reported) if m.status[0].name == "/slam"), "")

    listener.until(lambda: "no transform" in status_message(), alive=[process])
    assert status_message() == (
        "no transform from 'base_link' to 'laser' on /tf_static, so 55 scans wait, the first of stamp "
        f"{measurements[0].stamp + hour} ns: publish it, or set the parameter laser_pose"
    )
    assert not keyframes
    static.publish(TFMessage(transforms=[conversions.transform_message(0, "base_link", "laser", np.zeros(3))]))
    listener.until(lambda: keyframes and "no transform" not in status_message(), alive=[process])
    process.send_signal(signal.SIGINT)
    error = process.communicate(timeout=20)[1]
    assert " s after the odometry that comes with them: let both computers have one clock" in error
    assert "scans wait for odometry" in error


def joints(messages):
    """(parent, child) of the transforms that came."""
    return {(joint.header.frame_id, joint.child_frame_id) for message in messages for joint in message.transforms}


@pytest.mark.long
@pytest.mark.skipif(TFMessage is None, reason="tf2_msgs is not installed: run scripts/test.sh, which builds it")
def test_two_robots_that_drive_at_once_under_namespaces_share_nothing_but_a_tf_that_is_configured_so(
    listener, start, tmp_path
):
    names = {"map": "map", "odom": "odom", "base": "base_link", "laser": "laser"}
    frames = {f"{which}_frame": f"two/{name}" for which, name in names.items()}
    one = Nodes(start, listener, namespace="/one", recovery=tmp_path)
    two = Nodes(
        start, listener, "-r", "tf:=/tf", "-r", "tf_static:=/tf_static", namespace="/two", recovery=tmp_path, **frames
    )
    maps = {nodes: nodes.subscribe(OccupancyGrid, MAP, topics.LATCHED) for nodes in (one, two)}
    tf = {topic: listener.subscribe(TFMessage, topic, topics.TF_STATIC) for topic in ("/one/tf_static", "/tf_static")}
    tf |= {topic: listener.subscribe(TFMessage, topic, topics.STREAM) for topic in ("/one/tf", "/tf")}
    # Of estimates that come when all odometry has come, rtl says no pose.
    for nodes in (one, two):
        nodes.until(lambda nodes=nodes: all(map(nodes.diagnosis, NODES)))
    drives = {one: 40, two: 60}
    for nodes, scans in drives.items():
        folder = tmp_path / f"log_{scans}"
        folder.mkdir()
        # The third listener is the test's: by then its subscriptions are known, and no transform is lost.
        nodes.subscribe(OdometryMessage, ODOM, topics.STREAM)
        options = {"robot__odometry_listeners": 3, **(frames if nodes is two else {})}
        nodes.drive(corridor_bag(folder, scans=scans), first=0, **options)
    for nodes, scans in drives.items():
        nodes.until(lambda nodes=nodes, scans=scans: len(nodes.estimates) == scans)
        end = START + (scans - 1) * SECOND // 5
        nodes.until(
            lambda nodes=nodes, end=end: (
                nodes.poses and conversions.stamp_from_time(nodes.poses[-1].header.stamp) == end
            )
        )
        assert_true(nodes.poses[-1], START)
        nodes.until(lambda nodes=nodes, scans=scans: nodes.diagnosis("slam")["received Scan"] == str(scans))
        nodes.until(lambda nodes=nodes: maps[nodes])
        # The robot goes on to say that its log has ended.
        statuses = nodes.subscribe(String, ROBOT_STATUS, topics.LATCHED)
        nodes.until(lambda received=statuses: len(received) >= 8)
        awaited = len(nodes.diagnostics) + 2 * len(NODES)
        nodes.until(lambda nodes=nodes, awaited=awaited: len(nodes.diagnostics) > awaited)
        assert nodes.diagnosis("slam")["sent EndOfRun"] == "1"
    assert {message.header.frame_id for message in [*one.poses, *maps[one]]} == {"map"}
    assert {message.header.frame_id for message in [*two.poses, *maps[two]]} == {"two/map"}
    assert joints(tf["/one/tf"] + tf["/one/tf_static"]) == {
        ("map", "odom"),
        ("odom", "base_link"),
        ("base_link", "laser"),
    }
    assert joints(tf["/tf"] + tf["/tf_static"]) == {
        ("two/map", "two/odom"),
        ("two/odom", "two/base_link"),
        ("two/base_link", "two/laser"),
    }
    shared = {"/clock", "/diagnostics", "/parameter_events", "/rosout", "/tf", "/tf_static"}
    for name, _ in listener.node.get_topic_names_and_types():
        assert name in shared or name.startswith(("/one/", "/two/")), name
    for name, _ in listener.node.get_service_names_and_types():
        assert name.startswith(("/one/", "/two/", "/listener/")), name
    kept = {path.name for path in tmp_path.iterdir() if not path.name.startswith("log_")}
    assert kept == {f"{top}.{name}" for top in ("one", "two") for name in NODES}


@pytest.fixture
def sender(listener):
    """A node that plays slam, aam and tlca for tsbi."""
    node = GuardedNode("sender", context=listener.context)
    node.diagnostics = NodeDiagnostics(node, SystemName(""))
    yield Outbox(node, (Keyframe, AreaEvents, ClosureDecision))
    node.destroy_node()


@pytest.mark.long
def test_what_speaks_for_hypotheses_outlives_two_kills_of_tsbi(sender, listener, start, tmp_path):
    """By the journal, and by a checkpoint, which a journal with an entry that cannot be read makes due."""
    played, run = [], Run(RING, DRIFT, field_of_view=2 * np.pi, beams=241)
    handle = run.tsbi.handle
    run.tsbi.handle = lambda message: played.append(message) or handle(message)
    for k, pose in enumerate(ring_drive(106)):
        answer = run.keyframe(pose, cut=7 if k and k % 14 == 0 else 0)
        if k <= 95 and len(answer.hypotheses) > 1:
            run.accept(run.replica.best_hypothesis)
        else:
            run.tsbi.handle(ClosureDecision(k))
    expected = encode(run.tsbi.evidence)
    assert len(run.tsbi.evidence.hypotheses) == 2
    received = listener.subscribe(String, DOCUMENTS[Evidence], topics.LATCHED)
    node = start("tsbi", recovery=tmp_path)
    for message in played:
        sender.send(message)
    listener.until(lambda: received and received[-1].data == expected, alive=[node])
    for change in (lambda last: [{**last, "value": {"of": "an older version"}}], None):
        kill(node)
        if change is not None:
            poison(tmp_path, change, "tsbi")
        received.clear()
        node = start("tsbi", recovery=tmp_path)
        listener.until(lambda: received and received[-1].data == expected, alive=[node])
    (generation,) = (path for path in (tmp_path / "tsbi").iterdir() if path.name.isdecimal())
    assert (generation / "state" / "evidence.json").exists()
