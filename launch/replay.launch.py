"""Replay of a log: the robot node plays it, the processes map it on the log's own clock, RViz may watch."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from hmt_slam_ros.ros.launch_actions import common_arguments, mapping, rate_argument, robot, shared_path, switch


def generate_launch_description() -> LaunchDescription:
    """Describe the robot node, the included mapping and RViz, and their arguments."""
    bundled = shared_path("data", "malaga_one_loop")
    formats = "A rosbag2, CARMEN log, MRPT rawlog, or sim:WORLD."
    return LaunchDescription(
        [
            DeclareLaunchArgument("log", default_value=bundled, description=formats),
            rate_argument(),
            switch("rviz", "false", "Whether RViz is started."),
            switch("team", "false", "Whether the robot shares its map with others; its namespace is its name there."),
            *common_arguments(),
            # Where rviz2 is not installed, launch gives up before the other nodes run.
            Node(
                package="rviz2",
                executable="rviz2",
                arguments=["-d", shared_path("config", "hmt_slam.rviz")],
                parameters=[{"use_sim_time": True}],
                condition=IfCondition(LaunchConfiguration("rviz")),
            ),
            mapping("team"),
            robot("log"),
        ]
    )
