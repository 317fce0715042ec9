#!/usr/bin/env bash
# Tries `ros2 run` and `ros2 launch` with this package, by ros2cli and launch from their sources, where no ROS is installed.
# PyPI and Debian do not have these. Ends with an error where a command fails.
# Usage: scripts/try_ros2_commands.sh SOURCES
#   SOURCES has checkouts of the branch jazzy: ros2cli, launch, launch_ros and rcl_interfaces, of github.com/ros2
set -euo pipefail
sources=$(realpath "${1:?name the folder with ros2cli, launch, launch_ros and rcl_interfaces}")
cd "$(dirname "${BASH_SOURCE[0]}")/.."
. scripts/environment.sh
make_environment
root=$PWD work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
prefix=$work/install
python=$venv/bin/python
site=$prefix/$("$python" -c 'import sysconfig; print(sysconfig.get_path("purelib", vars={"base": ""}).lstrip("/"))')
export PATH=$venv/bin:$PATH AMENT_PREFIX_PATH=$venv

echo "== building in $work"
{
    # launch_ros needs it, and PyPI does not have it.
    cmake -S "$sources/rcl_interfaces/composition_interfaces" -B "$work/build" -GNinja -DCMAKE_PREFIX_PATH="$venv" \
        -DCMAKE_INSTALL_PREFIX="$prefix" -DPython3_EXECUTABLE="$python" -DBUILD_TESTING=OFF
    cmake --build "$work/build"
    cmake --install "$work/build"
    # Copies, since pip builds within the sources.
    cp -r "$sources"/{ros2cli,launch,launch_ros} "$work"
    "$python" -m pip install --no-deps --no-build-isolation --target "$site" \
        "$work"/launch/{launch,launch_xml,launch_yaml} "$work"/launch_ros/{launch_ros,ros2launch} \
        "$work"/ros2cli/{ros2cli,ros2run,ros2pkg} osrf-pycommon argcomplete psutil importlib-metadata zipp empy
    # As colcon does, which obeys setup.cfg.
    "$python" setup.py build --build-base "$work/package" install --prefix "$prefix" \
        --single-version-externally-managed --record "$work/record"
} >"$work/log" 2>&1 || { tail -20 "$work/log" >&2; exit 1; }
# The modules themselves are those of the repository, whose kernels are compiled.
rm -rf "$site/hmt_slam_ros"
export AMENT_PREFIX_PATH=$prefix:$venv PYTHONPATH=$root:$site LD_LIBRARY_PATH=$prefix/lib ROS_LOG_DIR=$work/log_files
export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST ROS_DOMAIN_ID=${ROS_DOMAIN_ID:-77}
ros2=$site/bin/ros2

check() {
    echo "== $1"
    grep -q -- "$2" "$3" || { cat "$3" >&2; echo "'$2' is missing in the output of $1" >&2; exit 1; }
}

"$python" "$ros2" pkg executables hmt_slam_ros >"$work/executables"
for node in slam aam tsbi tlca rtl team robot view explorer pilot all hmt_slam; do
    check "ros2 pkg executables: $node" "^hmt_slam_ros $node$" "$work/executables"
done
"$python" "$ros2" run hmt_slam_ros hmt_slam --version >"$work/version"
check "ros2 run hmt_slam_ros hmt_slam --version" "0\." "$work/version"
timeout -s INT 10 "$python" "$ros2" run hmt_slam_ros pilot >"$work/pilot" 2>&1 || true
check "ros2 run hmt_slam_ros pilot, without a map" "there is none: set start_from" "$work/pilot"
for file in mapping replay explore missions; do
    "$python" "$ros2" launch hmt_slam_ros $file.launch.py --show-args >"$work/$file"
    check "ros2 launch hmt_slam_ros $file.launch.py --show-args" "'namespace':" "$work/$file"
done
"$venv/bin/hmt_slam" compile >/dev/null 2>&1
cd "$work"
timeout -s INT 25 "$python" "$ros2" launch hmt_slam_ros replay.launch.py rate:=20.0 >"$work/replay" 2>&1 || true
check "ros2 launch hmt_slam_ros replay.launch.py: the log is replayed" "end of the log after 225 scans" "$work/replay"
for node in slam aam tsbi tlca rtl robot; do
    check "$node ends after Ctrl-C" "$node-[0-9]*\]: process has finished cleanly" "$work/replay"
done
cd "$root"
"$python" -m pytest -q test/test_package_metadata.py -k launch_file
