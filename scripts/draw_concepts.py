#!/usr/bin/env python3
"""Draw the pictures of docs/concepts: docs/images/concept_*.svg, the same bytes at every call.

Usage: scripts/draw_concepts.py [--png FOLDER]; PNG copies are for inspection. The pictures compute their own examples,
such as the overlap of scans, in a few lines, so that they show the idea and not the program.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
from concept_pictures import data_flow, scans, team, topology
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"
STYLE = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.0,
    "svg.fonttype": "none",
    "svg.hashsalt": "hmt_slam_ros",
    "axes.titlesize": 10.0,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "mathtext.fontset": "dejavusans",
}

PICTURES: dict[str, Callable[[], Figure]] = {
    "data_flow": data_flow.data_flow,
    "areas_and_partition": topology.areas_and_partition,
    "inference": topology.inference,
    "closure": topology.closure,
    "relocalization": topology.relocalization,
    "team": team.team,
    "registration": scans.registration,
    "lifelong": scans.lifelong,
}


def write(folder: Path, png: Path | None = None) -> None:
    """Draw all pictures.

    :param folder: for the SVG files.
    :param png: for copies as PNG, None for none.
    """
    with mpl.rc_context(STYLE):
        for name, draw in PICTURES.items():
            figure = draw()
            path = folder / f"concept_{name}.svg"
            figure.savefig(path, metadata={"Date": None, "Creator": None})
            text = path.read_text(encoding="utf-8")
            path.write_text("\n".join(line.rstrip() for line in text.splitlines()) + "\n", encoding="utf-8")
            if png is not None:
                figure.savefig(png / f"concept_{name}.png", dpi=110)
            plt.close(figure)


def main() -> None:
    """Write docs/images/concept_*.svg."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--png", type=Path, metavar="FOLDER", help="copies as PNG")
    write(IMAGES, parser.parse_args().png)


if __name__ == "__main__":
    main()
