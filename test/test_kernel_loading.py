"""Kernels that are compiled or loaded ahead: the table, the time left, and that a run needs no others."""

import subprocess
import sys
from pathlib import Path

import preloaded
import pytest

from hmt_slam_ros import kernel_loading
from hmt_slam_ros.kernel_loading import KernelLoading
from hmt_slam_ros.kernel_table import KernelCall, describe_types, known_calls
from hmt_slam_ros.process_table import node_names

BUNDLED = Path(__file__).resolve().parent.parent / "data" / "malaga_one_loop"


def test_each_line_of_the_table_is_a_kernel_with_types_that_are_written_as_they_are_read():
    assert len(known_calls()) > 50
    for call in known_calls():
        kernel, types = call.resolve()
        assert kernel.py_func.__code__.co_argcount == len(types), call.kernel
        assert describe_types(types) == call.arguments
        assert call.seconds >= 0.0
        assert set(call.users) <= {"hmt_slam", *node_names()}


def test_where_all_kernels_are_loaded_a_map_of_the_bundled_log_loads_none(tmp_path):
    program = (
        "import sys\n"
        "from hmt_slam_ros.cli.main import main\n"
        "from hmt_slam_ros.kernel_loading import KernelLoading, count_loaded\n"
        "KernelLoading().run()\n"
        "before = count_loaded()\n"
        f"assert main(['map', {str(BUNDLED)!r}, '--out', {str(tmp_path / 'out')!r}]) == 0\n"
        "assert count_loaded() == before, set(count_loaded().items()) ^ set(before.items())\n"
        "assert sum(before.values()) > 50\n"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr


def test_the_command_compiles_all_and_says_how_many():
    run = preloaded.hmt_slam("compile", check=True)
    assert run.stdout.startswith(f"{len(known_calls())} kernels are compiled; ")


class SlowMachine:
    """A computer that needs twice the time of the table."""

    def __init__(self, monkeypatch):
        self.now, self.texts = 100.0, []
        self.loading = KernelLoading(clock=lambda: self.now)
        monkeypatch.setattr(kernel_loading, "known_calls", lambda: CALLS)
        monkeypatch.setattr(kernel_loading, "_is_cached", lambda call: call is CALLS[0])
        monkeypatch.setattr(kernel_loading, "_load", self.load)
        self.busy = []

    def load(self, call, *, may_wait):
        if call in self.busy and not may_wait:
            self.now += 0.1
            return False
        self.now += 2.0 * call.seconds
        return True

    def show(self):
        self.texts.append(self.loading.progress)


CALLS = tuple(KernelCall(("slam",), seconds, f"a:{seconds:g}", "()") for seconds in (5.0, 10.0, 20.0, 10.0))


def test_the_time_left_follows_the_pace_of_the_machine(monkeypatch):
    machine = SlowMachine(monkeypatch)
    machine.loading.run(machine.show)
    assert machine.texts[0] == "compiling kernels, 40 s left"
    left = [int(text.split()[2]) for text in machine.texts[1:]]
    assert left == [pytest.approx(60, abs=3), pytest.approx(20, abs=2)]
    assert machine.loading.progress == ""


def test_a_kernel_that_another_process_compiles_comes_later(monkeypatch):
    machine = SlowMachine(monkeypatch)
    machine.busy = [CALLS[1]]
    order = []
    monkeypatch.setattr(
        kernel_loading,
        "_load",
        lambda call, may_wait: machine.load(call, may_wait=may_wait) and (order.append(call.kernel) or True),
    )
    machine.loading.run()
    assert order == ["a:5", "a:20", "a:10", "a:10"]
