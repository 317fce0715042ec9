"""Mapping with a live robot: the processes, which want /scan, /odom and the transform from base to laser."""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, LaunchLogDir, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from hmt_slam_ros.process_table import process_names


def generate_launch_description() -> LaunchDescription:
    """Describe the process nodes, the live page and their arguments."""
    return LaunchDescription([*_arguments(), OpaqueFunction(function=_processes), _view()])


def _arguments() -> list[DeclareLaunchArgument]:
    defaults = PathJoinSubstitution([FindPackageShare("hmt_slam_ros"), "config", "hmt_slam.yaml"])
    recovery = PathJoinSubstitution([LaunchLogDir(), "recovery"])
    return [
        DeclareLaunchArgument("params_file", default_value=defaults, description="YAML file with the parameters."),
        _switch("use_sim_time", "false", "Take the time from /clock, for a replay or a simulator."),
        DeclareLaunchArgument("namespace", default_value="", description="Namespace of the nodes and their topics."),
        DeclareLaunchArgument("start_from", default_value="", description="Saved map to go on from; empty for none."),
        DeclareLaunchArgument(
            "mode",
            default_value="",
            choices=["", "mapping", "localization", "lifelong"],
            description="What is done with known ground; empty for what the YAML file says.",
        ),
        _switch("start_lost", "true", "Whether the robot may be anywhere in that map; else it is where it was."),
        DeclareLaunchArgument("save_to", default_value="hmt_map", description="Folder for the service slam/save."),
        _switch("save_on_shutdown", "false", "Whether the map is saved there before the nodes end."),
        _switch("autostart", "true", "Whether the nodes begin by themselves; else a lifecycle manager leads them."),
        _switch("view", "false", "Whether the live page is served."),
        DeclareLaunchArgument("view_port", default_value="8800", description="Port of the live page on 127.0.0.1."),
        DeclareLaunchArgument(
            "recovery", default_value=recovery, description="Folder from which a node that was killed goes on."
        ),
        DeclareLaunchArgument("log_level", default_value="info", description="Level of the nodes' log output."),
    ]


def _switch(name: str, default: str, description: str) -> DeclareLaunchArgument:
    return DeclareLaunchArgument(name, default_value=default, choices=["true", "false"], description=description)


def _value(name: str, kind: type) -> ParameterValue:
    return ParameterValue(LaunchConfiguration(name), value_type=kind)


def _processes(context: LaunchContext) -> list[Node]:
    kinds = {"use_sim_time": bool, "start_from": str, "start_lost": bool}
    kinds |= {"save_to": str, "save_on_shutdown": bool, "recovery": str, "autostart": bool}
    chosen = LaunchConfiguration("mode").perform(context)
    mode = {"mode": chosen} if chosen else {}
    return [
        Node(
            package="hmt_slam_ros",
            executable=process,
            namespace=LaunchConfiguration("namespace"),
            parameters=[
                LaunchConfiguration("params_file"),
                {name: _value(name, kind) for name, kind in kinds.items()} | mode,
            ],
            ros_arguments=["--log-level", LaunchConfiguration("log_level")],
            output="screen",
            respawn=True,
            respawn_delay=1.0,
            respawn_max_retries=3,
        )
        for process in process_names()
    ]


def _view() -> Node:
    return Node(
        package="hmt_slam_ros",
        executable="view",
        namespace=LaunchConfiguration("namespace"),
        parameters=[{"port": _value("view_port", int)}],
        output="screen",
        respawn=True,
        respawn_delay=1.0,
        respawn_max_retries=3,
        condition=IfCondition(LaunchConfiguration("view")),
    )
