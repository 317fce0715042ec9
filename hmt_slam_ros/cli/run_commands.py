"""The commands that map a log into an output folder: ``map`` in one process, ``replay`` by the ROS nodes."""

from __future__ import annotations

import argparse
import gc
import shutil
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.cli.arguments import chosen_configuration
from hmt_slam_ros.cli.terminal import Progress, report_left_out, summary
from hmt_slam_ros.configuration import Configuration, with_changes
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs import Log
from hmt_slam_ros.offline.lock_step import RunResult
from hmt_slam_ros.offline.run import run_log
from hmt_slam_ros.open_log import open_configured
from hmt_slam_ros.process_memory import resource_usage
from hmt_slam_ros.results.final_map import FinalMap, deskewed_scans, final_map
from hmt_slam_ros.results.hmt_map import RunState, read_run_state, read_saved_map
from hmt_slam_ros.results.log_reading import describe_log, describe_parameter_changes, is_newest_log, map_folder
from hmt_slam_ros.results.output_folder import (
    RunMetrics,
    atomic_output,
    check_replaceable,
    code_bytes,
    map_writer,
    write_output,
)
from hmt_slam_ros.saved_map.folder import HMT_MAP


def run_map(options: argparse.Namespace) -> None:
    """Map the log, write the output folder and print a summary."""
    check_single_log(options)
    configuration, state, log = initial_state(options, options.log, options.source)
    report_left_out(log, options.command)
    check_output(options.out, options.command)
    log_seconds = log.duration
    with atomic_output(options.out) as folder:
        writer = map_writer(folder)
        final, source_stamps, figures = run_measured(log, configuration, state, writer.write_state, options.jobs)
        del log, state  # they may be large
        write_output(folder, final, source_stamps, figures, configuration, writer)
        if configuration.mode == "localization":
            shutil.rmtree(folder / HMT_MAP)
            shutil.copytree(map_folder(options.source), folder / HMT_MAP)
    print(summary(options.out, final.recording, log_seconds, figures.wall_seconds))


def check_output(directory: Path, command: str) -> None:
    """Check that writing to an output folder loses no data, and say on stderr where it replaces an earlier result.

    :raises HmtSlamError: unless there is nothing, an empty folder or an old output folder.
    """
    check_replaceable(directory.absolute())
    if directory.is_dir() and any(directory.iterdir()):
        sentence = f"{directory} has an earlier result, which is replaced when the new one is complete"
        print(f"hmt_slam {command}: {sentence}", file=sys.stderr)


def initial_state(options: argparse.Namespace, path: Path, source: Path | None) -> tuple[Configuration, RunState, Log]:
    """Configuration, initial state and log of a run.

    :param path: of the log.
    :param source: output folder or map that the run continues, None for none.
    :raises HmtSlamError: where the map is damaged, or the log cannot be read.
    """
    if source is None:
        configuration = chosen_configuration(options)
        if configuration.mode == "localization":
            raise HmtSlamError("mode = localization wants a map to find the robot in: give --from, or map first")
        return configuration, RunState(), open_configured(path, configuration)
    folder = map_folder(source)
    state, saved = read_run_state(folder)
    whole = with_changes(saved, {"robot.duration": 0.0})
    configuration = chosen_configuration(options, whole)
    log = open_configured(path, configuration)
    further = not is_newest_log(state.log, log)
    if further:
        state = replace(state, log=replace(state.log, earlier_trajectory=read_saved_map(folder).relative_trajectory))
        configuration = chosen_configuration(options, with_changes(whole, {"robot.start": 0.0}))
        log = open_configured(path, configuration)
    changes = describe_parameter_changes(saved, configuration, further=further)
    for sentence in filter(None, (describe_log(state.log, log.name, further=further), changes)):
        print(f"hmt_slam map: {sentence}", file=sys.stderr)
    return configuration, state, log


