"""Mapping with a live robot: the five processes, which want /scan, /odom and the transform from base to laser."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, LaunchLogDir, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

PROCESSES = ("slam", "aam", "tsbi", "tlca", "rtl")


def generate_launch_description() -> LaunchDescription:
    """Describe the five process nodes and their arguments."""
    defaults = PathJoinSubstitution([FindPackageShare("hmt_slam_ros"), "config", "hmt_slam.yaml"])
    use_sim_time = ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)
    arguments = [
        DeclareLaunchArgument("params_file", default_value=defaults, description="YAML file with the parameters."),
        DeclareLaunchArgument(
            "use_sim_time",
            default_value="false",
            choices=["true", "false"],
            description="Take the time from /clock, for a replay or a simulator.",
        ),
        DeclareLaunchArgument("namespace", default_value="", description="Namespace of the nodes and their topics."),
        DeclareLaunchArgument("start_from", default_value="", description="Saved map to go on from; empty for none."),
        DeclareLaunchArgument(
            "start_carried",
            default_value="true",
            choices=["true", "false"],
            description="Whether the robot may be anywhere in that map; otherwise it is where it was.",
        ),
        DeclareLaunchArgument("save_to", default_value="hmt_map", description="Folder for the service slam/save."),
        DeclareLaunchArgument(
            "save_at_end",
            default_value="false",
            choices=["true", "false"],
            description="Whether the map is saved there before the nodes end.",
        ),
        DeclareLaunchArgument(
            "view", default_value="false", choices=["true", "false"], description="Whether the live page is served."
        ),
        DeclareLaunchArgument("view_port", default_value="8800", description="Port of the live page on 127.0.0.1."),
        DeclareLaunchArgument(
            "recovery",
            default_value=PathJoinSubstitution([LaunchLogDir(), "recovery"]),
            description="Folder from which a node that was killed goes on where it was.",
        ),
        DeclareLaunchArgument("log_level", default_value="info", description="Level of the nodes' log output."),
    ]
    folders = ("start_from", "save_to", "recovery")
    saving = {name: ParameterValue(LaunchConfiguration(name), value_type=str) for name in folders}
    for name in ("save_at_end", "start_carried"):
        saving[name] = ParameterValue(LaunchConfiguration(name), value_type=bool)
    nodes = [
        Node(
            package="hmt_slam_ros",
            executable=process,
            namespace=LaunchConfiguration("namespace"),
            parameters=[LaunchConfiguration("params_file"), {"use_sim_time": use_sim_time}, saving],
            ros_arguments=["--log-level", LaunchConfiguration("log_level")],
            output="screen",
            respawn=True,
            respawn_delay=1.0,
            respawn_max_retries=3,
        )
        for process in PROCESSES
    ]
    view = Node(
        package="hmt_slam_ros",
        executable="view",
        namespace=LaunchConfiguration("namespace"),
        parameters=[{"port": ParameterValue(LaunchConfiguration("view_port"), value_type=int)}],
        output="screen",
        condition=IfCondition(LaunchConfiguration("view")),
    )
    return LaunchDescription([*arguments, *nodes, view])
