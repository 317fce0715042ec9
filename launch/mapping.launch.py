"""Mapping with a live robot: the processes, which need /scan, /odom and the transform from base to laser."""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, LaunchLogDir, PathJoinSubstitution
from launch_ros.actions import Node

from hmt_slam_ros.process_table import ALL, TEAM, process_names
from hmt_slam_ros.ros.launch_actions import PACKAGE, RESPAWN, common_arguments, node, switch, topic_remappings, value

PARAMETERS = {
    "use_sim_time": bool,
    "start_from": str,
    "start_lost": bool,
    "save_to": str,
    "save_on_shutdown": bool,
    "recovery": str,
    "autostart": bool,
}


def generate_launch_description() -> LaunchDescription:
    """Describe the process nodes, the live page and their arguments."""
    return LaunchDescription([*_arguments(), OpaqueFunction(function=_processes), _view()])


def _arguments() -> list[DeclareLaunchArgument]:
    modes = ["", "mapping", "localization", "lifelong"]
    texts = {
        "start_from": ("", "Saved map to go on from; empty for none."),
        "view_port": ("8800", "Port of the live page on 127.0.0.1."),
        "recovery": (
            PathJoinSubstitution([LaunchLogDir(), "recovery"]),
            "Folder from which a node that was killed goes on.",
        ),
        "log_level": ("info", "Level of the nodes' log output."),
    }
    return [
        *common_arguments(),
        *(DeclareLaunchArgument(name, default_value=text[0], description=text[1]) for name, text in texts.items()),
        DeclareLaunchArgument(
            "mode",
            default_value="",
            choices=modes,
            description="What is done with known ground; empty for what the YAML file says.",
        ),
        switch("view_controls", "false", "Whether the live page has buttons, for those who have its token."),
        switch("use_sim_time", "false", "Take the time from /clock, for a replay or a simulator."),
        switch("start_lost", "true", "Whether the robot may be anywhere in that map; else it is where it was."),
        switch("save_on_shutdown", "false", "Whether the map is saved there before the nodes end."),
        switch("one_program", "false", "Whether one program forks all nodes, which takes two thirds of the memory."),
        switch("autostart", "true", "Whether the nodes begin by themselves; else a lifecycle manager leads them."),
        switch("team", "false", "Whether the robot shares its map with others; its namespace is its name there."),
    ]


def _processes(context: LaunchContext) -> list[OpaqueFunction]:
    parameters = {name: value(name, kind) for name, kind in PARAMETERS.items()}
    mode = LaunchConfiguration("mode").perform(context)
    is_one_program = LaunchConfiguration("one_program").perform(context) == "true"
    if mode:
        parameters["mode"] = mode
    log_level = ["--log-level", LaunchConfiguration("log_level")]
    programs = [ALL] if is_one_program else list(process_names())
    if LaunchConfiguration("team").perform(context) == "true":
        programs.append(TEAM.name)
    return [node(program, parameters, ros_arguments=log_level, **RESPAWN) for program in programs]


_VIEW_PARAMETERS = {"port": ("view_port", int), "controls": ("view_controls", bool), "system": ("system", str)}
"""{parameter of the page: its argument and type}."""


def _view() -> Node:
    return Node(
        package=PACKAGE,
        executable="view",
        namespace=LaunchConfiguration("namespace"),
        parameters=[{name: value(argument, kind) for name, (argument, kind) in _VIEW_PARAMETERS.items()}],
        remappings=topic_remappings(),
        output="screen",
        condition=IfCondition(LaunchConfiguration("view")),
        **RESPAWN,
    )
