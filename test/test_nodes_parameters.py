"""The configuration tree as ROS parameters."""

import pytest

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter

from hmt_slam_ros.configuration import Configuration, flat_parameters
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.nodes.parameters import declare_configuration, declare_laser_pose


@pytest.fixture
def make(domain):
    contexts = []

    def make(*arguments):
        context = Context()
        context.init(args=["--ros-args", *arguments], domain_id=domain)
        contexts.append(context)
        return Node("tested", context=context)

    yield make
    for context in contexts:
        context.try_shutdown()


def test_every_parameter_has_its_default_its_description_and_its_range(make):
    node = make()
    declare_configuration(node)
    for leaf in flat_parameters(Configuration()):
        assert node.get_parameter(leaf.name).value == leaf.default
        descriptor = node.describe_parameter(leaf.name)
        assert descriptor.description.startswith(leaf.description)
        ranges = list(descriptor.floating_point_range) + list(descriptor.integer_range)
        if leaf.low is not None and leaf.high is not None:
            assert (ranges[0].from_value, ranges[0].to_value) == (leaf.low, leaf.high)


def test_a_value_from_the_command_line_reaches_the_configuration(make):
    assert declare_configuration(make("-p", "filter.particles:=30")).filter.particles == 30


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
        declare_configuration(make("-p", setting))


def test_parameters_of_ros_itself_and_of_the_nodes_are_no_misspellings(make):
    declare_configuration(make("-p", "use_sim_time:=false", "-p", "log:=x", "-p", "base_frame:=base"))


def test_a_change_within_reason_reaches_the_node(make):
    node, heard = make(), []
    declare_configuration(node, ("robot.rate",), heard.append)
    assert node.set_parameters([Parameter("robot.rate", value=4.0)])[0].successful
    assert [configuration.robot.rate for configuration in heard] == [4.0]


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("robot.rate", -1.0, "range"),
        ("robot.window", 0, "range"),
        ("filter.particles", 20, "is fixed while the node runs"),
        ("local_map.field_radius", 0.06, "contradicts itself"),
    ],
)
def test_a_change_that_cannot_be_is_refused_with_a_reason(make, name, value, sentence):
    node, heard = make(), []
    declare_configuration(node, ("robot.rate", "robot.window"), heard.append)
    result = node.set_parameters([Parameter(name, value=value)])[0]
    assert not result.successful
    assert sentence in result.reason
    assert not heard


def test_a_laser_pose_is_three_numbers(make):
    assert declare_laser_pose(make()) is None
    assert declare_laser_pose(make("-p", "laser_pose:=[0.1, 0.0, 1.5]")).tolist() == [0.1, 0.0, 1.5]
    with pytest.raises(HmtSlamError, match="is no pose"):
        declare_laser_pose(make("-p", "laser_pose:=[0.1, 0.0]"))