def run_measured(
    log: Log,
    configuration: Configuration,
    state: RunState | None = None,
    on_state: Callable[[RunState], None] | None = None,
    jobs: int = 1,
) -> tuple[FinalMap, NDArray[np.int64], RunMetrics]:
    """Map a log and measure the cost.

    :param state: state from which the run continues.
    :param on_state: called with the state at the end of the log, before the processes receive ``EndOfLog``.
    :param jobs: OS processes.
    :returns: the map, the log's own stamps of all scans, shape (n,), ns, and the figures.
    """
    wall, cpu = time.monotonic(), time.process_time()
    # Libraries and the log stay in memory to the end, so the garbage collector need not scan them.
    gc.freeze()
    with Progress(log.scan_count, log.duration) as progress:
        result = run_log(log, configuration, progress, state=state, on_state=on_state, compact_record=True, jobs=jobs)
    return finish_measured(log, result, configuration, wall, cpu)


def finish_measured(
    log: Log, result: RunResult, configuration: Configuration, wall: float, cpu: float
) -> tuple[FinalMap, NDArray[np.int64], RunMetrics]:
    """The final map of a run and its figures, as :func:`run_measured` has them.

    :param wall: monotonic time at the begin of the run, s.
    :param cpu: time of the process then, s.
    """
    begin = time.process_time()
    recording = result.recorder.finish(
        result.log_progress.stamps, result.log_progress.first_scans, result.log_progress.earlier_trajectory
    )
    final = final_map(recording, partial(deskewed_scans, log, configuration), configuration)
    usage, topology = {"hmt_slam": resource_usage()}, result.topology_usage
    if topology is not None:
        usage["topology"] = topology
    figures = RunMetrics(
        log=log.name,
        runtime="lock-step",
        seconds_per_scan=result.seconds_per_scan,
        peak_rss={name: own.peak_rss for name, own in usage.items()},
        pss={name: own.pss for name, own in usage.items()},
        wall_seconds=time.monotonic() - wall,
        cpu_seconds=time.process_time() - cpu + (topology.cpu_seconds if topology else 0.0),
        refinement_seconds=time.process_time() - begin,
        memory={"particle_maps": result.map_bytes} | code_bytes(),
        speculation=asdict(result.speculation) if result.speculation else {},
    )
    return final, result.log_progress.source_stamps, figures


def run_replay(options: argparse.Namespace) -> None:
    """Start the nodes, wait for the end of the log and print a summary."""
    check_single_log(options)
    configuration = chosen_configuration(options)
    check_output(options.out, options.command)
    log = open_configured(options.log, configuration)
    report_left_out(log, options.command)
    replay = load_replay().replay
    announce_page(options.view)
    with Progress(log.scan_count, log.duration) as progress:
        replayed = replay(options.log, options.out, configuration, progress, view_port=options.view)
    print(summary(options.out, replayed.recording, log.duration, replayed.wall_seconds))


def check_single_log(options: argparse.Namespace) -> None:
    """Check that one log is given.

    :raises HmtSlamError: for several.
    """
    if options.others:
        count = 1 + len(options.others)
        raise HmtSlamError(f"{options.command} takes one log, and {count} are given: give one, or --team")


def load_replay(module: str = "replay") -> ModuleType:
    """The module that replays logs by the nodes, which needs ROS.

    :param module: its name in the package of the nodes.
    :raises HmtSlamError: where ROS is not installed.
    """
    try:
        return import_module(f"hmt_slam_ros.ros.{module}")
    except ImportError as fault:
        raise HmtSlamError(f"replay needs ROS ({fault}): source Jazzy or install its wheels, or use map") from fault


def announce_page(port: int | None, count: int = 1) -> None:
    """Say where the live pages will be, and check their ports.

    :param port: of the first page; the others have the ports after it. None for no page.
    :raises HmtSlamError: where one is taken.
    """
    if port is None:
        return
    from hmt_slam_ros.view.server import LOCAL, check_port  # noqa: PLC0415  Pillow is for the page alone

    for own in range(port, port + count):
        check_port(own)
        print(f"the live page is at http://{LOCAL}:{own}/", file=sys.stderr)
