"""A run that goes on from a saved map: what it starts with, and what of its configuration may differ."""

from __future__ import annotations

from pathlib import Path

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.configuration.flat import as_flat
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.offline.reading import LogState
from hmt_slam_ros.persistence.hmt_map import HMT_MAP

# Which part of a log is used, how it is played, what is done with known ground, and who drives.
_FREE = ("robot.", "mode", "explorer.", "pilot.")
# Where a log begins that goes on.
_START = "robot.start"
# What the numbers in the state mean depends on these.
SHAPING = ("filter.particles", "local_map.kind", "local_map.cell", "local_map.extent", "local_map.field_radius")


def map_folder(path: Path) -> Path:
    """The folder of the map, where that or the output folder around it is given."""
    inner = path / HMT_MAP
    return inner if inner.is_dir() else path


def which_log(read: LogState, name: str, *, further: bool) -> str:
    """A sentence about whether a log is the newest one of a map, or a further one.

    :param read: what was read of the logs of the map.
    :param name: of the log.
    """
    if further:
        return (
            f"{name} does not begin with the scan with which the log began that the map was made of, so it is a "
            "further one: the robot may be anywhere, and maps on until it is recognized in the map"
        )
    scans = read.stamps.size - read.first_scans[-1]
    return f"{name} is the log that the map was made of, of which {scans} scans are in it: goes on with the next"


def differences(saved: Configuration, asked: Configuration, *, further: bool = False) -> str | None:
    """A sentence about the parameters that change as the run goes on, None where none does.

    :param saved: the configuration of the map.
    :param further: whether the log is a further one, which may begin anywhere.
    :raises HmtSlamError: where one of them cannot change.
    """
    before, now = as_flat(saved), as_flat(asked)
    changed = [name for name in before if before[name] != now[name]]
    fixed = [name for name in changed if name in SHAPING or (name == _START and not further)]
    if fixed:
        raise HmtSlamError(
            f"the map was made with {_listed(fixed, before)}, not with {_listed(fixed, now)}, and cannot go on with "
            "another value: leave that away, or map the log anew"
        )
    free = [name for name in changed if not name.startswith(_FREE)]
    return f"goes on with {_listed(free, now)}; the map was made with {_listed(free, before)}" if free else None


def _listed(names: list[str], values: dict[str, bool | int | float | str]) -> str:
    return " and ".join(f"{name} = {values[name]}" for name in names)
