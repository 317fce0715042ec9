"""That kernels are being compiled is reported where it is so, and only there."""

import os
import re
import shutil
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

TELLING = """
import sys
from hmt_slam_ros.compilation import report_compilation
{load}
for _ in range(2):
    report_compilation(print)
{use}
"""
"""It checks twice, as a node does that is taken down and brought up again."""
LOAD = "import numpy as np; from hmt_slam_ros.grids.distance_field import has_bits"
EARLY = "sent EarlyEstimate"
USE = "has_bits(np.zeros(3, np.uint32)); has_bits(np.zeros((1, 3), np.uint32)[0, ::2])"


def messages(cache, load=LOAD, use=USE):
    finished = subprocess.run(
        [sys.executable, "-c", TELLING.format(load=load, use=use)],
        env=os.environ | {"NUMBA_CACHE_DIR": str(cache)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert finished.returncode == 0, finished.stderr
    return finished.stdout.splitlines()


def test_a_program_says_once_that_it_compiles_and_the_next_finds_everything_in_the_cache(tmp_path):
    (sentence,) = messages(tmp_path)
    assert "compiling" in sentence
    assert messages(tmp_path) == []


def test_a_disk_that_is_full_does_not_end_the_program(tmp_path):
    full = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))"
    compiling, kept = messages(tmp_path, use=f"{full}; {USE}")
    assert "compiling" in compiling
    assert kept.startswith("compiled kernels cannot be kept in ")
    assert "File too large; each start compiles them anew" in kept


def test_a_program_without_kernels_does_not_load_numba_for_this(tmp_path):
    assert messages(tmp_path, load="", use="print('numba' in sys.modules)") == ["False"]


def count_reports(*arguments, environment):
    """How often a command says that it compiles."""
    command = [sys.executable, "-m", "hmt_slam_ros.cli.main", *arguments]
    finished = subprocess.run(command, env=environment, capture_output=True, text=True, check=True, timeout=300)
    return finished.stderr.count("compiling kernels")


def cache_without(module, folder):
    """A folder with the kernels that are cached on this machine, but those of a module."""
    from hmt_slam_ros.grids.distance_field import has_bits  # noqa: PLC0415  any kernel

    kernels = Path(has_bits.stats.cache_path).parents[1]
    with suppress(shutil.Error):  # of what another test compiles meanwhile, and which is then compiled here too
        shutil.copytree(kernels, folder, ignore=shutil.ignore_patterns(f"{module}-*"), copy_function=link_or_copy)
    return str(folder)


def link_or_copy(source, target):
    """A second name of a file, which nothing changes in place; a copy where the disk has none."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def test_a_command_says_it_once_and_never_again(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": cache_without("hmt_slam_ros.simulation.laser", tmp_path / "cache")}
    drive = ("simulate", "office", "--duration", "1", "--out")
    assert [count_reports(*drive, tmp_path / str(n), environment=environment) for n in range(2)] == [1, 0]


def test_every_kernel_that_maps_a_log_is_in_the_cache_afterwards(tmp_path):
    log, lines = tmp_path / "short.clf", "FLASER 3 1.0 1.1 1.2 {x} 0 0 {x} 0 0 {t} robot {t}\n"
    log.write_text("".join(lines.format(x=0.2 * k, t=float(k)) for k in range(6)))
    count_reports("map", log, "--out", tmp_path / "out", environment=os.environ)
    assert count_reports("map", log, "--out", tmp_path / "out", environment=os.environ) == 0


def test_a_node_says_it_once_and_sends_the_time_left_as_no_alarm(tmp_path, listener, start, monkeypatch):
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus  # noqa: PLC0415  see the import of rclpy
    from logs_for_nodes import corridor_bag  # noqa: PLC0415

    from hmt_slam_ros.ros.topics import DIAGNOSTICS, STREAM  # noqa: PLC0415

    def statuses():
        return [status for message in reported for status in message.status if status.name == "/slam"]

    def early_estimates():
        """How many the node reports; a status is sent each second, where a listener misses what was sent before it."""
        counts = {
            value.key: int(value.value) for status in statuses()[-1:] for value in status.values if value.key == EARLY
        }
        return counts.get(EARLY, 0)

    monkeypatch.setenv("NUMBA_CACHE_DIR", cache_without("hmt_slam_ros.sensors.scan", tmp_path / "cache"))
    scans = 12
    log = corridor_bag(tmp_path, scans)
    for times in (1, 0):
        reported = listener.subscribe(DiagnosticArray, DIAGNOSTICS, STREAM)
        slam = start("slam")
        robot = start("robot", log=log, robot__rate=0.0, robot__flow_control=False)
        # The first scan is estimated, and the others wait for topology: no kernel is left to a start that is quicker.
        listener.until(lambda: early_estimates() == scans - 1, seconds=120.0, alive=[slam])
        slam.send_signal(signal.SIGINT)
        assert slam.communicate(timeout=60.0)[1].count("compiling kernels") == times
        robot.send_signal(signal.SIGINT)
        robot.communicate(timeout=60.0)
        assert {status.level for status in statuses()} <= {DiagnosticStatus.OK}
        progress = [status.message for status in statuses() if status.message.startswith("compiling kernels, ")]
        assert bool(progress) == bool(times)
        assert all(re.fullmatch(r"compiling kernels, \d+ s left", text) for text in progress)
