"""Kernels are cached under a digest of all that they come from: none computes what its source no longer says."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

HELPER = "from {origin} import njit\n\n\n@njit(cache=True)\ndef part(x):\n    return {value} * x\n"
KERNEL = """from {origin} import njit
from changing.{helper} import part


@njit(cache=True)
def whole(x):
    return part(x) + 1
"""
OWN, NUMBA = "hmt_slam_ros.compilation", "numba"


def write_package(folder, value, origin=OWN, helper="helper"):
    package = folder / "changing"
    package.mkdir(exist_ok=True)
    (package / "__init__.py").touch()
    (package / f"{helper}.py").write_text(HELPER.format(origin=origin, value=value))
    kernel = KERNEL.format(origin=origin, helper=helper)
    if not (package / "kernel.py").exists() or (package / "kernel.py").read_text() != kernel:
        (package / "kernel.py").write_text(kernel)  # otherwise it keeps its time, as in an upgrade of other files


def run_python(folder, code="from changing.kernel import whole; print(whole(10.0))", **environment):
    root = Path(__file__).parent.parent
    return subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ
        | {"PYTHONPATH": f"{folder}:{root}", "XDG_CACHE_HOME": str(folder / "home"), "NUMBA_CACHE_DIR": ""}
        | environment,
        capture_output=True,
        text=True,
        check=False,
    )


def result(folder, **environment):
    finished = run_python(folder, **environment)
    assert finished.returncode == 0, finished.stderr
    return float(finished.stdout)


def test_numba_alone_returns_results_of_an_old_source(tmp_path):
    write_package(tmp_path, 2, NUMBA)
    assert result(tmp_path) == 21.0
    write_package(tmp_path, 3, NUMBA)
    assert result(tmp_path) == 21.0, "numba notices it now: the digests may be removed"


@pytest.mark.parametrize("own", [False, True])
def test_a_kernel_is_recompiled_where_an_imported_file_has_changed(tmp_path, own):
    chosen = {"NUMBA_CACHE_DIR": str(tmp_path / "chosen")} if own else {}
    write_package(tmp_path, 2)
    assert result(tmp_path, **chosen) == 21.0
    write_package(tmp_path, 3)
    assert result(tmp_path, **chosen) == 31.0
    assert (tmp_path / "chosen").is_dir() is own
    assert (tmp_path / "home").is_dir() is not own


def test_a_constant_of_another_file_counts_too(tmp_path):
    for value in (2, 3):
        write_package(tmp_path, 2)
        (tmp_path / "changing" / "constants.py").write_text(f"FACTOR = {value}\n")
        kernel = KERNEL.format(origin=OWN, helper="constants").replace("import part", "import FACTOR")
        path = tmp_path / "changing" / "kernel.py"
        path.write_text(kernel.replace("part(x)", "FACTOR * x"))
        os.utime(path, (1e9, 1e9))
        assert result(tmp_path) == 10.0 * value + 1


def test_a_module_that_was_renamed_is_not_looked_for(tmp_path):
    write_package(tmp_path, 2)
    assert result(tmp_path) == 21.0
    (tmp_path / "changing" / "helper.py").unlink()
    write_package(tmp_path, 2, helper="other")
    assert result(tmp_path) == 21.0


def count_compilations(folder, **environment):
    """How many kernels a process compiled."""
    code = "from changing.kernel import whole; whole(1.0); print(sum(whole.stats.cache_misses.values()))"
    return float(run_python(folder, code, **environment).stdout)


def test_the_next_start_finds_the_kernels(tmp_path):
    write_package(tmp_path, 2)
    assert [count_compilations(tmp_path) for _ in range(2)] == [1.0, 0.0]
    write_package(tmp_path, 3)
    assert [count_compilations(tmp_path) for _ in range(2)] == [1.0, 0.0]
    write_package(tmp_path, 2)
    assert count_compilations(tmp_path) == 0.0, "an earlier version is still there"


def test_old_digests_are_removed(tmp_path):
    kept = tmp_path / "home" / "hmt_slam_ros" / "kernels"
    for age in range(11):
        for module in ("changing.kernel", "other.kernel"):
            folder = kept / f"{module}-{age:016x}"
            folder.mkdir(parents=True)
            os.utime(folder, (1e9 - age, 1e9 - age))
    write_package(tmp_path, 2)
    assert result(tmp_path) == 21.0
    ages = sorted(path.name for path in kept.iterdir() if path.name.startswith("changing.kernel"))
    assert [int(name.rpartition("-")[2], 16) for name in ages[:7]] == list(range(7))
    assert len(ages) == 8
    assert len(list(kept.glob("other.kernel-*"))) == 11


def test_without_a_folder_to_write_to_kernels_are_compiled_at_each_start(tmp_path):
    write_package(tmp_path, 2)
    (tmp_path / "home").touch()  # a file, below which there is no folder, for root too
    (tmp_path / "changing" / "__pycache__").touch()
    assert [count_compilations(tmp_path, PYTHONDONTWRITEBYTECODE="1") for _ in range(2)] == [1.0, 1.0]
    assert result(tmp_path, PYTHONDONTWRITEBYTECODE="1") == 21.0


def test_without_a_home_kernels_are_cached_beside_the_sources(tmp_path):
    write_package(tmp_path, 2)
    (tmp_path / "home").touch()
    assert [count_compilations(tmp_path) for _ in range(2)] == [1.0, 0.0]
    assert (tmp_path / "changing" / "__pycache__" / "kernels").is_dir()


def test_processes_may_compile_at_the_same_time(tmp_path):
    write_package(tmp_path, 2)
    code = "from changing.kernel import whole; print(whole(10.0))"
    environment = os.environ | {
        "PYTHONPATH": f"{tmp_path}:{Path(__file__).parent.parent}",
        "XDG_CACHE_HOME": str(tmp_path / "home"),
    }
    processes = [
        subprocess.Popen([sys.executable, "-c", code], env=environment, stdout=subprocess.PIPE, text=True)
        for _ in range(3)
    ]
    assert [process.communicate(timeout=120)[0] for process in processes] == ["21.0\n"] * 3
