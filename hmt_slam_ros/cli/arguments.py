"""The command line: its parser, and the configuration that it asks for."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import NoReturn

from hmt_slam_ros import __version__
from hmt_slam_ros.configuration import Configuration, load_configuration

_VIEW_PORT = 8800
"""The port of hmt_slam_ros.view.server, which takes too long to load for a help text."""
_LOG = "rosbag2 folder, .mcap or .db3 file, CARMEN log, MRPT rawlog, or sim:WORLD"


class OneSentenceParser(argparse.ArgumentParser):
    """A parser whose error message is one line."""

    def error(self, message: str) -> NoReturn:
        """Print the message and exit with status 2."""
        self.exit(2, f"{self.prog}: {message}: see {self.prog} --help\n")


def build_parser() -> argparse.ArgumentParser:
    """The parser of ``hmt_slam``.

    A parsed subcommand has its name in ``command`` and its "module:function" in ``function``.
    """
    top = OneSentenceParser(prog="hmt_slam", description="Hybrid metric-topological SLAM.")
    top.add_argument("--version", action="version", version=f"hmt_slam_ros {__version__}")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for add_arguments, module, name, description in (
        (_add_map_arguments, "run_commands", "map", "map a log, all in one process, the same for one seed"),
        (_add_replay_arguments, "run_commands", "replay", "map a log by a simulated robot and the ROS nodes"),
        (_add_view_arguments, "view_commands", "view", "serve the live page of a recorded run"),
        (_add_convert_arguments, "log_commands", "convert", "write a log as a rosbag2"),
        (_add_simulate_arguments, "log_commands", "simulate", "write a drive through a simulated world as a rosbag2"),
        (_add_merge_arguments, "merge_commands", "merge", "join maps where they show the same ground"),
        (_add_evaluate_arguments, "result_commands", "evaluate", "errors of an output folder against true relations"),
        (_add_plot_arguments, "result_commands", "plot", "draw map, probabilities and cost of an output folder"),
        (_add_export_arguments, "result_commands", "export", "write a map's topology as GraphML, or its grid for nav2"),
        (_add_doctor_arguments, "log_commands", "doctor", "say what is wrong with a log or with the running system"),
        (_add_configuration, "arguments", "parameters", "print every parameter as a YAML file"),
        (_add_nothing, "kernel_commands", "compile", "compile all kernels for this machine, once"),
    ):
        command = commands.add_parser(name, help=description)
        command.set_defaults(function=f"hmt_slam_ros.cli.{module}:run_{name}")
        add_arguments(command)
    return top


def chosen_configuration(options: argparse.Namespace, base: Configuration | None = None) -> Configuration:
    """The configuration of a command: defaults, ``--config``, ``--set``, then the options named like parameters.

    :param base: configuration that replaces the defaults.
    :raises HmtSlamError: for a missing file, an unknown name or an invalid value.
    """
    named = {"mode": "mode", "start": "robot.start", "duration": "robot.duration", "rate": "robot.rate"}
    settings = list(options.settings)
    for option, name in named.items():
        value = getattr(options, option, None)
        settings += [] if value is None else [f"{name}={value}"]
    return load_configuration(options.config, settings, options.seed, base)


def run_parameters(options: argparse.Namespace) -> None:
    """Print every parameter with its description, as a file that ``--config`` and ROS read."""
    from hmt_slam_ros.configuration.documents import ros_yaml  # noqa: PLC0415  no other command needs it

    print(ros_yaml(chosen_configuration(options)), end="")


def _add_nothing(_command: argparse.ArgumentParser) -> None:
    """A command without arguments."""


def _add_map_arguments(command: argparse.ArgumentParser) -> None:
    _add_log_and_output(command)
    command.add_argument(
        "--from",
        type=Path,
        dest="source",
        metavar="MAP",
        help="output folder or hmt_map of a part of the log or of other logs, to go on from with its parameters",
    )
    command.add_argument(
        "--mode",
        choices=("mapping", "localization", "lifelong"),
        help="localization leaves the map of --from as it is, lifelong changes it only where the world has",
    )
    _add_team(command, "run_team")
    command.add_argument(
        "--jobs",
        type=_count,
        default=len(os.sched_getaffinity(0)),
        metavar="N",
        help="OS processes, of which two have work; by default one for each core. The results are the same",
    )


def _add_team(command: argparse.ArgumentParser, function: str) -> None:
    command.add_argument(
        "others", type=Path, nargs="*", metavar="LOG", help="with --team: the logs of the other robots"
    )
    command.add_argument(
        "--team",
        action="store_const",
        dest="function",
        const=f"hmt_slam_ros.cli.team_commands:{function}",
        help="map several logs at once, each as a robot with an unknown start, and join what shows the same ground",
    )


def _count(text: str) -> int:
    if not text.isdecimal() or not int(text):
        raise argparse.ArgumentTypeError(f"{text} is not a whole number from 1 on")
    return int(text)


def _add_replay_arguments(command: argparse.ArgumentParser) -> None:
    _add_log_and_output(command)
    _add_team(command, "run_team_replay")
    command.add_argument("--rate", type=float, help="speed relative to real time; also --set robot.rate=F")
    command.add_argument(
        "--view",
        type=int,
        nargs="?",
        const=_VIEW_PORT,
        metavar="PORT",
        help=f"serve the live page of the run on 127.0.0.1, port {_VIEW_PORT} where none is given",
    )


def _add_view_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument("bag", type=Path, metavar="BAG", help="rosbag2 of all topics of a run: folder, .mcap or .db3")
    command.add_argument("--rate", type=_rate, default=1.0, metavar="F", help="speed; 0 for as fast as possible")
    command.add_argument("--port", type=int, default=_VIEW_PORT, metavar="PORT", help="of the page, on 127.0.0.1")
    command.add_argument("--namespace", metavar="NAME", help="robot of the page, where several were recorded")


def _rate(text: str) -> float:
    try:
        rate = float(text)
    except ValueError:
        rate = -1.0
    if not 0.0 <= rate < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is no speed: give 0 or more")
    return rate


def _add_log_and_output(command: argparse.ArgumentParser) -> None:
    command.add_argument("log", type=Path, metavar="LOG", help=_LOG)
    command.add_argument("--out", type=Path, required=True, metavar="DIR", help="output folder; an old one is replaced")
    _add_configuration(command)
    _add_time_window(command)


def _add_configuration(command: argparse.ArgumentParser) -> None:
    command.add_argument("--seed", type=int, metavar="N", help="seed of all random numbers")
    command.add_argument("--config", type=Path, metavar="FILE", help="YAML file with parameters")
    command.add_argument(
        "--set", action="append", default=[], dest="settings", metavar="NAME=VALUE", help="set one parameter"
    )


def _add_time_window(command: argparse.ArgumentParser) -> None:
    command.add_argument("--start", type=float, metavar="S", help="seconds of the log to skip")
    command.add_argument("--duration", type=float, metavar="S", help="seconds of the log to use; 0 for all")


def _add_convert_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument("source", type=Path, metavar="SRC", help=_LOG)
    command.add_argument("destination", type=Path, metavar="DST", help="rosbag2 folder to make")
    command.add_argument("--marks", default="", metavar="TOPIC", help="topic of a bag's observations of marks, to keep")
    _add_scan_topics(command)
    _add_storage(command)
    _add_time_window(command)


def _add_scan_topics(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--scans", default="/scan", metavar="TOPICS", help="topics of a bag's scans, separated by commas"
    )


def _add_storage(command: argparse.ArgumentParser) -> None:
    command.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap", help="format of the bag's file")


def _add_simulate_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "world", metavar="WORLD", help="family of buildings or .yaml file, see docs/guides/simulation.md"
    )
    command.add_argument("--out", type=Path, required=True, metavar="BAG", help="rosbag2 folder to make")
    command.add_argument("--seed", type=int, metavar="N", help="seed of building, noise, people and furniture")
    command.add_argument(
        "--set", action="append", default=[], dest="settings", metavar="NAME=VALUE", help="set one setting of the world"
    )
    _add_storage(command)
    _add_time_window(command)


def _add_merge_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument("maps", type=Path, nargs="+", metavar="MAP", help="output folders or hmt_maps, two or more")
    command.add_argument("--out", type=Path, required=True, metavar="DIR", help="output folder; an old one is replaced")
    _add_configuration(command)


def _add_evaluate_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument("directory", type=Path, metavar="DIR", help="output folder")
    true = command.add_mutually_exclusive_group(required=True)
    true.add_argument("--relations", type=Path, metavar="FILE", help="lines t1 t2 x y z r p yaw")
    true.add_argument("--truth", type=Path, metavar="LOG", help="the log, if it was simulated and knows the truth")
    command.add_argument(
        "--odometry", type=Path, metavar="LOG", help="the log, to reach times without a pose within 0.1 s"
    )


def _add_plot_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument("directory", type=Path, metavar="DIR", help="output folder, in which the pictures are put")


def _add_export_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "directory", type=Path, metavar="DIR", help="output folder, in which the file is put; for --grid also a hmt_map"
    )
    command.add_argument(
        "--grid", type=Path, metavar="FOLDER", help="write map.pgm and map.yaml for nav2 there instead"
    )
    command.add_argument("--resolution", type=float, metavar="M", help="side of a cell of the grid; default: as mapped")
    command.add_argument("--area", type=int, metavar="N", help="the grid of one area alone, in that area's frame")


def _add_doctor_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument("log", type=Path, nargs="?", metavar="LOG", help=_LOG)
    command.add_argument(
        "--live", action="store_true", help="listen to the running system instead, by default to the scans of its slam"
    )
    command.add_argument("--seconds", type=float, default=10.0, metavar="S", help="how long to listen to it")
    command.add_argument("--json", action="store_true", help="print the findings as JSON")
    _add_scan_topics(command)
    _add_time_window(command)
    command.add_argument(
        "--ros-args",
        nargs=argparse.REMAINDER,
        default=[],
        dest="ros_arguments",
        metavar="ARG",
        help="with --live: namespace and remappings, such as -r __ns:=/robot1",
    )
