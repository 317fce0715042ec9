"""All comparisons of a folder of records as one table: ``python -m benchmark.simulated.comparisons FOLDER FILE.csv``.

The columns are those of ``benchmark.simulated.features.Row`` behind ``family`` and ``seed``; what could not be computed
is empty.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmark.simulated.records import read_records
from hmt_slam_ros.errors import HmtSlamError


def write_comparisons(folder: Path, file: Path) -> int:
    """Write the table; return the number of its rows."""
    count = 0
    with file.open("w", encoding="utf-8", newline="") as target:
        writer = csv.writer(target)
        for record in read_records(folder):
            if not count:
                writer.writerow(["family", "seed", *record["columns"]])
            writer.writerows([record["family"], record["seed"], *row] for row in record["rows"])
            count += len(record["rows"])
    return count


def main(arguments: Sequence[str]) -> int:
    """Write; return the exit status."""
    folder, file = map(Path, arguments)
    try:
        print(f"{file}: {write_comparisons(folder, file)} comparisons")
    except HmtSlamError as fault:
        print(f"comparisons: {fault}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
