"""The seeds: small files of every kind that the package reads, made by the package itself where it writes them."""

from __future__ import annotations

from pathlib import Path

from benchmark.logs import ROOT
from hmt_slam_ros.cli.main import main
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs.stamps import seconds_from_stamp
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.sensors import Odometry, Scan

_BUNDLED = ROOT / "data" / "malaga_one_loop"
_SECONDS = "8"
_TWINS = Path("sim:twins,seed=2")

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


MAP_SEEDS = ("map", "loop", "lines", "twins", "lost", "lost lines")
"""Folders with a map in ``out`` and a log, from the smallest map to those of a robot that is lost."""

_TWO_PARTICLES = ("--set", "filter.particles=2")


def write_map_seeds(folder: Path) -> None:
    """Make the seeds with larger maps, below a folder of seeds; ``log.clf`` goes on from each.

    They have several areas and hypotheses, loop closures, landmarks, maps of lines, and a lost robot.

    :raises HmtSlamError: where one cannot be made.
    """
    twins = folder / "logs" / "twins.clf"
    twins.write_text(carmen_text(_TWINS, 0.0, 58.0), encoding="ascii")
    logs = {name: folder / name / "log.clf" for name in MAP_SEEDS}
    for name, log in logs.items():
        log.parent.mkdir(exist_ok=True)
        text = carmen_text(_TWINS, 58.0, 2.0) if name == "twins" else carmen_text(_BUNDLED, 25.0, 2.0)
        log.write_text(text, encoding="ascii")
        (log.parent / "relations").write_text(_RELATIONS)
    for name, source, settings in (
        ("loop", _BUNDLED, _TWO_PARTICLES),
        ("lines", _BUNDLED, ("--set", "local_map.kind=lines")),
        ("twins", twins, (*_TWO_PARTICLES, "--set", "aam.area_policy=both")),
    ):
        _run("map", str(source), "--out", str(folder / name / "out"), *settings, "--duration", "52")
    for name, before, mode in (("lost", "loop", "lifelong"), ("lost lines", "lines", "mapping")):
        further = ("--from", str(folder / before / "out"), "--mode", mode, "--duration", "1")
        _run("map", str(logs[name]), "--out", str(folder / name / "out"), *further)


def carmen_text(log: Path, start: float = 0.0, duration: float = 4.0) -> str:
    """Some seconds of a log as ODOM and FLASER lines, with every fourth beam."""
    lines = ["PARAM robot_frontlaser_offset 0.1 ipc 0 host 0\n"]
    pose = "0 0 0"
    for record in open_log(log, start=start, duration=duration).records():
        stamp = seconds_from_stamp(record.source_stamp)
        if isinstance(record.measurement, Odometry):
            pose = " ".join(f"{value:.6f}" for value in record.measurement.pose)
            lines.append(f"ODOM {pose} 0 0 0 {stamp} host 0\n")
        elif isinstance(record.measurement, Scan):
            ranges = " ".join(f"{value:.3f}" for value in record.measurement.ranges[::4])
            count = len(record.measurement.ranges[::4])
            lines.append(f"FLASER {count} {ranges} {pose} {pose} {stamp} host 0\n")
    return "".join(lines)


def _run(*arguments: str) -> None:
    if main(arguments):
        raise HmtSlamError(f"hmt_slam {' '.join(arguments)} failed: see above")
