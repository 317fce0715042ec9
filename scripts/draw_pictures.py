#!/usr/bin/env python3
"""Draw the pictures of README.md and docs/guides/tutorial.md from runs, and reduce all files in docs/images.

malaga_map.png is the map of the bundled log, twins_pmf.png the probabilities of a simulated drive through two identical
rooms. worlds.png, view.png, closure.webp and concept_*.svg have separate scripts, which this one runs. view.png and
closure.webp need a browser: the old ones stay without one.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
IMAGES = ROOT / "docs" / "images"
# Name of the picture: log, picture of its output folder, width in pixels.
PICTURES = {
    "malaga_map.png": ("data/malaga_one_loop", "map.png", 700),
    "twins_pmf.png": ("sim:twins,seed=1", "pmf.png", 900),
}
OTHERS = ("draw_worlds.py", "draw_view.py", "draw_closure.py", "draw_concepts.py")
COLORS = 128


def draw(log: str, picture: str, width: int, to: Path) -> None:
    """Map a log and keep one picture of it."""
    with tempfile.TemporaryDirectory() as folder:
        for command in (["map", log, "--out", f"{folder}/run"], ["plot", f"{folder}/run"]):
            subprocess.run([sys.executable, "-m", "hmt_slam_ros.cli.main", *command], cwd=ROOT, check=True)
        with Image.open(Path(folder) / "run" / picture) as image:
            height = round(image.height * width / image.width)
            image.convert("RGB").resize((width, height), Image.Resampling.LANCZOS).save(to)


def reduce(path: Path) -> None:
    """Reduce the colors of a picture, if that makes the file smaller."""
    before = path.stat().st_size
    with Image.open(path) as image:
        if image.mode == "P":
            return
        true = image.convert("RGB")
    few = true.quantize(palette=_palette(true), dither=Image.Dither.NONE)
    few.save(path, optimize=True)
    print(f"{path}: {before} -> {path.stat().st_size} bytes")


def _palette(image: Image.Image) -> Image.Image:
    """The colors of large areas, and as many that lie far apart, for thin lines."""
    colors, counts = np.unique(np.asarray(image).reshape(-1, 3), axis=0, return_counts=True)
    frequent = colors[np.argsort(-counts, kind="stable")[: COLORS // 2]].ravel().tolist()
    apart = image.quantize(COLORS // 2, Image.Quantize.MAXCOVERAGE).getpalette() or []
    palette = Image.new("P", (1, 1))
    palette.putpalette([*frequent, *apart[: 3 * COLORS // 2]])
    return palette


def main() -> None:
    """Draw all of them."""
    for name, (log, picture, width) in PICTURES.items():
        draw(log, picture, width, IMAGES / name)
    for script in OTHERS:
        if subprocess.run([sys.executable, ROOT / "scripts" / script], cwd=ROOT, check=False).returncode:
            print(f"{script} failed: its picture stays as it is", file=sys.stderr)
    for path in sorted(IMAGES.glob("*.png")):
        reduce(path)


if __name__ == "__main__":
    main()
