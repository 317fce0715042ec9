"""The final refinement, from the small run of test_output_folder whose right answer is known."""

from dataclasses import replace

import numpy as np
from test_results_output_folder import EVERY, SCANS, STAMPS, TRUTH, make_recorder, scan

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.results.final_map import final_map
from hmt_slam_ros.results.recorder import Recording
from hmt_slam_ros.sensors import Scan


def with_wrong_odometry(recording: Recording) -> Recording:
    """Odometry that turns by 10 degrees more from each keyframe to the next."""
    wrong = np.radians(10.0) / EVERY * np.arange(SCANS)
    return replace(recording, odometry=recording.odometry + np.stack([0.0 * wrong, 0.0 * wrong, wrong], axis=1))


def blind(seen: Scan) -> Scan:
    return replace(seen, ranges=np.full_like(seen.ranges, np.inf))


def test_where_no_scans_overlap_the_motion_that_metric_slam_found_stands() -> None:
    recorder = make_recorder()
    recording = with_wrong_odometry(recorder.finish(STAMPS))
    replica = replace(recording.replica, scans={k: blind(seen) for k, seen in recording.replica.scans.items()})
    scans = [blind(scan(index)) for index in range(SCANS)]
    found = final_map(replace(recording, replica=replica), scans, recorder.configuration).recording.trajectory
    off = se2.between(TRUTH, found)
    assert np.hypot(off[:, 0], off[:, 1]).max() < 1e-6
    assert np.abs(off[:, 2]).max() < 1e-6
