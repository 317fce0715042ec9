"""Replay of a log: the robot node plays it, the processes map it on the log's own clock, RViz may watch."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.conditions import IfCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Describe the robot node, the included mapping and RViz, and their arguments."""
    share = FindPackageShare("hmt_slam_ros")
    rate = ParameterValue(LaunchConfiguration("rate"), value_type=float)
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "log",
                default_value=PathJoinSubstitution([share, "data", "malaga_one_loop"]),
                description="A rosbag2, CARMEN log, MRPT rawlog, or sim:WORLD.",
            ),
            DeclareLaunchArgument("rate", default_value="1.0", description="Speed relative to real time."),
            DeclareLaunchArgument(
                "rviz", default_value="false", choices=["true", "false"], description="Whether RViz is started."
            ),
            DeclareLaunchArgument(
                "view", default_value="false", choices=["true", "false"], description="Whether the live page is served."
            ),
            DeclareLaunchArgument(
                "params_file",
                default_value=PathJoinSubstitution([share, "config", "hmt_slam.yaml"]),
                description="YAML file with the parameters.",
            ),
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of nodes and topics."),
            # Where rviz2 is not installed, launch gives up before the other nodes run.
            Node(
                package="rviz2",
                executable="rviz2",
                arguments=["-d", PathJoinSubstitution([share, "config", "hmt_slam.rviz"])],
                parameters=[{"use_sim_time": True}],
                condition=IfCondition(LaunchConfiguration("rviz")),
            ),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(PathJoinSubstitution([share, "launch", "mapping.launch.py"])),
                launch_arguments={
                    "use_sim_time": "true",
                    "params_file": LaunchConfiguration("params_file"),
                    "namespace": LaunchConfiguration("namespace"),
                    "view": LaunchConfiguration("view"),
                }.items(),
            ),
            # The robot makes /clock, so it alone runs on the computer's own clock.
            Node(
                package="hmt_slam_ros",
                executable="robot",
                namespace=LaunchConfiguration("namespace"),
                parameters=[
                    LaunchConfiguration("params_file"),
                    {"log": LaunchConfiguration("log"), "robot.rate": rate, "use_sim_time": False},
                ],
                output="screen",
            ),
        ]
    )
