"""The SROS2 policy has the form of sros2's schema, and an enclave for every node."""

import re
import socket
from collections import defaultdict
from pathlib import Path
from urllib.request import urlopen
from xml.etree import ElementTree

import pytest

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from diagnostic_msgs.msg import DiagnosticArray

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.process_table import RECORDER, node_names, process_names
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.recorder_node import RecorderNode
from hmt_slam_ros.ros.topics import DIAGNOSTICS

ROOT = Path(__file__).resolve().parents[1]
POLICY = ElementTree.parse(ROOT / "config" / "sros2_policy.xml").getroot()
QUALIFIERS = {"topics": {"publish", "subscribe"}, "services": {"request", "reply"}, "actions": {"call", "execute"}}
ACTION = re.compile(r"(.+)/_action/\w+")
LASER = {"laser_pose": "[0.0,0.0,0.0]"}
PROCESSES = {name: {} for name in process_names()} | {"slam": LASER}
COMPANIONS = {
    "robot": {"log": "sim:office,laps=1"},
    "view": {"port": 0},
    "explorer": LASER,
    "team": {"robot_name": "ann"},
}
"""{node: its parameters}; the pilot is left out, as it does not start without a map."""
SOMETIMES = {
    "/clock": "with use_sim_time",
    "/parameter_events": "nodes of rclpy with use_sim_time",
    "/tf_static": "without laser_pose",
    "/ground_truth": "from a simulated log",
    "/cmd_vel": "with robot.drive: commands",
    "/marks": "with marks.topic",
    **dict.fromkeys(
        (
            "/map",
            "/hmt/alternatives",
            "/hmt/landmarks",
            "/explorer/rooms",
            "/pilot/rooms",
            "/hmt/particles",
            "/hmt/ambiguity_goal",
            "/pilot/place_estimate",
            "/scan",
            "/goal_pose",
        ),
        "while the live page is open",
    ),
    "/pose": "goes with hmt/pose",
    "/navigate_to_pose": "where nav2_msgs is installed, and the node drives",
}
"""{topic: when a node that may use it does}."""


def full_name(name, node):
    """A name as the graph has it, of a node in the namespace /."""
    return re.sub(r"^~", f"/{node}", name) if name.startswith("~") else name if name.startswith("/") else f"/{name}"


def permissions():
    """{enclave: {qualifier: full names}}."""
    found = {}
    for enclave in POLICY.iter("enclave"):
        (profile,) = enclave.iter("profile")
        rules = found[enclave.get("path").removeprefix("/hmt_slam/")] = defaultdict(set)
        for group in profile:
            for qualifier in group.attrib:
                rules[qualifier] |= {full_name(rule.text, profile.get("node")) for rule in group}
    return found


def test_it_has_the_form_of_the_schema():
    """policy.xsd of sros2: policy/enclaves/enclave/profiles/profile, with topics, services and actions."""
    assert (POLICY.tag, POLICY.attrib) == ("policy", {"version": "0.2.0"})
    (enclaves,) = POLICY
    assert enclaves.tag == "enclaves"
    for enclave in enclaves:
        assert (enclave.tag, set(enclave.attrib)) == ("enclave", {"path"})
        (profiles,) = enclave
        (profile,) = profiles
        assert (profiles.tag, profile.tag, set(profile.attrib)) == ("profiles", "profile", {"ns", "node"})
        name = enclave.get("path").removeprefix("/hmt_slam/")
        assert profile.get("node") == ("view" if name == "view_commands" else name)
        for group in profile:
            assert set(group.attrib) <= QUALIFIERS[group.tag]
            assert set(group.attrib.values()) == {"ALLOW"}
            assert len(group) > 0
            assert {rule.tag for rule in group} == {group.tag.removesuffix("s")}
            assert all(re.fullmatch(r"(~?/)?[a-z][a-z_/]*", rule.text) for rule in group)


