"""The last lines of a run."""

from __future__ import annotations

from pathlib import Path

from hmt_slam_ros.offline.recorder import Recording


def summary(directory: Path, recording: Recording, log_seconds: float, wall_seconds: float) -> str:
    """What the processes had to tell, what came of the run and how long it took.

    :param log_seconds: that the log lasts.
    :param wall_seconds: that the run took.
    """
    arcs = [arc for _, _, arc in recording.hybrid_map.all_arcs()]
    totals = recording.totals
    outcome = (
        f"{directory}: {totals.processed} of {totals.scans_in} scans, {totals.dropped} dropped; "
        f"areas: {len(recording.area_poses)}, arcs: {len(arcs)}, "
        f"of them loop closures: {sum(arc.closure for arc in arcs)}; "
        f"{wall_seconds:.1f} s, {log_seconds / max(wall_seconds, 1e-9):.1f} x real time"
    )
    return "\n".join([*(f"{notice.process}: {notice.text}" for notice in recording.notices), outcome])
