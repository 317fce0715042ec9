"""The command ``merge``: joins maps where they show the same ground."""

from __future__ import annotations

import argparse

from hmt_slam_ros.cli.arguments import chosen_configuration
from hmt_slam_ros.cli.run_commands import check_output
from hmt_slam_ros.results.merged_map import describe_meeting, read_team, write_merged
from hmt_slam_ros.results.output_folder import atomic_output
from hmt_slam_ros.team.team_map import merge_components


def run_merge(options: argparse.Namespace) -> None:
    """Join the maps, write the output folder, and print a sentence on every two pieces that were compared."""
    robots = read_team(options.maps)
    configuration = chosen_configuration(options, robots[0].saved.configuration)
    check_output(options.out, options.command)
    with atomic_output(options.out) as folder:
        components = {name: component for robot in robots for name, component in robot.components.items()}
        team = merge_components(components, configuration)
        write_merged(folder, robots, team, configuration)
    print(*map(describe_meeting, team.meetings), sep="\n")
