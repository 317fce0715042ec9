"""A simulated robot goes to rooms of a saved map by landmarks: the robot node drives, the pilot leads, slam helps."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument

from hmt_slam_ros.ros.launch_actions import (
    RESPAWN,
    common_arguments,
    mapping,
    node,
    rate_argument,
    robot,
    switch,
    value,
    world_argument,
)


def generate_launch_description() -> LaunchDescription:
    """Describe the robot, the included localization and the pilot, and their arguments."""
    parameters = {"start_from": value("start_from", str), "pilot.drives": value("drives", bool), "use_sim_time": True}
    return LaunchDescription(
        [
            DeclareLaunchArgument("start_from", description="The saved map, or the output folder around it."),
            switch("drives", "true", "Whether the pilot drives; else it only says where the robot is."),
            world_argument(),
            rate_argument(),
            *common_arguments(),
            mapping("start_from", mode="localization"),
            robot("world", drive="commands"),
            node(executable="pilot", parameters=parameters, **RESPAWN),
        ]
    )
