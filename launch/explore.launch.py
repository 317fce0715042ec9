"""A simulated robot explores a world by itself: the robot node drives, the processes map, the explorer leads."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Describe the robot, the included mapping and the explorer, and their arguments."""
    share = FindPackageShare("hmt_slam_ros")
    rate = ParameterValue(LaunchConfiguration("rate"), value_type=float)
    common = {"namespace": LaunchConfiguration("namespace"), "output": "screen"}
    return LaunchDescription(
        [
            DeclareLaunchArgument("world", default_value="sim:institute,seed=3", description="A simulated world."),
            DeclareLaunchArgument("rate", default_value="1.0", description="Speed relative to real time."),
            DeclareLaunchArgument(
                "view", default_value="false", choices=["true", "false"], description="Whether the live page is served."
            ),
            DeclareLaunchArgument(
                "params_file",
                default_value=PathJoinSubstitution([share, "config", "hmt_slam.yaml"]),
                description="YAML file with the parameters.",
            ),
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of nodes and topics."),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(PathJoinSubstitution([share, "launch", "mapping.launch.py"])),
                launch_arguments={
                    "use_sim_time": "true",
                    "params_file": LaunchConfiguration("params_file"),
                    "namespace": LaunchConfiguration("namespace"),
                    "view": LaunchConfiguration("view"),
                }.items(),
            ),
            Node(
                package="hmt_slam_ros",
                executable="robot",
                parameters=[
                    LaunchConfiguration("params_file"),
                    {
                        "log": LaunchConfiguration("world"),
                        "robot.rate": rate,
                        "robot.drive": "commands",
                        "use_sim_time": False,
                    },
                ],
                **common,
            ),
            Node(
                package="hmt_slam_ros",
                executable="explorer",
                parameters=[LaunchConfiguration("params_file"), {"use_sim_time": True}],
                respawn=True,
                respawn_delay=1.0,
                respawn_max_retries=3,
                **common,
            ),
        ]
    )
