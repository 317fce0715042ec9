"""For tests of the nodes: a small log of a drive along a corridor, with odometry faster than the scans."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from worlds import box, scan_in

from hmt_slam_ros.logs import LogRecord
from hmt_slam_ros.logs.writer import write_bag
from hmt_slam_ros.sensors import Odometry

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
LASER = np.array([0.1, 0.0, 0.05])
REAR_LASER = np.array([-0.2, 0.1, 3.0])
PACE = np.array([0.025, 0.0, 0.002])
BEAMS = 91
MAPPED_SCANS = 120
"""Scans of the drive that the fixture ``corridor`` maps."""
WALLS = np.concatenate([box(-3, -3, 12, 3), box(4, 1, 5, 3)])


@dataclass
class Corridor:
    """Scans every 0.2 s, four odometry readings to each, at 0.5 m/s; a scan's sweep takes ``sweep`` s.

    Before the scan of a number the robot is kidnapped along its route, by the path of ``carried`` scans.
    While the laser is ``silent``, from one scan to before another, only odometry comes.
    A rear laser scans in the middle of the time between two scans.
    """

    scans: int = 12
    name: str = "corridor"
    sweep: float = 0.0
    carried: tuple[int, int] = (0, 0)
    beams: int = BEAMS
    silent: range = range(0)
    has_rear_laser: bool = False

    @property
    def scan_count(self):
        return self.scans - len(self.silent) + (self.scans - 1) * self.has_rear_laser

    @property
    def duration(self):
        return 0.2 * (self.scans - 1)

    def records(self):
        for k in range(4 * (self.scans - 1) + 1):
            stamp = START + k * SECOND // 20
            yield LogRecord(stamp, Odometry(stamp, k * PACE))
            if k % 4 == 0 and k // 4 not in self.silent:
                yield LogRecord(stamp, self._scan(k, stamp, LASER))
            elif k % 4 == 2 and self.has_rear_laser:
                yield LogRecord(stamp, self._scan(k, stamp, REAR_LASER))

    def _scan(self, k, stamp, laser_pose):
        along = k + 4 * self.carried[1] * (k >= 4 * self.carried[0])
        poses = (along + 20.0 * self.sweep * np.linspace(0.0, 1.0, self.beams)[:, None]) * PACE
        return scan_in(WALLS, poses, stamp, beams=self.beams, laser_pose=laser_pose, sweep=self.sweep)


def corridor_bag(folder, scans=12, **others):
    """The corridor as a rosbag2 folder."""
    path = folder / "corridor"
    write_bag(Corridor(scans, **others), path)
    return path


def is_alive(pid):
    """Whether an OS process runs."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
