"""Cost of the live page: CPU time of the node view with a large map, everything at a high rate, and a browser."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple
from urllib.request import urlopen

import numpy as np
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Bool, Float64, String

from benchmark.report import Report, Requirement, table
from benchmark.running_nodes import Listener, cpu_seconds
from benchmark.settings import Settings
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.alternatives import Alternative, AlternativeArea, Alternatives
from hmt_slam_ros.messages.documents import KeyframeHeader, encode
from hmt_slam_ros.messages.map_changes import ArcEnds
from hmt_slam_ros.messages.messages import ClosureDecision, Hypotheses, Hypothesis, HypothesisEstimate, Keyframe
from hmt_slam_ros.messages.topology import Topology, TopologyArc, TopologyArea, TopologyHypothesis
from hmt_slam_ros.registration.consistency import Clutter
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import area_frame, keyframe_frame, pose_with_covariance_message, scan_message
from hmt_slam_ros.ros.topics import DOCUMENTS
from hmt_slam_ros.sensors import Scan

SHARE_BOUND = 0.10
"""Largest share of a core of the node view with a browser."""

AREAS, KEYFRAMES, RATE = 200, 10, 10.0
"""Areas of the map, keyframes of each, and messages of every kind a second."""

_CELLS = 1200
"""Cells of a side of the grid, which comes every 3 s."""

_BEAMS = 361
_GRID_PERIOD = 3.0
_DURATION = 30.0
_WARM_UP = 5.0

POLICY = (
    f"A publisher sends, {RATE:g} times a second each, pose, scan of {_BEAMS} beams, 12 particles, the documents of a "
    f"keyframe event with its scan, and the whole map of {AREAS} areas with {KEYFRAMES} keyframes each and a second "
    f"hypothesis; every {_GRID_PERIOD:g} s a grid of {_CELLS} x {_CELLS} cells. tlca itself sends whole maps once a "
    "second at most. A browser stands for a page: it reads the stream and each new picture. CPU time of the node is "
    f"taken over {_DURATION:g} s, after {_WARM_UP:g} s."
)


class PageCost(NamedTuple):
    """What a page costs.

    :ivar share: of a core.
    :ivar memory: resident, bytes.
    :ivar stream: bytes that the browser got a second.
    """

    share: float
    memory: int
    stream: float


def measure_page(_settings: Settings) -> Report:
    """Measure the node with a browser and without one."""
    costs = {browsers: measure_cost(browsers, _DURATION) for browsers in (1, 0)}
    report = Report("page", "Cost of the live page")
    report.requirements = [Requirement("share of a core of view, with a browser", costs[1].share, SHARE_BOUND)]
    rows = [
        [f"{browsers}", f"{100.0 * cost.share:.1f} %", f"{1e-6 * cost.memory:.0f} MB", f"{1e-3 * cost.stream:.0f} kB/s"]
        for browsers, cost in costs.items()
    ]
    report.body = [table(["browsers", "share of a core", "memory", "stream"], rows), POLICY]
    return report


def measure_cost(browsers: int, duration: float, areas: int = AREAS, rate: float = RATE) -> PageCost:
    """What the page costs with so many browsers.

    :param duration: of the measurement, s.
    :param rate: messages of every kind a second.
    """
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with Listener() as listener, listener.running("view", {"port": port}) as process:
        send = _make_sender(listener, areas)
        listener.wait_until(lambda: socket.socket().connect_ex(("127.0.0.1", port)) == 0)
        with _browsers(port, browsers) as received:
            _send_until(listener, send, time.monotonic() + min(_WARM_UP, duration), rate)
            begin, cpu, before = time.monotonic(), cpu_seconds(process), sum(received)
            _send_until(listener, send, begin + duration, rate)
            elapsed = time.monotonic() - begin
            share, stream = (cpu_seconds(process) - cpu) / elapsed, (sum(received) - before) / elapsed
            pages = Path(f"/proc/{process.pid}/statm").read_text(encoding="utf-8").split()[1]
            memory = int(pages) * os.sysconf("SC_PAGE_SIZE")
    return PageCost(share, memory, stream)


def _send_until(listener: Listener, send: Callable[[], None], end: float, rate: float) -> None:
    due = time.monotonic()
    while time.monotonic() < end:
        send()
        due += 1.0 / rate
        listener.spin_once()
        time.sleep(max(0.0, due - time.monotonic()))


@contextmanager
def _browsers(port: int, count: int) -> Iterator[list[int]]:
    """Browsers that read the stream and the pictures; the bytes that each has read."""
    received, is_over = [0] * count, threading.Event()

    def read(number: int) -> None:
        with suppress(OSError), urlopen(f"http://127.0.0.1:{port}/news", timeout=20) as stream:
            for line in stream:
                received[number] += len(line)
                if b'"map":' in line:
                    with suppress(OSError), urlopen(f"http://127.0.0.1:{port}/map.png", timeout=20) as picture:
                        received[number] += len(picture.read())
                if is_over.is_set():
                    return

    threads = [threading.Thread(target=read, args=(number,), daemon=True) for number in range(count)]
    for thread in threads:
        thread.start()
    yield received
    is_over.set()


def _make_sender(listener: Listener, areas: int) -> Callable[[], None]:
    """A function that publishes one message of every kind, and a grid where one is due."""
    create = listener.node.create_publisher
    documents = {kind: create(String, DOCUMENTS[kind], topics.CHAIN_HISTORY) for kind in _CHAIN}
    maps = {kind: create(String, DOCUMENTS[kind], topics.LATCHED) for kind in (Topology, Alternatives)}
    texts = {kind: encode(message) for kind, message in (_make_topology(areas), _make_alternatives(areas))}
    poses = create(PoseWithCovarianceStamped, topics.POSE, topics.STREAM)
    area_poses = create(PoseWithCovarianceStamped, topics.HMT_POSE, topics.STREAM)
    scans, keyframe_scans = (
        create(LaserScan, topic, profile)
        for topic, profile in ((topics.SCAN, topics.STREAM), (topics.KEYFRAME_SCANS, topics.CHAIN_HISTORY))
    )
    particles, grids = (
        create(PoseArray, topics.PARTICLES, topics.STREAM),
        create(OccupancyGrid, topics.MAP, topics.LATCHED),
    )
    localized, entropies = (
        create(Bool, topics.IS_LOCALIZED, topics.LATCHED),
        create(Float64, topics.ENTROPY, topics.LATCHED),
    )
    belief, cloud = PoseGaussian(np.zeros(3), 1e-4 * np.eye(3)), PoseArray()
    scan = Scan(0, np.full(_BEAMS, 4.0, dtype=np.float32), -np.pi, 0.0174, 0.05, 30.0, np.zeros(3))
    grid = _make_grid()
    event, grid_at = 0, 0.0

    def send() -> None:
        nonlocal event, grid_at
        stamp = (1000 + event) * 100_000_000
        now = replace(scan, stamp=stamp)
        pose = PoseGaussian(np.array([0.01 * event, 0.0, 0.0]), belief.covariance)
        poses.publish(pose_with_covariance_message(stamp, "map", pose))
        area_poses.publish(pose_with_covariance_message(stamp, area_frame(0), pose))
        scans.publish(scan_message(now, "laser"))
        keyframe_scans.publish(scan_message(now, keyframe_frame(event)))
        for kind, message in _event_messages(event, now, pose):
            documents[kind].publish(String(data=encode(message)))
        for kind, publisher in maps.items():
            publisher.publish(String(data=texts[kind].replace('"events":1,', f'"events":{event + 1},')))
        cloud.poses = [pose_with_covariance_message(stamp, "map", pose).pose.pose] * 12
        particles.publish(cloud)
        localized.publish(Bool(data=True))
        entropies.publish(Float64(data=0.01 * event))
        if time.monotonic() >= grid_at:
            grid.data[event % 1000] = 100
            grids.publish(grid)
            grid_at = time.monotonic() + _GRID_PERIOD
        event += 1

    return send


_CHAIN: tuple[type, ...] = (KeyframeHeader, Hypotheses, ClosureDecision)


def _event_messages(event: int, scan: Scan, pose: PoseGaussian) -> list[tuple[type, object]]:
    """The documents of a keyframe event with two hypotheses."""
    estimates = tuple(HypothesisEstimate(h, 0, pose, True, 0.0, 0.0, Clutter(), 12.0) for h in (0, 1))
    header = KeyframeHeader.from_keyframe(Keyframe(event, scan, 0.1 * event, estimates))
    share = 0.5 + 0.4 * np.sin(0.1 * event)
    answer = Hypotheses(event, (Hypothesis(0, 0, share, 0), Hypothesis(1, 1, 1.0 - share, 1)))
    return [(KeyframeHeader, header), (Hypotheses, answer), (ClosureDecision, ClosureDecision(event))]


def _ring_pose(area: int, areas: int) -> np.ndarray:
    angle, radius = 2.0 * np.pi * area / areas, 0.7 * areas
    return np.array([radius * np.cos(angle), radius * np.sin(angle), angle])


def _make_topology(areas: int) -> tuple[type, Topology]:
    """A ring of areas."""
    spread = np.diag([0.05, 0.03, 0.02]) ** 2
    poses = [_ring_pose(area, areas) for area in range(areas)]
    local = tuple(np.array([0.0, 0.5 * k, 1.571]) for k in range(KEYFRAMES))
    rows = tuple(
        TopologyArea(
            area,
            PoseGaussian(pose, spread),
            tuple(range(area * KEYFRAMES, (area + 1) * KEYFRAMES)),
            (1_700_000_000_000_000_000,) * KEYFRAMES,
            local,
        )
        for area, pose in enumerate(poses)
    )
    arcs = tuple(
        TopologyArc(a, a + 1, PoseGaussian(se2.between(poses[a], poses[a + 1]), spread), False, 1.0)
        for a in range(areas - 1)
    )
    hypotheses = (TopologyHypothesis(0, 0.9, 0), TopologyHypothesis(1, 0.1, 1))
    return Topology, Topology(1, 1_700_000_000_000_000_000, "map", hypotheses, 0.0, 0, local[0], rows, arcs, ())


def _make_alternatives(areas: int) -> tuple[type, Alternatives]:
    placed = tuple(AlternativeArea(area, _ring_pose(area, areas)) for area in range(areas))
    return Alternatives, Alternatives(1, 0, (Alternative(1, 1, np.zeros(3), placed, (), (ArcEnds(0, 1),)),))


def _make_grid() -> OccupancyGrid:
    cells = np.full((_CELLS, _CELLS), -1, dtype=np.int8)
    cells[100:1100, 100:1100] = 0
    cells[100:1100:50] = 100
    grid = OccupancyGrid(data=cells.ravel().tolist())
    grid.info.width = grid.info.height = _CELLS
    grid.info.resolution, grid.info.origin.orientation.w = 0.05, 1.0
    return grid
