"""Which process computes when, for ten seconds around the loop closure of the bundled log: one line for each node."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from std_msgs.msg import String

from benchmark.live import play_log
from benchmark.logs import BUNDLED, open_logs
from benchmark.report import Report, table
from benchmark.running_nodes import Listener
from benchmark.settings import Settings
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.documents import decode
from hmt_slam_ros.messages.messages import ClosureDecision
from hmt_slam_ros.process_table import process_names
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.topics import DOCUMENTS

RATE = 2.6
"""Factor on real time, with which the bundled log has ten scans a second."""

AROUND = 5.0
"""Time before and after the closure that is shown, s."""

PERIOD = 0.01
"""Time between two samples, s."""

PICTURE = "timeline.png"
_DPI = 110


def measure_timeline(settings: Settings) -> Report:
    """Draw the processor time of each node around the first loop closure."""
    with open_logs([BUNDLED]) as (log,):
        drive = record_drive(str(log.path))
    if not drive.closures:
        raise HmtSlamError("no loop closes in the bundled log: see whether scripts/demo.sh closes it")
    closure = drive.closures[0]
    shown = np.abs(drive.times - closure) < AROUND
    times, shares = drive.times[shown] - closure, {name: own[shown] for name, own in drive.shares.items()}
    report = Report("timeline", "Which process computes when")
    draw_timeline(settings.out / PICTURE, times, shares, [one - closure for one in drive.closures])
    report.pictures[PICTURE] = (
        f"Share of a core that each node takes, in steps of {1e3 * PERIOD:.0f} ms, around the loop closure of the "
        "bundled log at ten scans a second. Dotted: closures are accepted."
    )
    rows = [[name, f"{100.0 * own.mean():.1f}", f"{100.0 * own.max():.0f}"] for name, own in shares.items()]
    report.body.append(table(["node", "share of a core, mean [%]", "largest [%]"], rows))
    report.data = {"times": times.tolist(), "shares": {name: own.tolist() for name, own in shares.items()}}
    return report


class Drive(NamedTuple):
    """What the nodes did.

    :ivar times: of the samples, shape (n,), s since the epoch.
    :ivar shares: {node: share of a core since the sample before, shape (n,)}.
    :ivar closures: times at which loop closures were accepted, s since the epoch.
    """

    times: NDArray[np.float64]
    shares: dict[str, NDArray[np.float64]]
    closures: list[float]


def record_drive(log: str) -> Drive:
    """Drive with all nodes."""
    closures: list[float] = []

    def add_decision(message: String, info: dict[str, Any]) -> None:
        if any(arc.closure for arc in decode(message.data, ClosureDecision).arcs):
            closures.append(1e-9 * info["source_timestamp"])

    with ExitStack() as stack:
        listener = stack.enter_context(Listener())
        pids = {name: stack.enter_context(listener.running(name, {})).pid for name in process_names()}
        listener.node.create_subscription(String, DOCUMENTS[ClosureDecision], add_decision, topics.CHAIN)
        with record_samples(pids) as samples:
            play_log(listener, log, 0.0, rate=RATE)
    rows = np.array(samples)
    shares = np.diff(rows[:, 1:], axis=0) / np.diff(rows[:, 0])[:, None]
    return Drive(rows[1:, 0], dict(zip(pids, shares.T, strict=True)), closures)


@contextmanager
def record_samples(pids: Mapping[str, int]) -> Iterator[list[list[float]]]:
    """Samples of the time, and of the time that the main thread of each process was on a core, s."""
    samples: list[list[float]] = []
    ended = threading.Event()

    def sample() -> None:
        while not ended.wait(PERIOD):
            samples.append([time.time(), *map(_running_seconds, pids.values())])

    thread = threading.Thread(target=sample)
    thread.start()
    try:
        yield samples
    finally:
        ended.set()
        thread.join()


def _running_seconds(pid: int) -> float:
    return 1e-9 * int(Path(f"/proc/{pid}/schedstat").read_text(encoding="ascii").split()[0])


def draw_timeline(
    path: Path, times: NDArray[np.float64], shares: Mapping[str, NDArray[np.float64]], closures: Sequence[float]
) -> None:
    """Draw one line for each node.

    :param path: of the picture.
    :param times: shape (n,), s.
    :param shares: {node: share of a core up to each time, shape (n,)}.
    :param closures: times of loop closures.
    """
    figure = Figure(figsize=(11.0, 4.0), layout="constrained")
    axes = figure.subplots()
    names = list(shares)[::-1]
    for row, name in enumerate(names):
        axes.fill_between(times, row, row + 0.9 * np.minimum(shares[name], 1.0), step="pre", linewidth=0.0)
    for closure in closures:
        if times[0] <= closure <= times[-1]:
            axes.axvline(closure, color="black", linewidth=0.8, linestyle=":")
    axes.set_yticks(np.arange(len(names)) + 0.45, names)
    axes.set(xlabel="time from the closure [s]", xlim=(times[0], times[-1]), ylim=(0.0, len(shares)))
    figure.savefig(path, dpi=_DPI)
