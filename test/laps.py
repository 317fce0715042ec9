"""Maps of the laps of simulated drives, each by itself."""

from functools import cache

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.offline.run import run_log
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.team.components import Component

CONFIGURATION = Configuration(seed=50)


@cache
def map_lap(world, number):
    """The map of the first or the second half of a drive, which goes twice along the same way."""
    duration = open_log(world).duration
    log = open_log(world, start=0.5 * duration * number, duration=0.5 * duration)
    result = run_log(log, CONFIGURATION)
    progress = result.log_progress
    recording = result.recorder.finish(progress.stamps, progress.first_scans, progress.earlier_trajectory)
    return Component.of_map(recording.hybrid_map, recording.replica.scans)
