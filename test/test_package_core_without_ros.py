"""The core runs where there is no ROS; that it names no ROS module is a contract in .importlinter."""

import subprocess
import sys
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent.parent / "hmt_slam_ros"
ROS_SHELLS = {"ros"}
ROS_MODULES = ("rclpy", "ament_index_python", "launch", "launch_ros", "rosidl_runtime_py", "rosgraph_msgs", "std_srvs")


def core_files():
    return sorted(path for path in PACKAGE.rglob("*.py") if path.relative_to(PACKAGE).parts[0] not in ROS_SHELLS)


def test_every_core_module_imports_where_ros_is_blocked():
    modules = [".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts) for path in core_files()]
    names = [module.removesuffix(".__init__") for module in modules]
    script = f"""
import sys
from importlib import import_module

class Blocked:
    def find_spec(self, name, path=None, target=None):
        top = name.split(".")[0]
        if top in {ROS_MODULES!r} or top.endswith(("_msgs", "_srvs", "_interfaces")) or top.startswith("tf2_"):
            raise ModuleNotFoundError("blocked: " + name)

sys.meta_path.insert(0, Blocked())
for name in {names!r}:
    import_module(name)
print("imported", len({names!r}))
try:
    import rclpy
except ModuleNotFoundError:
    print("rclpy blocked")
"""
    command = [sys.executable, "-c", script]
    result = subprocess.run(command, cwd=PACKAGE.parent, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stdout == f"imported {len(names)}\nrclpy blocked\n"
