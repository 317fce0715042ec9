"""The configuration tree as ROS parameters, and the few parameters that only the nodes have."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, ParameterType, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from hmt_slam_ros.configuration import Configuration, FlatParameter, flat_parameters, with_changes
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.system_name import SystemName
from hmt_slam_ros.ros.guarded_node import GuardedNode

# Parameters of nodes that the configuration tree does not have.
_NODE_PARAMETERS = (
    *("base_frame", "odom_frame", "map_frame", "team_frame", "laser_frame", "laser_pose"),
    "log",
    "save_to",
    "load_from",
    "save_on_shutdown",
    "start_from",
    "start_lost",
    "initial_pose",
    "recovery",
    "autostart",
    "system",
    "robot_name",
    "team_bandwidth",
)
_ROS_PARAMETERS = ("use_sim_time", "start_type_description_service", "qos_overrides.")


class ConfiguredNode(GuardedNode):
    """A node that has every parameter of the configuration tree as a ROS parameter.

    :cvar changeable_parameters: dotted names of the parameters that may change while the node runs.
    :ivar configuration: the tree with the current values.
    :ivar system: the system that the node belongs to.
    """

    changeable_parameters: tuple[str, ...] = ()

    def __init__(self, name: str, **options: Any) -> None:  # noqa: ANN401  Node's own
        """Declare the parameters with their overrides, and check later changes.

        :raises HmtSlamError: for an invalid value, or an unknown name, which ROS would ignore.
        """
        super().__init__(name, **options)
        self.system = declare_system(self)
        # rclpy has no public list of the overrides.
        self.configuration = _with_values(Configuration(), self._parameter_overrides.values())
        for parameter in flat_parameters(self.configuration):
            is_fixed = parameter.name not in self.changeable_parameters
            self.declare_parameter(parameter.name, parameter.default, _descriptor(parameter, is_fixed=is_fixed))
        self.add_on_set_parameters_callback(self._check_changes)
        self.add_post_set_parameters_callback(self._apply_changes)

    def on_configuration_changed(self, configuration: Configuration) -> None:
        """Apply new values of the changeable parameters."""
        self.configuration = configuration

    def set_parameters(self, parameter_list: list[Parameter]) -> list[SetParametersResult]:
        """Set parameters one by one, as the services do."""
        return [self.set_parameters_atomically([parameter]) for parameter in parameter_list]

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set parameters, as the services do.

        rclpy checks types and ranges before the callbacks, without advice to the user. So the check here comes first.
        """
        result = self._check_changes(parameter_list)
        return super().set_parameters_atomically(parameter_list) if result.successful else result

    def _check_changes(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            _with_values(self.configuration, parameters)
        except HmtSlamError as error:
            return SetParametersResult(successful=False, reason=str(error))
        fixed = sorted(_tree_values(parameters).keys() - set(self.changeable_parameters))
        if fixed:
            reason = f"{fixed[0]} is fixed while the node runs: set it in the parameter file and restart"
            return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)

    def _apply_changes(self, parameters: list[Parameter]) -> None:
        if _tree_values(parameters):
            self.on_configuration_changed(_with_values(self.configuration, parameters))


def _tree_values(parameters: Iterable[Parameter]) -> dict[str, Any]:
    """{name: value} of the parameters in the tree, and of unknown ones."""
    return {
        parameter.name: parameter.value
        for parameter in parameters
        if parameter.name not in _NODE_PARAMETERS and not parameter.name.startswith(_ROS_PARAMETERS)
    }


def _with_values(configuration: Configuration, parameters: Iterable[Parameter]) -> Configuration:
    """The configuration with new values, which must also have the type that ROS wants."""
    changes = _tree_values(parameters)
    changed = with_changes(configuration, changes)
    for parameter in flat_parameters(changed):
        name = parameter.name
        if parameter.kind is float and type(changes.get(name)) is int:
            raise HmtSlamError(f"{name} = {changes[name]} has the wrong type for ROS: write {float(parameter.value)!r}")
    return changed


