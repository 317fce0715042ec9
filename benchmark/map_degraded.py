"""Map a log with degraded odometry: ``python -m benchmark.map_degraded KIND LOG --out DIR ...`` as ``hmt_slam map``.

The seed of the run is also the seed of what is drawn for the odometry.
"""

from __future__ import annotations

import sys

from benchmark.degraded_odometry import degraded
from hmt_slam_ros.cli.arguments import chosen_configuration, parser
from hmt_slam_ros.cli.map_command import measured_run
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.results.output_folder import replacing, write_output


def main(arguments: list[str]) -> int:
    """Run; return the exit status."""
    kind, *rest = arguments
    options = parser().parse_args(["map", *rest])
    try:
        configuration = chosen_configuration(options)
        part = configuration.robot
        recorded = open_log(options.log, start=part.start, duration=part.duration or None)
        log = degraded(recorded, kind, configuration.seed)
        with replacing(options.out) as folder:
            final, source_stamps, figures = measured_run(log, configuration)
            write_output(folder, final, source_stamps, figures, configuration)
    except HmtSlamError as fault:
        print(f"map_degraded: {fault}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
