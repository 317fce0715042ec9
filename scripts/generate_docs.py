#!/usr/bin/env python3
"""Write config/hmt_slam.yaml and docs/parameters.md anew from the configuration tree."""

from __future__ import annotations

from pathlib import Path

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.configuration.documents import reference, ros_yaml

ROOT = Path(__file__).resolve().parents[1]
GENERATED = {"config/hmt_slam.yaml": ros_yaml, "docs/parameters.md": reference}


def main() -> None:
    """Write every generated file below the repository's root."""
    for name, text in GENERATED.items():
        (ROOT / name).parent.mkdir(exist_ok=True)
        (ROOT / name).write_text(text(Configuration()), encoding="utf-8")


if __name__ == "__main__":
    main()
