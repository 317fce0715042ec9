"""The environment of the scripts: it knows when it is stale, and says in one sentence what hinders it."""

import importlib.util
import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def environment_module():
    spec = importlib.util.spec_from_file_location("hmt_slam_environment", ROOT / "scripts" / "environment.py")
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look their module up by name.
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


@pytest.fixture
def environment(environment_module, tmp_path):
    """An environment whose interpreter is the one that runs the tests."""
    (tmp_path / "bin").mkdir()
    python = tmp_path / "bin" / "python"
    python.write_text(f'#!/bin/sh\nexec "{sys.executable}" "$@"\n')
    python.chmod(0o755)
    return environment_module.Environment(tmp_path, jazzy=False, floor=False)


def run_script(*command, **variables):
    clean = {name: value for name, value in os.environ.items() if name != "ROS_DISTRO"}
    return subprocess.run(command, cwd=ROOT, env=clean | variables, capture_output=True, text=True, check=False)


def test_the_fingerprint_follows_contents_names_and_the_remark(environment_module, tmp_path, monkeypatch):
    monkeypatch.setattr(environment_module, "ROOT", tmp_path)
    folder = tmp_path / "requirements"
    folder.mkdir()
    file = folder / "floor.txt"
    file.write_text("numpy==1.26.4\n")
    first = environment_module.digest(folder, also="3.11")
    assert environment_module.digest(folder, also="3.11") == first
    assert environment_module.digest(folder, also="3.12") != first
    file.write_text("numpy==1.26.5\n")
    second = environment_module.digest(folder, also="3.11")
    file.rename(folder / "other.txt")
    assert len({first, second, environment_module.digest(folder, also="3.11")}) == 3


def test_a_step_is_done_again_when_its_fingerprint_changes_or_the_interpreter_is_gone(environment):
    assert not environment.is_up_to_date("ros", "abc")
    environment.stamp("ros").write_text("abc")
    assert environment.is_up_to_date("ros", "abc")
    assert not environment.is_up_to_date("ros", "abcd")
    environment.python.unlink()
    assert not environment.is_up_to_date("ros", "abc")


def test_a_step_that_fails_names_the_purpose_the_cause_and_the_log(environment, environment_module):
    script = "print('Collecting numpy'); print('ERROR: No such version.'); print('note: ...'); raise SystemExit(1)"
    with pytest.raises(environment_module.EnvironmentSetupError) as caught:
        environment.run(environment.python, "-c", script, problem="numpy could not be installed")
    log = environment.path / "last_step.log"
    assert str(caught.value) == f"numpy could not be installed (No such version); the whole output is in {log}"
    assert "Collecting numpy" in log.read_text()


def pip_calls(environment):
    """The arguments of each call of pip, in an environment whose interpreter only notes them."""
    calls = environment.path / "calls.txt"
    environment.python.write_text(f'#!/bin/sh\necho "$@" >> "{calls}"\n')
    return lambda: [line.split()[5:] for line in calls.read_text().splitlines()]


def test_packages_are_installed_as_locked_and_nothing_is_downloaded_to_build_them(environment, environment_module):
    calls = pip_calls(environment)
    environment_module.install_project(environment)
    packages, project = calls()
    locked = str(ROOT / "requirements" / "tested.txt")
    assert packages == ["--require-hashes", "--no-build-isolation", "-r", locked]
    assert project == ["--no-deps", "--no-build-isolation", "--editable", str(ROOT)]


def test_the_oldest_versions_are_constraints(environment, environment_module):
    environment.floor = True
    calls = pip_calls(environment)
    environment_module.install_project(environment)
    environment.install_requirements("ros", "")
    floor = ["--constraint", str(ROOT / "requirements" / "floor.txt")]
    assert calls() == [[*floor, "--editable", f"{ROOT}[test]"], [*floor, "-r", str(ROOT / "requirements" / "ros.in")]]


def test_the_ros_wheels_look_for_headers_in_this_environment_and_keep_all_else(environment, environment_module):
    folder = environment.path / "share" / "std_msgs" / "cmake"
    folder.mkdir(parents=True)
    export = folder / "export_std_msgs__rosidl_generator_pyExport.cmake"
    built = "/opt/python/cp311-cp311"
    export.write_text(
        f'INCLUDE "/usr/include;{built}/include/python3.11;{built}/lib/python3.11/site-packages/numpy/_core/include"\n'
    )
    environment_module.mend_wheels(environment)
    python_headers = sysconfig.get_paths()["include"]
    assert export.read_text() == f'INCLUDE "/usr/include;{python_headers};{np.get_include()}"\n'


def test_another_ros_distribution_is_refused_with_advice():
    result = run_script(sys.executable, "scripts/environment.py", ROS_DISTRO="humble")
    assert result.returncode == 2
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1
    assert "humble is sourced but hmt_slam_ros needs Jazzy" in result.stderr


@pytest.mark.parametrize("script", ["scripts/test.sh", "scripts/demo.sh", ".ci/run"])
def test_a_python_that_is_not_there_ends_the_script_with_one_sentence(script):
    result = run_script("bash", script, PYTHON="no-such-python")
    assert result.returncode == 2
    assert result.stdout == ""
    assert result.stderr == (
        "No Python 3.11 or 3.12 was found at PYTHON=no-such-python; install one, or name it with PYTHON=...\n"
    )
