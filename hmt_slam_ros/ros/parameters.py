"""The configuration tree as ROS parameters, and the few parameters that only the nodes have."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from hmt_slam_ros.configuration import Configuration, FlatParameter, flat_parameters, with_changes
from hmt_slam_ros.errors import HmtSlamError

# Names that are not in the tree but in a node's parameters all the same.
_FRAMES = ("base_frame", "odom_frame", "map_frame", "laser_frame", "laser_pose")
_NODE_PARAMETERS = (
    *_FRAMES,
    "log",
    "save_to",
    "save_on_shutdown",
    "start_from",
    "start_lost",
    "initial_pose",
    "recovery",
    "autostart",
)
_ROS_PARAMETERS = ("use_sim_time", "start_type_description_service", "qos_overrides.")


class ConfiguredNode(Node):
    """A node that has every parameter of the tree as a ROS parameter.

    :ivar configuration: the tree with the values of now.
    """

    def __init__(self, name: str, changeable: Iterable[str] = (), **options: Any) -> None:  # noqa: ANN401  Node's own
        """Declare the parameters with the values that the node is started with, and watch over later changes.

        :param name: of the node.
        :param changeable: dotted names of the parameters that may change while the node runs.
        :raises HmtSlamError: for a value that cannot be, or a name that there is not, which ROS would pass over.
        """
        super().__init__(name, **options)
        self._changeable = frozenset(changeable)
        # rclpy has no public way to list what the node is started with.
        self.configuration = _with_values(Configuration(), self._parameter_overrides.values())
        for leaf in flat_parameters(self.configuration):
            self.declare_parameter(leaf.name, leaf.default, _descriptor(leaf))
        self.add_on_set_parameters_callback(self._check_changes)
        self.add_post_set_parameters_callback(self._apply_changes)

    def on_configuration_changed(self, configuration: Configuration) -> None:
        """Take note of new values of the parameters that may change."""
        self.configuration = configuration

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set parameters, as the services do.

        rclpy looks at types and ranges before it asks the callbacks, and refuses without advice: ours is asked first.
        """
        result = self._check_changes(parameter_list)
        return super().set_parameters_atomically(parameter_list) if result.successful else result

    def _check_changes(self, parameters: list[Parameter]) -> SetParametersResult:
        """Whether all of the changes are possible."""
        try:
            _with_values(self.configuration, parameters)
        except HmtSlamError as error:
            return SetParametersResult(successful=False, reason=str(error))
        fixed = sorted(_tree_values(parameters).keys() - self._changeable)
        if fixed:
            reason = f"{fixed[0]} is fixed while the node runs: set it in the parameter file and restart"
            return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)

    def _apply_changes(self, parameters: list[Parameter]) -> None:
        if _tree_values(parameters):
            self.on_configuration_changed(_with_values(self.configuration, parameters))


def _tree_values(parameters: Iterable[Parameter]) -> dict[str, Any]:
    """Name -> value of those that the tree has, or that nobody has."""
    return {
        parameter.name: parameter.value
        for parameter in parameters
        if parameter.name not in _NODE_PARAMETERS and not parameter.name.startswith(_ROS_PARAMETERS)
    }


def _with_values(configuration: Configuration, parameters: Iterable[Parameter]) -> Configuration:
    """The configuration with new values, which have to be of the type that ROS wants too."""
    changes = _tree_values(parameters)
    changed = with_changes(configuration, changes)
    for leaf in flat_parameters(changed):
        if leaf.kind is float and type(changes.get(leaf.name)) is int:
            raise HmtSlamError(
                f"{leaf.name} = {changes[leaf.name]} has the wrong type for ROS: write {float(leaf.value)!r}"
            )
    return changed


def _descriptor(leaf: FlatParameter) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(
        description=f"{leaf.description} {leaf.unit}".strip(),
        additional_constraints=f"one of {', '.join(leaf.choices)}" if leaf.choices else "",
    )
    if leaf.low is not None and leaf.high is not None:
        if leaf.kind is int:
            descriptor.integer_range = [IntegerRange(from_value=int(leaf.low), to_value=int(leaf.high))]
        else:
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=float(leaf.low), to_value=float(leaf.high))
            ]
    return descriptor


def declare_frame(node: Node, which: str, default: str) -> str:
    """The name of a frame, from the parameter ``<which>_frame``."""
    descriptor = ParameterDescriptor(description=f"Name of the {which} frame.", read_only=True)
    return str(node.declare_parameter(f"{which}_frame", default, descriptor).value)


def declare_laser_pose(node: Node) -> NDArray[np.float64] | None:
    """``base_T_laser`` (3,) from the parameter ``laser_pose``, None where it is not set.

    :raises HmtSlamError: where it is set to something else than three numbers.
    """
    descriptor = ParameterDescriptor(
        description="Pose (x, y, theta) of the laser on the robot in m and rad; where it is not set, /tf_static tells.",
        read_only=True,
    )
    value = node.declare_parameter("laser_pose", Parameter.Type.DOUBLE_ARRAY, descriptor).value
    if value is None:
        return None
    pose = np.array(value, dtype=np.float64)
    if pose.shape != (3,) or not np.isfinite(pose).all():
        raise HmtSlamError(f"laser_pose = {list(value)} is no pose: give x, y in m and theta in rad")
    return pose
