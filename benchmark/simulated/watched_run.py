"""Map a simulated log, watched: ``python -m benchmark.simulated.watched_run FAMILY SEED FILE [NAME=VALUE ...]``.

FILE becomes a JSON document, gzipped.
"""

from __future__ import annotations

import gzip
import json
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmark.runs import PARAMETERS
from benchmark.simulated.doors import doors
from benchmark.simulated.features import Row
from benchmark.simulated.loops import Loop
from benchmark.simulated.records import code
from benchmark.simulated.rivals import rivalries
from benchmark.simulated.watch import Watch
from benchmark.simulated.worlds import World
from hmt_slam_ros.configuration import load_configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.simulation import open_simulated


def watched(world: World, changes: Sequence[str] = ()) -> dict[str, Any]:
    """All that is kept of a run."""
    begin = time.process_time()
    watch = Watch(open_simulated(world.log), load_configuration(PARAMETERS, list(changes), world.seed))
    watch.run()
    return {
        "world": world.log,
        "family": world.family,
        "seed": world.seed,
        "changes": list(changes),
        "code": code(),
        "keyframes": len(watch.truth.poses),
        "columns": Row._fields,
        "rows": watch.rows,
        "events": watch.events,
        "accepted": watch.accepted,
        "pending": watch.pending(),
        "loops": [_loop(loop) for loop in watch.loops.found],
        "arcs": watch.arcs(),
        "area_poses": watch.area_poses(),
        "poses": watch.poses,
        "pmf": watch.pmf,
        "rivalries": [vars(found) for found in rivalries(watch.log, watch.truth, watch.loops.found, watch.travelled)],
        "doors": doors(watch.truth, *watch.mapped(), watch.configuration),
        "cpu_s": time.process_time() - begin,
    }


def _loop(loop: Loop) -> dict[str, Any]:
    return {
        **{name: value for name, value in vars(loop).items() if name != "partners"},
        "can_be_closed": loop.can_be_closed,
        "in_time": loop.in_time,
    }


def _plain(value: Any) -> Any:  # noqa: ANN401  whatever is in a record
    """The same in what JSON knows, figures to seven digits."""
    if isinstance(value, dict):
        return {name: _plain(entry) for name, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if isinstance(value, float):
        return float(f"{value:.7g}") if math.isfinite(value) else None
    return value


def main(arguments: Sequence[str]) -> int:
    """Run; return the exit status."""
    family, seed, file, *changes = arguments
    try:
        record = watched(World(family, int(seed)), changes)
    except HmtSlamError as fault:
        print(f"watched_run: {fault}", file=sys.stderr)
        return 2
    # Under another name first, so that an interrupted run leaves nothing that looks like a record.
    part = Path(f"{file}.part")
    with gzip.open(part, "wt", encoding="utf-8") as target:
        json.dump(_plain(record), target, allow_nan=False)
    part.replace(file)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