def test_every_node_has_an_enclave_and_only_a_person_requests_also_through_the_page_with_buttons():
    rules = permissions()
    assert list(rules) == [*node_names(), RECORDER.name, "view_commands", "operator"]
    assert [name for name in rules if rules[name]["request"]] == ["view_commands", "operator"]
    view, commands = rules["view"], rules["view_commands"]
    assert commands["request"] == {"/slam/save", "/slam/pause", "/robot/pause"}
    assert commands["publish"] - view["publish"] == {"/initialpose", "/goal_pose", "/explorer/goal", "/statement"}
    assert all(commands[qualifier] == view[qualifier] for qualifier in ("subscribe", "reply", "call", "execute"))
    replies = {name for node in (*node_names(), RECORDER.name) for name in rules[node]["reply"]}
    assert rules["operator"]["request"] == replies
    executed = {name for node in node_names() for name in rules[node]["execute"]}
    assert rules["operator"]["call"] == executed == {"/navigate_to_pose"}
    assert {"/slam/save", "/slam/load", "/slam/change_state", "/tlca/get_map"} <= replies


def test_who_subscribes_to_what_nobody_publishes_needs_a_driver_or_a_person():
    rules = permissions()
    published = {topic for node in rules for topic in rules[node]["publish"]}
    assert {topic for node in rules for topic in rules[node]["subscribe"]} <= published


def used_names(listener, node):
    """{qualifier: full names} of a running node, as DDS reports them."""
    graph = listener.node
    queries = {
        "publish": graph.get_publisher_names_and_types_by_node,
        "subscribe": graph.get_subscriber_names_and_types_by_node,
        "reply": graph.get_service_names_and_types_by_node,
        "request": graph.get_client_names_and_types_by_node,
    }
    used = {qualifier: {name for name, _ in query(node, "/")} for qualifier, query in queries.items()}
    replies = used["reply"]
    used["execute"] = {action[1] for name in replies if (action := ACTION.fullmatch(name))}
    for names in used.values():
        names -= {name for name in names if ACTION.fullmatch(name)}
    return used


def assert_permissions(listener, nodes, enclaves):
    """:param enclaves: {node: its enclave}, of those with another name."""
    rules = permissions()
    for node in nodes:
        for qualifier, used in used_names(listener, node).items():
            allowed = rules[enclaves.get(node, node)][qualifier]
            assert used <= allowed, (node, qualifier, used - allowed)
            assert allowed - used <= SOMETIMES.keys(), (node, qualifier, allowed - used)


def ready_nodes(reported):
    """Names of the nodes that are active, or have no states."""
    status = {status.name: status for one in reported for status in one.status}
    states = {name: {value.key: value.value for value in one.values}.get("state") for name, one in status.items()}
    return {name for name, state in states.items() if state in (None, "active")}


def test_running_processes_and_a_page_with_buttons_use_what_their_enclaves_allow(listener, start):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    processes = start_all(listener, start, PROCESSES | {"view": {"port": port, "controls": True}})
    with urlopen(f"http://127.0.0.1:{port}/news", timeout=20):  # a browser
        listener.until(lambda: "/hmt/landmarks" in used_names(listener, "view")["subscribe"], alive=processes)
        assert_permissions(listener, [*PROCESSES, "view"], {"view": "view_commands"})


def test_running_companions_use_what_their_enclaves_allow(listener, start):
    start_all(listener, start, COMPANIONS)
    assert_permissions(listener, COMPANIONS, {})


def start_all(listener, start, nodes):
    """Start nodes, and wait until they are active."""
    processes = [start(name, **parameters) for name, parameters in nodes.items()]
    reported = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    names = {f"/{name}" for name in nodes}
    listener.until(lambda: ready_nodes(reported) >= names, alive=processes)
    listener.until(lambda: set(listener.node.get_node_names()) >= set(nodes), alive=processes)
    return processes


def test_the_recorder_uses_what_its_enclave_allows(listener):
    recorder = RecorderNode(Configuration(), listener.context, "a_system")
    try:
        listener.until(lambda: RECORDER.name in listener.node.get_node_names())
        assert_permissions(listener, [RECORDER.name], {})
    finally:
        recorder.destroy_node()
