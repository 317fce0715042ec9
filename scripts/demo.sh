#!/usr/bin/env bash
# Makes the environment where it is missing, and maps the bundled log with the robot node and the five process nodes.
# Usage: scripts/demo.sh [further arguments of `hmt_slam replay`, such as --rate 1 for real time, or --seed 1]
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
. scripts/environment.sh
make_environment

export ROS_AUTOMATIC_DISCOVERY_RANGE="${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}"
"$venv/bin/hmt_slam" replay data/malaga_one_loop --out output/demo --rate 0 "$@"
echo "The results are in output/demo; look at output/demo/map.png"
