"""The configuration tree as ROS parameters."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from logs_for_nodes import corridor_bag
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters, SetParametersAtomically
from rclpy.context import Context
from rclpy.parameter import Parameter, parameter_value_to_python

from hmt_slam_ros.configuration import Configuration, flat_parameters
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.ros.parameters import ConfiguredNode, declare_laser_poses, declare_robot_name


@pytest.fixture
def make(domain):
    contexts = []

    def make(*arguments, changeable=()):
        class TestedNode(ConfiguredNode):
            changeable_parameters = changeable

        context = Context()
        context.init(args=["--ros-args", *arguments], domain_id=domain)
        contexts.append(context)
        return TestedNode("tested", context=context)

    yield make
    for context in contexts:
        context.try_shutdown()


@pytest.fixture
def robot(tmp_path, listener, start):
    """A robot node that runs as a process of its own, and its services by their last name."""
    start("robot", log=corridor_bag(tmp_path), robot__discovery_timeout=3600.0)
    return lambda kind, name, **request: listener.call(kind, f"robot/{name}", kind.Request(**request))


def message(name, value):
    """As `ros2 param set` sends it."""
    return Parameter(name, value=value).to_parameter_msg()


def test_every_parameter_has_its_default_its_description_and_its_range(robot):
    leaves = [leaf for leaf in flat_parameters(Configuration()) if leaf.name != "robot.discovery_timeout"]
    names = [leaf.name for leaf in leaves]
    values = robot(GetParameters, "get_parameters", names=names).values
    descriptors = robot(DescribeParameters, "describe_parameters", names=names).descriptors
    for leaf, value, descriptor in zip(leaves, values, descriptors, strict=True):
        assert parameter_value_to_python(value) == leaf.default
        assert descriptor.description.startswith(leaf.description)
        ranges = [*descriptor.floating_point_range, *descriptor.integer_range]
        assert [(allowed.from_value, allowed.to_value) for allowed in ranges] == (
            [(leaf.low, leaf.high)] if leaf.kind in (int, float) else []
        )
        assert all(choice in descriptor.additional_constraints for choice in leaf.choices)


def test_a_value_from_the_command_line_reaches_the_configuration_and_the_parameter(make):
    node = make("-p", "filter.particles:=30")
    assert node.configuration.filter.particles == node.get_parameter("filter.particles").value == 30


@pytest.mark.parametrize(
    ("setting", "sentence"),
    [
        ("filter.particles:=0", r"filter\.particles = 0 .*1"),
        ("filter.particles:=many", r"filter\.particles = 'many' is not a whole number"),
        ("robot.rate:=2", r"robot\.rate = 2 .*write 2\.0"),
        ("filter.particels:=30", "did you mean filter.particles"),
        ("local_map.field_radius:=0.06", "contradicts itself"),
    ],
)
def test_a_value_that_cannot_be_is_refused_with_advice(make, setting, sentence):
    with pytest.raises(HmtSlamError, match=sentence):
        make("-p", setting)


def test_parameters_of_ros_itself_and_of_the_nodes_are_no_misspellings(make):
    node = make("-p", "use_sim_time:=false", "-p", "log:=x", "-p", "base_frame:=base")
    assert node.configuration == Configuration()


def test_a_change_within_reason_reaches_a_running_node(robot):
    (result,) = robot(SetParameters, "set_parameters", parameters=[message("robot.rate", 4.0)]).results
    assert result.successful
    (value,) = robot(GetParameters, "get_parameters", names=["robot.rate"]).values
    assert value.double_value == 4.0


def test_a_change_within_reason_reaches_the_configuration(make):
    node = make(changeable=("robot.rate",))
    assert node.set_parameters([Parameter("robot.rate", value=4.0)])[0].successful
    assert node.configuration.robot.rate == 4.0


REFUSED = [
    ("robot.rate", -1.0, "robot.rate = -1.0 is out of range: use a number from 0 to 1000"),
    (
        "robot.max_unacknowledged_scans",
        0,
        "robot.max_unacknowledged_scans = 0 is out of range: use a whole number from 1 to 10000",
    ),
    ("robot.rate", 2, "robot.rate = 2 has the wrong type for ROS: write 2.0"),
    ("robot.flow_control", "no", "robot.flow_control = 'no' is not true or false: use true or false"),
    ("robot.rat", 2.0, "there is no parameter 'robot.rat': did you mean robot.rate"),
    ("filter.particles", 20, "filter.particles is fixed while the node runs: set it in the parameter file"),
    ("local_map.field_radius", 0.06, "contradicts itself"),
]


def test_a_running_node_refuses_a_change_that_cannot_be_with_advice(robot):
    """As the command line refuses it, and all over DDS: the words are those that `ros2 param set` shows."""
    changes = [message(name, value) for name, value, _ in REFUSED]
    results = robot(SetParameters, "set_parameters", parameters=changes).results
    for (name, _, sentence), result in zip(REFUSED, results, strict=True):
        assert not result.successful, name
        assert sentence in result.reason
    mixed = [message("robot.rate", 4.0), message("robot.max_unacknowledged_scans", 0)]
    result = robot(SetParametersAtomically, "set_parameters_atomically", parameters=mixed).result
    assert "robot.max_unacknowledged_scans = 0 is out of range: use" in result.reason
    values = robot(GetParameters, "get_parameters", names=["robot.rate", "robot.max_unacknowledged_scans"]).values
    assert [parameter_value_to_python(value) for value in values] == [1.0, 20]


def test_a_parameter_is_not_taken_away(robot):
    nothing = ParameterMessage(name="robot.rate")
    (result,) = robot(SetParameters, "set_parameters", parameters=[nothing]).results
    assert "robot.rate = None is not a number: use" in result.reason


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("robot.rate", -1.0, "range"),
        ("filter.particles", 20, "is fixed while the node runs"),
        ("local_map.field_radius", 0.06, "contradicts itself"),
    ],
)
def test_a_node_cannot_change_its_own_parameters_past_the_check(make, name, value, sentence):
    node = make(changeable=("robot.rate",))
    result = node.set_parameters([Parameter(name, value=value)])[0]
    assert not result.successful
    assert sentence in result.reason
    assert node.configuration == Configuration()


def test_every_parameter_of_a_node_has_a_value_and_fixed_ones_are_read_only(listener, start):
    """`ros2 param dump` prints nothing where one has no value."""
    start("slam")
    names = listener.call(ListParameters, "slam/list_parameters", ListParameters.Request()).result.names
    assert {"laser_pose", "initial_pose", "mode", "filter.particles"} <= set(names)
    request = GetParameters.Request(names=names)
    values = listener.call(GetParameters, "slam/get_parameters", request).values
    assert [n for n, value in zip(names, values, strict=True) if value.type == ParameterType.PARAMETER_NOT_SET] == []
    described = listener.call(DescribeParameters, "slam/describe_parameters", DescribeParameters.Request(names=names))
    changeable = {each.name for each in described.descriptors if not each.read_only}
    of_the_tree = {leaf.name for leaf in flat_parameters(Configuration())}
    assert changeable & of_the_tree == {"mode"}


def test_an_empty_pose_of_a_parameter_file_is_none(make, tmp_path):
    """As `ros2 param dump` writes it."""
    file = tmp_path / "slam.yaml"
    file.write_text("tested:\n  ros__parameters:\n    laser_pose: []\n")
    node = make("--params-file", str(file))
    assert declare_laser_poses(node, ["scan"]) == {}
    assert list(node.get_parameter("laser_pose").value) == []


def test_a_laser_pose_is_three_numbers(make):
    assert declare_laser_poses(make(), ["scan"]) == {}
    for topics, numbers in ((["scan"], [0.1, 0.0, 1.5]), (["front", "rear"], [0.2, 0.0, 0.0, -0.2, 0.0, 3.0])):
        poses = declare_laser_poses(make("-p", f"laser_pose:={numbers}"), topics)
        assert np.concatenate([poses[topic] for topic in topics]).tolist() == numbers
    with pytest.raises(HmtSlamError, match=r"laser_pose has 3 numbers, and sensors\.scan_topics names 2"):
        declare_laser_poses(make("-p", "laser_pose:=[0.1, 0.0, 0.0]"), ["front", "rear"])
    with pytest.raises(HmtSlamError, match="is no pose"):
        declare_laser_poses(make("-p", "laser_pose:=[0.1, .nan, 0.0]"), ["scan"])


def test_the_name_of_a_robot_is_its_namespace_unless_it_has_another_one(make):
    assert declare_robot_name(make()) == ""
    assert declare_robot_name(make("-r", "__ns:=/hall/ann")) == "hall.ann"
    assert declare_robot_name(make("-r", "__ns:=/hall/ann", "-p", "robot_name:=bob")) == "bob"
