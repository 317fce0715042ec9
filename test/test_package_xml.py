"""package.xml is one that catkin_pkg, and so colcon, rosdep and bloom, accept, with dependencies that exist."""

from pathlib import Path

import pytest

catkin_package = pytest.importorskip("catkin_pkg.package", reason="catkin_pkg is not installed: run scripts/test.sh")

ROOT = Path(__file__).resolve().parent.parent
# Read on 2026-11-29 from rosdistro, commit 8468e88 of 2026-08-22.
JAZZY = {
    *("builtin_interfaces", "diagnostic_msgs", "geometry_msgs", "launch", "launch_ros", "lifecycle_msgs", "nav2_msgs"),
    *("nav_msgs", "rcl_interfaces", "rclpy", "ros2launch", "rosgraph_msgs", "sensor_msgs", "std_msgs", "std_srvs"),
    *("tf2_msgs", "visualization_msgs"),
}
"""Packages released in jazzy/distribution.yaml."""
ROSDEP = {
    *("python3-hypothesis", "python3-jsonschema", "python3-matplotlib", "python3-mypy", "python3-networkx"),
    *("python3-numpy", "python3-pil", "python3-pytest", "python3-scipy", "python3-yaml"),
}
"""Keys of rosdep/python.yaml for which apt has a package on Ubuntu 24.04; bloom refuses those that pip installs."""


@pytest.fixture(scope="module")
def package():
    warnings = []
    parsed = catkin_package.parse_package(str(ROOT / "package.xml"), warnings=warnings)
    assert warnings == []
    return parsed


def test_it_follows_format_3(package):
    assert package.package_format == 3
    warnings = []
    package.validate(warnings=warnings)
    assert warnings == []
    assert package.get_build_type() == "ament_python"
    assert [str(license_) for license_ in package.licenses] == ["BSD-3-Clause"]
    assert (ROOT / package.licenses[0].file).is_file()


def test_each_dependency_is_a_package_of_jazzy_or_a_key_that_apt_can_install(package):
    kinds = (package.exec_depends, package.test_depends, package.build_depends, package.buildtool_depends)
    names = {each.name for dependencies in kinds for each in dependencies}
    assert names == JAZZY | ROSDEP
