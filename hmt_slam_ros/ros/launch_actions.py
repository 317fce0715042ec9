"""Actions that the launch files share: arguments, nodes, and the included mapping."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from launch import LaunchContext, Substitution
from launch.actions import DeclareLaunchArgument, GroupAction, IncludeLaunchDescription, OpaqueFunction, Shutdown
from launch.events.process import ProcessExited
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, LaunchLogDir, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from hmt_slam_ros.ros.child_processes import EARLIER_SYSTEM

PACKAGE = "hmt_slam_ros"
RESPAWN = {"respawn": True, "respawn_delay": 1.0, "respawn_max_retries": 3}
"""Options of a node that is started again where it was killed."""
FRAMES = {
    "map_frame": "Frame of the map; empty for what the YAML file says, else map.",
    "odom_frame": "Frame of the odometry; empty for what the YAML file says, else that of its messages.",
    "base_frame": "Frame of the robot; empty for what the YAML file says, else that of the odometry's messages.",
}
TOPICS = {
    "scan_topic": ("scan", "Topic of the scans."),
    "odom_topic": ("odom", "Topic of the odometry."),
    "clock_topic": ("/clock", "Topic of the time, for use_sim_time."),
}
"""{argument: topic that is remapped, and description}."""

SCAN_TOPICS = "scan_topics"
"""Argument with the topics of several lasers, which is the parameter ``sensors.scan_topics`` of the nodes."""
_TOPIC_OF_ROBOT = "scan"
"""Topic on which the robot node publishes the scans of all lasers, in the order of their stamps."""


class LaunchName(Substitution):
    """Name of a launch, after its folder of logs; no other launch has the same."""

    def perform(self, context: LaunchContext) -> str:
        """The name, with the characters that the name of a system may have."""
        return re.sub(r"[^\w.:+-]", "_", Path(LaunchLogDir().perform(context)).name, flags=re.ASCII)[-100:]


def shared_path(*parts: str) -> PathJoinSubstitution:
    """Path of a file in the share folder of this package."""
    return PathJoinSubstitution([FindPackageShare(PACKAGE), *parts])


def switch(name: str, default: str, description: str) -> DeclareLaunchArgument:
    """Argument that is true or false."""
    return DeclareLaunchArgument(name, default_value=default, choices=["true", "false"], description=description)


def common_arguments() -> list[DeclareLaunchArgument]:
    """Arguments of all launch files."""
    return [
        DeclareLaunchArgument(
            "params_file",
            default_value=shared_path("config", "hmt_slam.yaml"),
            description="YAML file with the parameters.",
        ),
        DeclareLaunchArgument("namespace", default_value="", description="Namespace of the nodes and their topics."),
        DeclareLaunchArgument(
            "system",
            default_value=LaunchName(),
            description="Name of the system, of which the nodes take messages; by default another one for each launch.",
        ),
        DeclareLaunchArgument("save_to", default_value="hmt_map", description="Folder for the service slam/save."),
        *(DeclareLaunchArgument(name, default_value=topic, description=text) for name, (topic, text) in TOPICS.items()),
        DeclareLaunchArgument(
            SCAN_TOPICS,
            default_value="",
            description="Topics of the scans of several lasers, live or in a bag, separated by commas; empty for what "
            "the YAML file says.",
        ),
        *(DeclareLaunchArgument(name, default_value="", description=text) for name, text in FRAMES.items()),
        switch("view", "false", "Whether the live page is served."),
    ]


def rate_argument() -> DeclareLaunchArgument:
    """Argument for the speed of the robot node."""
    return DeclareLaunchArgument("rate", default_value="1.0", description="Speed relative to real time.")


def world_argument() -> DeclareLaunchArgument:
    """Argument for the world of a simulated robot."""
    return DeclareLaunchArgument("world", default_value="sim:institute,seed=3", description="A simulated world.")


def value(name: str, kind: type) -> ParameterValue:
    """Value of an argument as a parameter of a type."""
    return ParameterValue(LaunchConfiguration(name), value_type=kind)


def node(executable: str, parameters: dict[str, Any], **options: Any) -> OpaqueFunction:  # noqa: ANN401  of launch_ros
    """Node of this package, with the parameter file, topics, frames, the name of the system and further parameters."""

    def make(context: LaunchContext) -> list[Node]:
        arguments = {**{name: name for name in FRAMES}, SCAN_TOPICS: f"sensors.{SCAN_TOPICS}"}
        given = {
            parameter: value(name, str)
            for name, parameter in arguments.items()
            if LaunchConfiguration(name).perform(context)
        }
        named = {"system": value("system", str), **given, **parameters}
        return [
            Node(
                package=PACKAGE,
                executable=executable,
                namespace=LaunchConfiguration("namespace"),
                parameters=[LaunchConfiguration("params_file"), named],
                remappings=topic_remappings(),
                output="screen",
                on_exit=end_beside_earlier_system,
                **options,
            )
        ]

    return OpaqueFunction(function=make)


def end_beside_earlier_system(event: ProcessExited, _context: LaunchContext) -> list[Shutdown]:
    """End the launch where one of its nodes gave way to a system that was started earlier."""
    if event.returncode != EARLIER_SYSTEM:
        return []
    return [Shutdown(reason="a system that was started earlier runs on these topics, as the nodes said")]


def topic_remappings() -> list[tuple[str, LaunchConfiguration]]:
    """Remappings of the topics that the arguments name."""
    return [(topic, LaunchConfiguration(name)) for name, (topic, _) in TOPICS.items()]


def robot(log: str, **parameters: str) -> OpaqueFunction:
    """The robot node, which publishes /clock and so runs on the computer's own clock.

    :param log: name of the argument with the log or world.
    :param parameters: further parameters of the group ``robot``.
    """
    own = {"log": value(log, str), "robot.rate": value("rate", float), "use_sim_time": False}
    return node("robot", own | {f"robot.{name}": setting for name, setting in parameters.items()})


def mapping(*passed: str, **arguments: str) -> GroupAction:
    """The processes beside a robot node, in simulated time, by the included ``mapping.launch.py``.

    In a group, as the arguments of an included file would otherwise hold for the robot, too.

    :param passed: names of arguments to pass on, beside the common ones.
    :param arguments: further arguments.
    """
    names = (*(argument.name for argument in common_arguments()), *passed)
    included = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(shared_path("launch", "mapping.launch.py")),
        launch_arguments={
            "use_sim_time": "true",
            **{name: LaunchConfiguration(name) for name in names},
            SCAN_TOPICS: _TOPIC_OF_ROBOT,
            **arguments,
        }.items(),
    )
    return GroupAction([included])