def _descriptor(parameter: FlatParameter, *, is_fixed: bool) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(
        read_only=is_fixed,
        description=f"{parameter.description} {parameter.unit}".strip(),
        additional_constraints=f"one of {', '.join(parameter.choices)}" if parameter.choices else "",
    )
    low, high = parameter.low, parameter.high
    if low is not None and high is not None:
        if parameter.kind is int:
            descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
        else:
            descriptor.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high))]
    return descriptor


def declare_system(node: Node) -> SystemName:
    """Declare ``system``, and return the system that the node belongs to.

    :raises HmtSlamError: where it is no name.
    """
    descriptor = ParameterDescriptor(
        description="Name of the system of nodes that this one belongs to; messages of another one are left out. Empty "
        "for that of the first message that has one.",
        read_only=True,
    )
    return SystemName(str(node.declare_parameter("system", "", descriptor).value))


def declare_robot_name(node: Node) -> str:
    """Declare ``robot_name``, and return the name of the robot in its team; empty without it and a namespace."""
    descriptor = ParameterDescriptor(
        description="Name of the robot in its team, the same for all its nodes; empty for its namespace.",
        read_only=True,
    )
    name = str(node.declare_parameter("robot_name", "", descriptor).value)
    return name or node.get_namespace().strip("/").replace("/", ".")


def declare_frame(node: Node, which: str, default: str, note: str = "") -> str:
    """Declare the parameter ``<which>_frame``, and return the name of the frame; ``note`` ends its description."""
    descriptor = ParameterDescriptor(description=f"Name of the {which} frame{note}.", read_only=True)
    return str(node.declare_parameter(f"{which}_frame", default, descriptor).value)


def declare_laser_poses(node: Node, topics: Sequence[str]) -> dict[str, NDArray[np.float64]]:
    """Declare ``laser_pose``, and return {topic: ``base_T_laser`` (3,)}, empty where it is.

    :param topics: those of the scans.
    :raises HmtSlamError: for anything but three finite numbers for each topic.
    """
    value = _declare_numbers(
        node,
        "laser_pose",
        "Pose (x, y, theta) of the laser on the robot in m and rad, one after the other for each topic of "
        "sensors.scan_topics; empty for those of /tf_static.",
    )
    if value and len(value) != 3 * len(topics):
        raise HmtSlamError(
            f"laser_pose has {len(value)} numbers, and sensors.scan_topics names {len(topics)} topics: give x, y in m "
            "and theta in rad for each"
        )
    return {topic: _checked_pose("laser_pose", value[3 * k : 3 * k + 3]) for k, topic in enumerate(topics) if value}


def declare_pose(node: Node, name: str, description: str) -> NDArray[np.float64] | None:
    """Declare a parameter that is a pose, and return it, shape (3,), m, m and rad; None where it is empty.

    An empty one is a value: ``ros2 param dump`` ends at a parameter without one.

    :raises HmtSlamError: for anything but three finite numbers.
    """
    value = _declare_numbers(node, name, description)
    return _checked_pose(name, value) if value else None


def _declare_numbers(node: Node, name: str, description: str) -> list[float]:
    """Declare a parameter of numbers, and return them."""
    kind = ParameterType.PARAMETER_DOUBLE_ARRAY
    descriptor = ParameterDescriptor(description=description, type=kind)
    value = node.declare_parameter(name, Parameter.Type.DOUBLE_ARRAY, descriptor).value
    if value is None:
        # Neither a default nor a parameter file can say that an empty list is one of numbers.
        value = []
        node.set_parameters([Parameter(name, Parameter.Type.DOUBLE_ARRAY, value)])
    node.set_descriptor(name, ParameterDescriptor(description=description, type=kind, read_only=True))
    return [float(number) for number in value]


def _checked_pose(name: str, value: list[float]) -> NDArray[np.float64]:
    """The pose of some numbers, shape (3,).

    :raises HmtSlamError: for anything but three finite numbers.
    """
    pose = np.array(value, dtype=np.float64)
    if pose.shape != (3,) or not np.isfinite(pose).all():
        raise HmtSlamError(f"{name} = {value} is no pose: give x, y in m and theta in rad")
    return pose
