#!/usr/bin/env python3
"""Draw the simulated worlds with the robot's way through them: docs/images/worlds.png."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np

from hmt_slam_ros.simulation import FAMILIES, open_simulated
from hmt_slam_ros.simulation.building import furniture_walls

mpl.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.collections import LineCollection

PICTURE = Path(__file__).resolve().parents[1] / "docs" / "images" / "worlds.png"
SEED = 1


def main() -> None:
    """Draw one building of every family."""
    figure, axes = plt.subplots(2, (len(FAMILIES) + 1) // 2, figsize=(12.0, 6.5), layout="constrained")
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, name in zip(axes.flat, FAMILIES, strict=False):
        scenario = open_simulated(f"sim:{name},seed={SEED}").scenario
        walls = np.concatenate((scenario.building.walls, furniture_walls(scenario.building.furniture)))
        axis.add_collection(LineCollection(walls.reshape(-1, 2, 2).tolist(), colors="black", linewidths=0.8))
        axis.plot(*scenario.poses[:, :2].T, color="tab:red", linewidth=0.8)
        people = scenario.people.discs_at(0.0, scenario.poses[0])
        axis.plot(*people[:, :2].T, "o", color="tab:blue", markersize=3.0)
        axis.set_aspect("equal")
        axis.set_title(f"{name}, {scenario.drive.path.lengths.sum():.0f} m")
    figure.savefig(PICTURE, dpi=90)


if __name__ == "__main__":
    main()
