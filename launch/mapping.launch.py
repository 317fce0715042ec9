"""Mapping with a live robot: the five processes, which want /scan, /odom and the transform from base to laser."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
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
        DeclareLaunchArgument("log_level", default_value="info", description="Level of the nodes' log output."),
    ]
    saving = {name: ParameterValue(LaunchConfiguration(name), value_type=str) for name in ("start_from", "save_to")}
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
        )
        for process in PROCESSES
    ]
    return LaunchDescription([*arguments, *nodes])
