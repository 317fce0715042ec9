"""``hmt_slam map``: a log becomes an output folder, all in one process."""

from __future__ import annotations

import argparse
import resource
import time

from hmt_slam_ros.cli.arguments import chosen_configuration
from hmt_slam_ros.cli.progress import Progress
from hmt_slam_ros.cli.summary import summary
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs import Log, open_log
from hmt_slam_ros.offline.output_folder import replacing, write_output
from hmt_slam_ros.offline.report import RunFigures
from hmt_slam_ros.offline.runtime import RunResult, run_log


def run(options: argparse.Namespace) -> None:
    """Map the log and say what came of it."""
    configuration = chosen_configuration(options)
    with replacing(options.out) as folder:
        log = open_log(options.log, start=configuration.robot.start, duration=configuration.robot.duration or None)
        if not log.scan_count:
            raise HmtSlamError(f"{options.log} has no scans in the part asked for: check --start and --duration")
        result, figures = measured_run(log, configuration)
        recording = write_output(folder, result.recorder, result.stamps, result.source_stamps, figures)
    print(summary(options.out, recording, log.duration, figures.wall_seconds))


def measured_run(log: Log, configuration: Configuration) -> tuple[RunResult, RunFigures]:
    """Map a log, and measure what that costs."""
    wall, cpu = time.monotonic(), time.process_time()
    with Progress(log.scan_count, log.duration) as progress:
        result = run_log(log, configuration, progress)
    figures = RunFigures(
        log=log.name,
        runtime="lock-step",
        seconds_per_scan=result.seconds_per_scan,
        # ru_maxrss counts in units of 1024 bytes on Linux.
        peak_rss={"hmt_slam": 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss},
        wall_seconds=time.monotonic() - wall,
        cpu_seconds=time.process_time() - cpu,
    )
    return result, figures
