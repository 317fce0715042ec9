"""A simulated robot goes to rooms of a saved map by landmarks: the robot node drives, the pilot leads, slam helps."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Describe the robot, the included localization and the pilot, and their arguments."""
    share = FindPackageShare("hmt_slam_ros")
    common = {"namespace": LaunchConfiguration("namespace"), "output": "screen"}
    return LaunchDescription(
        [
            DeclareLaunchArgument("start_from", description="The saved map, or the output folder around it."),
            DeclareLaunchArgument("world", default_value="sim:institute,seed=3", description="A simulated world."),
            DeclareLaunchArgument("rate", default_value="1.0", description="Speed relative to real time."),
            DeclareLaunchArgument(
                "drives",
                default_value="true",
                choices=["true", "false"],
                description="Whether the pilot drives; else it only says where the robot is.",
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
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(PathJoinSubstitution([share, "launch", "mapping.launch.py"])),
                launch_arguments={
                    "mode": "localization",
                    **{name: LaunchConfiguration(name) for name in ("start_from", "params_file", "namespace", "view")},
                    "use_sim_time": "true",
                }.items(),
            ),
            Node(
                package="hmt_slam_ros",
                executable="robot",
                parameters=[
                    LaunchConfiguration("params_file"),
                    {
                        "log": LaunchConfiguration("world"),
                        "robot.rate": _value("rate", float),
                        "robot.drive": "commands",
                        "use_sim_time": False,
                    },
                ],
                **common,
            ),
            Node(
                package="hmt_slam_ros",
                executable="pilot",
                parameters=[
                    LaunchConfiguration("params_file"),
                    {
                        "start_from": _value("start_from", str),
                        "pilot.drives": _value("drives", bool),
                        "use_sim_time": True,
                    },
                ],
                respawn=True,
                respawn_delay=1.0,
                respawn_max_retries=3,
                **common,
            ),
        ]
    )


def _value(name: str, kind: type) -> ParameterValue:
    return ParameterValue(LaunchConfiguration(name), value_type=kind)
