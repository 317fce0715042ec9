"""The commands ``map --team`` and ``replay --team``: map several logs at once, and join the maps."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from hmt_slam_ros.cli.arguments import chosen_configuration
from hmt_slam_ros.cli.run_commands import (
    announce_page,
    check_output,
    finish_measured,
    initial_state,
    load_replay,
)
from hmt_slam_ros.cli.terminal import Progress, report_left_out, summary
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs.records import Log
from hmt_slam_ros.messages.team import TeamPlacement
from hmt_slam_ros.offline.team_run import TeamRun
from hmt_slam_ros.open_log import open_configured
from hmt_slam_ros.results.hmt_map import RunState
from hmt_slam_ros.results.merged_map import describe_meeting, read_team, write_merged
from hmt_slam_ros.results.output_folder import atomic_output, map_writer, robot_folder, robot_folders, write_output
from hmt_slam_ros.team.team_map import merge_components


def run_team(options: argparse.Namespace) -> None:
    """Map the logs at once; write the map of the team, and a folder for each robot in it."""
    configuration = _checked_configuration(options)
    states, logs = dict[str, RunState](), dict[str, Log]()
    for name, (path, source) in _sources(options).items():
        configuration, states[name], logs[name] = initial_state(options, path, source)
        report_left_out(logs[name], options.command)
    wall, cpu = time.monotonic(), time.process_time()
    check_output(options.out, options.command)
    with atomic_output(options.out) as folder:
        writers = {}
        for name in logs:
            (folder / name).mkdir()
            writers[name] = map_writer(folder / name)
        run = TeamRun(configuration, logs, _report_at, states=states)
        results = run.run(lambda name, state: writers[name].write_state(state))
        for name, log in logs.items():
            final, stamps, figures = finish_measured(log, results[name], configuration, wall, cpu)
            write_output(folder / name, final, stamps, figures, configuration, writers[name])
            print(summary(options.out / name, final.recording, log.duration, figures.wall_seconds))
        _write_team(folder, list(logs), configuration)


def _sources(options: argparse.Namespace) -> dict[str, tuple[Path, Path | None]]:
    """{robot: its log, and its folder in the results that the run continues, None without}.

    :raises HmtSlamError: unless these are the results of as many robots.
    """
    robots = {robot_folder(n): path for n, path in enumerate([options.log, *options.others], 1)}
    if options.source is None:
        return {name: (path, None) for name, path in robots.items()}
    there = robot_folders(options.source)
    if there != sorted(robots):
        found = f"the results of {len(there)} robots" if there else "no results of a team"
        raise HmtSlamError(
            f"{options.source} has {found}, and {len(robots)} logs are given: with --team, --from is the output folder "
            "of map --team for as many robots"
        )
    return {name: (path, options.source / name) for name, path in robots.items()}


def run_team_replay(options: argparse.Namespace) -> None:
    """Replay the logs at once, each by the nodes of a robot; write what :func:`run_team` writes."""
    configuration, paths = _checked_configuration(options), [options.log, *options.others]
    logs = {robot_folder(n): path for n, path in enumerate(paths, 1)}
    replay = load_replay("team_replay").replay_team
    check_output(options.out, options.command)
    opened = {name: open_configured(path, configuration) for name, path in logs.items()}
    for log in opened.values():
        report_left_out(log, options.command)
    announce_page(options.view, len(logs))
    with atomic_output(options.out) as folder:
        scans, seconds = sum(log.scan_count for log in opened.values()), max(log.duration for log in opened.values())
        with Progress(scans, seconds) as progress:
            results = replay(logs, configuration, folder, progress, options.view, _report)
        for name, result in results.items():
            print(summary(options.out / name, result.recording, opened[name].duration, result.wall_seconds))
        _write_team(folder, list(logs), configuration)


def _write_team(folder: Path, robots: Sequence[str], configuration: Configuration) -> None:
    """Write the map of the team from the folders of its robots, and say what became of each pair."""
    maps = read_team([folder / name for name in robots])
    components = {name: component for robot in maps for name, component in robot.components.items()}
    team = merge_components(components, configuration)
    write_merged(folder, maps, team, configuration)
    print(*map(describe_meeting, team.meetings), sep="\n")


def _checked_configuration(options: argparse.Namespace) -> Configuration:
    """The configuration of a team.

    :raises HmtSlamError: where it is none.
    """
    if not options.others:
        raise HmtSlamError("--team maps several logs at once, and one is given: name another one")
    if getattr(options, "mode", None) is not None:
        raise HmtSlamError("--team maps: leave out --mode")
    return chosen_configuration(options)


def _report_at(seconds: float, placement: TeamPlacement) -> None:
    _report(placement, f"{seconds:.0f} s: ", "map")


def _report(placement: TeamPlacement, time_text: str = "", command: str = "replay") -> None:
    """Say what is new on two robots, once."""
    if placement.robot == placement.first:
        names = f"{placement.second} in the map of {placement.first}"
        sure = f"{placement.verdict.value}, probability {placement.probability:.3f}, apart {placement.apart:.3f}"
        print(f"hmt_slam {command}: {time_text}{names}: {sure}", file=sys.stderr)
