"""A simulated robot explores a world by itself: the robot node drives, the processes map, the explorer leads."""

from launch import LaunchDescription

from hmt_slam_ros.ros.launch_actions import (
    RESPAWN,
    common_arguments,
    mapping,
    node,
    rate_argument,
    robot,
    world_argument,
)


def generate_launch_description() -> LaunchDescription:
    """Describe the robot, the included mapping and the explorer, and their arguments."""
    return LaunchDescription(
        [
            world_argument(),
            rate_argument(),
            *common_arguments(),
            mapping(),
            robot("world", drive="commands"),
            node(executable="explorer", parameters={"use_sim_time": True}, **RESPAWN),
        ]
    )
