"""The configuration tree as ROS parameters, and the few parameters that only the nodes have."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from hmt_slam_ros.configuration import Configuration, FlatParameter, flat_parameters, with_changes
from hmt_slam_ros.errors import HmtSlamError

# Names that are not in the tree but in a node's parameters all the same.
_NODE_PARAMETERS = ("base_frame", "odom_frame", "map_frame", "laser_pose", "log")
_ROS_PARAMETERS = ("use_sim_time", "start_type_description_service", "qos_overrides.")

ChangeListener = Callable[[Configuration], None]


def declare_configuration(
    node: Node, changeable: Collection[str] = (), changed: ChangeListener | None = None
) -> Configuration:
    """Declare every parameter of the tree, and watch over later changes.

    :param changeable: dotted names that may change while the node runs.
    :param changed: called with the new configuration after each change.
    :returns: the configuration with the values that the node was started with.
    :raises HmtSlamError: for a value that cannot be, or a name that there is not.
    """
    configuration = Configuration()
    _refuse_unknown(node, configuration)
    values = {leaf.name: _declare(node, leaf) for leaf in flat_parameters(configuration)}
    configuration = with_changes(configuration, values)
    watch = _Watch(configuration, changeable, changed or (lambda _: None))
    node.add_on_set_parameters_callback(watch.check)
    node.add_post_set_parameters_callback(watch.apply)
    return configuration


def _refuse_unknown(node: Node, configuration: Configuration) -> None:
    """A misspelt name in a parameter file is told rather than passed over, which is what ROS does."""
    known = {leaf.name for leaf in flat_parameters(configuration)} | set(_NODE_PARAMETERS)
    for name, override in node._parameter_overrides.items():  # rclpy has no public way to list them
        if name not in known and not name.startswith(_ROS_PARAMETERS):
            with_changes(configuration, {name: override.value})


def _declare(node: Node, leaf: FlatParameter) -> Any:  # noqa: ANN401  bool, int, float or str
    descriptor = ParameterDescriptor(
        description=f"{leaf.description} {leaf.unit}".strip(),
        additional_constraints=f"one of {', '.join(leaf.choices)}" if leaf.choices else "",
    )
    _set_range(descriptor, leaf)
    try:
        return node.declare_parameter(leaf.name, leaf.default, descriptor).value
    except (InvalidParameterTypeException, InvalidParameterValueException) as error:
        value = node._parameter_overrides[leaf.name].value
        with_changes(Configuration(), {leaf.name: value})
        raise HmtSlamError(f"{leaf.name} = {value} has the wrong type for ROS: write {float(value)!r}") from error


def _set_range(descriptor: ParameterDescriptor, leaf: FlatParameter) -> None:
    if leaf.low is None or leaf.high is None:
        return
    if leaf.kind is int:
        descriptor.integer_range = [IntegerRange(from_value=int(leaf.low), to_value=int(leaf.high))]
    else:
        descriptor.floating_point_range = [FloatingPointRange(from_value=float(leaf.low), to_value=float(leaf.high))]


class _Watch:
    """Refuses changes that cannot be, and hands on those that can."""

    def __init__(self, configuration: Configuration, changeable: Collection[str], changed: ChangeListener) -> None:
        self._configuration = configuration
        self._changeable = changeable
        self._changed = changed

    def check(self, parameters: list[Parameter]) -> SetParametersResult:
        """Whether all of the changes are possible."""
        changes = {parameter.name: parameter.value for parameter in self._ours(parameters)}
        try:
            with_changes(self._configuration, changes)
        except HmtSlamError as error:
            return SetParametersResult(successful=False, reason=str(error))
        fixed = sorted(changes.keys() - set(self._changeable))
        if fixed:
            reason = f"{fixed[0]} is fixed while the node runs: set it in the parameter file and restart"
            return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)

    def apply(self, parameters: list[Parameter]) -> None:
        """Hand on what was changed."""
        changes = {parameter.name: parameter.value for parameter in self._ours(parameters)}
        if changes:
            self._configuration = with_changes(self._configuration, changes)
            self._changed(self._configuration)

    def _ours(self, parameters: list[Parameter]) -> list[Parameter]:
        names = {leaf.name for leaf in flat_parameters(self._configuration)}
        return [parameter for parameter in parameters if parameter.name in names]


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
