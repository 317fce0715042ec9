"""Kernels are cached under a digest of all that they come from: none computes what its source no longer says."""

import json
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
ROOT = Path(__file__).parent.parent
RESULT = "from changing.kernel import whole; print(whole(10.0))"
OWN, NUMBA = "hmt_slam_ros.compilation", "numba"


def write_package(folder, value, origin=OWN, helper="helper"):
    package = folder / "changing"
    package.mkdir(exist_ok=True)
    (package / "__init__.py").touch()
    (package / f"{helper}.py").write_text(HELPER.format(origin=origin, value=value))
    kernel = KERNEL.format(origin=origin, helper=helper)
    if not (package / "kernel.py").exists() or (package / "kernel.py").read_text() != kernel:
        (package / "kernel.py").write_text(kernel)  # otherwise it keeps its time, as in an upgrade of other files


FORKING = """
import json, os, sys
import numba

numba.njit(lambda x: 2.0 * x)(1.0)
for line in sys.stdin:
    request = json.loads(line)
    child = os.fork()
    if not child:
        os.environ.update(request["environment"])
        numba.config.reload_config()
        sys.path[:0] = request["path"]
        os.dup2(os.open(request["output"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 1)
        os.dup2(1, 2)
        exec(request["code"], {"__name__": "__main__"})
        sys.exit()
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""
"""Python that has numba loaded, with all that a first compilation needs, and forks a process for each piece of code."""


@pytest.fixture(scope="module")
def forking():
    # Two versions of a file that come within a second have the same bytecode.
    command = [sys.executable, "-B", "-c", FORKING]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        yield process
        process.stdin.close()


class ForkedPython:
    """New processes of Python that use the package of the test's folder."""

    def __init__(self, forking, folder):
        self._forking, self._folder = forking, folder

    def run(self, code, **environment):
        """The number that a piece of code prints."""
        output = self._folder / "output"
        own = {"XDG_CACHE_HOME": str(self._folder / "home"), "NUMBA_CACHE_DIR": ""} | environment
        request = {"code": code, "environment": own, "path": [str(self._folder), str(ROOT)], "output": str(output)}
        print(json.dumps(request), file=self._forking.stdin, flush=True)
        assert self._forking.stdout.readline() == "0\n", output.read_text()
        return float(output.read_text())

    def result(self, **environment):
        return self.run(RESULT, **environment)

    def count_compilations(self, **environment):
        """How many kernels a process compiles."""
        return self.run(
            "from changing.kernel import whole; whole(1.0); print(sum(whole.stats.cache_misses.values()))",
            **environment,
        )


@pytest.fixture
def python(forking, tmp_path):
    return ForkedPython(forking, tmp_path)


def test_numba_alone_returns_results_of_an_old_source(tmp_path, python):
    write_package(tmp_path, 2, NUMBA)
    assert python.result() == 21.0
    write_package(tmp_path, 3, NUMBA)
    assert python.result() == 21.0, "numba notices it now: the digests may be removed"


@pytest.mark.parametrize("own", [False, True])
def test_a_kernel_is_recompiled_where_an_imported_file_has_changed(tmp_path, python, own):
    chosen = {"NUMBA_CACHE_DIR": str(tmp_path / "chosen")} if own else {}
    write_package(tmp_path, 2)
    assert python.result(**chosen) == 21.0
    write_package(tmp_path, 3)
    assert python.result(**chosen) == 31.0
    assert (tmp_path / "chosen").is_dir() is own
    assert (tmp_path / "home").is_dir() is not own


def test_a_constant_of_another_file_counts_too(tmp_path, python):
    for value in (2, 3):
        write_package(tmp_path, 2)
        (tmp_path / "changing" / "constants.py").write_text(f"FACTOR = {value}\n")
        kernel = KERNEL.format(origin=OWN, helper="constants").replace("import part", "import FACTOR")
        path = tmp_path / "changing" / "kernel.py"
        path.write_text(kernel.replace("part(x)", "FACTOR * x"))
        os.utime(path, (1e9, 1e9))
        assert python.result() == 10.0 * value + 1


def test_a_module_that_was_renamed_is_not_looked_for(tmp_path, python):
    write_package(tmp_path, 2)
    assert python.result() == 21.0
    (tmp_path / "changing" / "helper.py").unlink()
    write_package(tmp_path, 2, helper="other")
    assert python.result() == 21.0


def test_the_next_start_finds_the_kernels(tmp_path, python):
    write_package(tmp_path, 2)
    assert [python.count_compilations() for _ in range(2)] == [1.0, 0.0]
    write_package(tmp_path, 3)
    assert [python.count_compilations() for _ in range(2)] == [1.0, 0.0]
    write_package(tmp_path, 2)
    assert python.count_compilations() == 0.0, "an earlier version is still there"


def test_old_digests_are_removed(tmp_path, python):
    kept = tmp_path / "home" / "hmt_slam_ros" / "kernels"
    for age in range(11):
        for module in ("changing.kernel", "other.kernel"):
            folder = kept / f"{module}-{age:016x}"
            folder.mkdir(parents=True)
            os.utime(folder, (1e9 - age, 1e9 - age))
    write_package(tmp_path, 2)
    assert python.result() == 21.0
    ages = sorted(path.name for path in kept.iterdir() if path.name.startswith("changing.kernel"))
    assert [int(name.rpartition("-")[2], 16) for name in ages[:7]] == list(range(7))
    assert len(ages) == 8
    assert len(list(kept.glob("other.kernel-*"))) == 11


def test_without_a_folder_to_write_to_kernels_are_compiled_at_each_start(tmp_path, python):
    write_package(tmp_path, 2)
    (tmp_path / "home").touch()  # a file, below which there is no folder, for root too
    (tmp_path / "changing" / "__pycache__").touch()
    assert [python.count_compilations() for _ in range(2)] == [1.0, 1.0]
    assert python.result() == 21.0


def test_without_a_home_kernels_are_cached_beside_the_sources(tmp_path, python):
    write_package(tmp_path, 2)
    (tmp_path / "home").touch()
    assert [python.count_compilations() for _ in range(2)] == [1.0, 0.0]
    assert (tmp_path / "changing" / "__pycache__" / "kernels").is_dir()


def test_processes_may_compile_at_the_same_time(tmp_path):
    write_package(tmp_path, 2)
    environment = os.environ | {
        "PYTHONPATH": f"{tmp_path}:{ROOT}",
        "XDG_CACHE_HOME": str(tmp_path / "home"),
    }
    processes = [
        subprocess.Popen([sys.executable, "-c", RESULT], env=environment, stdout=subprocess.PIPE, text=True)
        for _ in range(3)
    ]
    assert [process.communicate(timeout=120)[0] for process in processes] == ["21.0\n"] * 3
