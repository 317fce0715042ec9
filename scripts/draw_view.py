#!/usr/bin/env python3
"""Draw the live page on a desk and on a phone, amid a run of the nodes: docs/images/view.png."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np
from page_run import IMAGES, PageOfRun, page_of_run, wait_until
from PIL import Image

PICTURE = IMAGES / "view.png"
LOG, RATE = "sim:nested,seed=1", 3.0
DESK, PHONE = (1280, 844), (390, 844)
# The moment that is shown: after so many scans, the first at which so many hypotheses live.
SCANS, HYPOTHESES = 600, 3
GAP = 24  # px between the two


def main() -> None:
    """Start the nodes, wait for the moment, take the pictures."""
    with tempfile.TemporaryDirectory() as scratch, page_of_run(LOG, RATE, DESK) as page:
        wait_until(lambda: _is_moment(page), f"{LOG} had no {HYPOTHESES} live hypotheses: choose another log")
        desk, phone = Path(scratch) / "desk.png", Path(scratch) / "phone.png"
        page.browser.screenshot(desk)
        page.browser.size(*PHONE, mobile=True)
        time.sleep(0.5)
        page.browser.screenshot(phone)
        _save(desk, phone)


def _is_moment(page: PageOfRun) -> bool:
    """Whether the page shows what the picture is to show."""
    drawn = page.drawing
    return page.scans >= SCANS and drawn["map"] and drawn["bars"] >= HYPOTHESES


def _save(desk: Path, phone: Path) -> None:
    left, right = (np.asarray(Image.open(path).convert("RGB")) for path in (desk, phone))
    gap = np.full((left.shape[0], GAP, 3), 255, dtype=np.uint8)
    Image.fromarray(np.concatenate([left, gap, right], axis=1)).save(PICTURE, optimize=True)


if __name__ == "__main__":
    main()
