"""The seeds: small files of every kind that the package reads, made by the package itself where it writes them."""

from __future__ import annotations

from pathlib import Path

from benchmark.logs import ROOT
from hmt_slam_ros.cli.main import main
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs.stamps import seconds_from_stamp
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.sensors import Odometry

_BUNDLED = ROOT / "data" / "malaga_one_loop"
_SECONDS = "8"

_WORLD = """\
walls: [[0, 0, 8, 0], [8, 0, 8, 6], [8, 6, 0, 6], [0, 6, 0, 0]]
furniture: [[4, 3, 30, 1, 0.5]]
route: [[1, 1], [7, 1], [7, 5]]
settings:
  range: 8.0
"""

_RELATIONS = "0.1 2.0 0.4 0.0 0 0 0 0.02\n2.0 3.0 0.2 0.0 0 0 0 -0.4\n"


def write_seeds(folder: Path) -> None:
    """Make every seed below a folder.

    :raises HmtSlamError: where one cannot be made.
    """
    for storage in ("mcap", "sqlite3"):
        kind = {"mcap": "mcap", "sqlite3": "sqlite"}[storage]
        _run("convert", str(_BUNDLED), str(folder / kind / "bag"), "--duration", _SECONDS, "--storage", storage)
    logs = folder / "logs"
    logs.mkdir(parents=True)
    (logs / "log.clf").write_text(carmen_text(_BUNDLED), encoding="ascii")
    (logs / "log.rawlog").write_bytes((ROOT / "test" / "corpus" / "rawlog" / "seed").read_bytes())
    (logs / "config.yaml").write_text("mode: mapping\nseed: 3\nfilter:\n  particles: 4\naam:\n  area_policy: ncut\n")
    (logs / "world.yaml").write_text(_WORLD, encoding="utf-8")
    target = folder / "map"
    target.mkdir()
    _run("convert", str(_BUNDLED), str(target / "bag"), "--duration", _SECONDS)
    _run("map", str(target / "bag"), "--out", str(target / "out"), "--set", "filter.particles=2", "--duration", "5")
    (target / "relations").write_text(_RELATIONS)


def carmen_text(log: Path) -> str:
    """A log's first seconds as ODOM and FLASER lines."""
    lines = ["PARAM robot_frontlaser_offset 0.1 ipc 0 host 0\n"]
    pose = "0 0 0"
    for record in open_log(log, duration=4.0).records():
        stamp = seconds_from_stamp(record.source_stamp)
        if isinstance(record.measurement, Odometry):
            pose = " ".join(f"{value:.6f}" for value in record.measurement.pose)
            lines.append(f"ODOM {pose} 0 0 0 {stamp} host 0\n")
        else:
            ranges = " ".join(f"{value:.3f}" for value in record.measurement.ranges[::4])
            count = len(record.measurement.ranges[::4])
            lines.append(f"FLASER {count} {ranges} {pose} {pose} {stamp} host 0\n")
    return "".join(lines)


def _run(*arguments: str) -> None:
    if main(arguments):
        raise HmtSlamError(f"hmt_slam {' '.join(arguments)} failed: see above")
