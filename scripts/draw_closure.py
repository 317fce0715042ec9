#!/usr/bin/env python3
"""Draw how a loop is closed, as the live page shows it: docs/images/closure.webp, an animation below 1 MB."""

from __future__ import annotations

import io
import sys
import tempfile
import time
from collections import deque
from pathlib import Path

from page_run import IMAGES, PATIENCE, PageOfRun, page_of_run
from PIL import Image

PICTURE = IMAGES / "closure.webp"
LOG, RATE = "sim:nested,seed=1", 3.0
WINDOW, WIDTH = (1180, 720), 820  # px
PERIOD = 0.5  # s between two frames, of the run and of the animation
BEFORE, AFTER = 24, 12  # frames
OPEN = 8  # frames before the acceptance in which several hypotheses live
MAX_BYTES = 1_000_000


def main() -> None:
    """Start the nodes, keep the last frames until a closure is accepted that was open for a while, and save them."""
    with tempfile.TemporaryDirectory() as scratch, page_of_run(LOG, RATE, WINDOW) as page:
        frames = _frames_of_closure(page, Path(scratch) / "frame.png")
    for quality in (80, 65, 50, 35, 20):
        file = io.BytesIO()
        frames[0].save(
            file,
            "WEBP",
            save_all=True,
            append_images=frames[1:],
            duration=[*[round(1000 * PERIOD)] * (len(frames) - 1), 3000],
            loop=0,
            quality=quality,
            method=6,
        )
        if file.tell() < MAX_BYTES:
            PICTURE.write_bytes(file.getvalue())
            print(f"{PICTURE}: {len(frames)} frames, {file.tell()} bytes, quality {quality}")
            return
    sys.exit(f"the animation has {file.tell()} bytes: take fewer frames")


def _frames_of_closure(page: PageOfRun, scratch: Path) -> list[Image.Image]:
    recent: deque[tuple[Image.Image, int]] = deque(maxlen=BEFORE)
    deadline, known = time.monotonic() + PATIENCE, 0
    while time.monotonic() < deadline:
        frame = _frame(page, scratch)
        recent.append((frame, page.drawing.get("bars", 0)))
        accepted = sum(event["kind"] == "accepted" for event in page.events())
        is_open = sum(bars > 1 for _, bars in recent) >= OPEN
        if accepted > known and is_open and len(recent) == BEFORE:
            return [image for image, _ in recent] + [_frame(page, scratch) for _ in range(AFTER)]
        known = accepted
    sys.exit(f"{LOG} had no closure that was open for {OPEN * PERIOD:g} s: choose another log")


def _frame(page: PageOfRun, scratch: Path) -> Image.Image:
    time.sleep(PERIOD)
    page.browser.screenshot(scratch)
    with Image.open(scratch) as image:
        height = round(image.height * WIDTH / image.width)
        return image.convert("RGB").resize((WIDTH, height), Image.Resampling.LANCZOS)


if __name__ == "__main__":
    main()
