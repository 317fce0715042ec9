"""The command line as a user meets it: processes with arguments, exit status, one sentence, nothing left behind."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml
from preloaded import hmt_slam

from hmt_slam_ros import __version__
from hmt_slam_ros.configuration import Configuration, as_nested, load_configuration

ROOT = Path(__file__).resolve().parents[1]
BAG = ROOT / "data" / "malaga_one_loop"
COMMANDS = ("map", "replay", "view", "convert", "simulate", "evaluate", "plot", "export", "parameters")
SCAN_LINE = "FLASER 3 1.0 1.1 1.2 {x} 0 0 {x} 0 0 {t} robot {t}\n"


def error_line(result: subprocess.CompletedProcess) -> str:
    """The one line that a refused command says."""
    assert result.returncode == 2, result.stderr
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1, result.stderr
    assert result.stderr.startswith("hmt_slam")
    return result.stderr


@pytest.fixture
def carmen(tmp_path: Path) -> Path:
    """A short log of a robot that drives 2 m through a world that only has three beams."""
    log = tmp_path / "short.clf"
    log.write_text("".join(SCAN_LINE.format(x=0.1 * k, t=float(k)) for k in range(20)))
    return log


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help_is_there_for_every_command_and_comes_at_once(command: str) -> None:
    words = [sys.executable, "-m", "hmt_slam_ros.cli.main", *command.split(), "--help"]
    before = os.times()
    result = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    after = os.times()
    assert (result.returncode, result.stderr) == (0, "")
    assert "usage: hmt_slam" in result.stdout
    used = after.children_user + after.children_system - before.children_user - before.children_system
    assert used < 1.0, "something heavy is imported for --help"


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; from hmt_slam_ros.cli.arguments import build_parser; build_parser();"
        "print(sorted({'numpy', 'numba', 'matplotlib', 'scipy', 'rosbags', 'rclpy', 'yaml'} & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert result.stdout == "[]\n"


def test_mapping_loads_no_library_that_it_does_not_use() -> None:
    code = (
        "import sys; import hmt_slam_ros.cli.run_commands;"
        "print(sorted({'networkx', 'rosbags', 'matplotlib', 'rclpy'} & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert result.stdout == "[]\n"


def test_version() -> None:
    assert hmt_slam("--version").stdout == f"hmt_slam_ros {__version__}\n"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("", "required: COMMAND"),
        ("fly", "invalid choice: 'fly'"),
        ("map", "required: LOG, --out"),
        ("map a.clf", "required: --out"),
        ("map a.clf --out o --seed many", "--seed"),
        ("map a.clf --out o --no-such-option", "--no-such-option"),
        ("convert a.clf b --storage tape", "tape"),
        ("evaluate o", "--relations"),
    ],
)
def test_a_command_line_that_makes_no_sense_is_refused(arguments: str, words: str) -> None:
    assert words in error_line(hmt_slam(*arguments.split()))


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("--set filter.particels=3", "did you mean filter.particles"),
        ("--set filter.particles=0", "out of range"),
        ("--set filter.particles=3.5", "whole number"),
        ("--set filter.particles", "name=value"),
        ("--seed -1", "seed = -1 is out of range"),
        ("--start -3", "robot.start = -3.0 is out of range"),
        ("--duration nan", "robot.duration"),
        ("--config missing.yaml", "missing.yaml cannot be read"),
    ],
)
@pytest.mark.parametrize("command", ["map", "replay"])
def test_an_impossible_parameter_is_refused_with_advice(
    tmp_path: Path, carmen: Path, command: str, option: str, words: str
) -> None:
    assert words in error_line(hmt_slam(command, carmen, "--out", tmp_path / "out", *option.split()))
    assert sorted(tmp_path.iterdir()) == [carmen]


def truncated_mcap(folder: Path) -> Path:
    source = next(BAG.glob("*.mcap"))
    log = folder / source.name
    log.write_bytes(source.read_bytes()[:20000])
    return log


def write_config(content: str) -> object:
    def write(folder: Path) -> Path:
        log = folder / "log.clf"
        log.write_text(content)
        return log

    return write


BAD_LOGS = {
    "no such file": lambda folder: folder / "missing.clf",
    "an empty file": write_config(""),
    "a file of no known format": write_config("dear diary\n"),
    "no scans": write_config("ODOM 0 0 0 0 0 0 1.0 robot 1.0\n" * 5),
    "a truncated CARMEN file": write_config((SCAN_LINE.format(x=0, t=1.0) * 3)[:-25]),
    "a truncated mcap file": truncated_mcap,
    "an empty folder": lambda folder: folder,
}


@pytest.mark.parametrize("kind", BAD_LOGS)
@pytest.mark.parametrize("command", ["map", "replay"])
def test_a_log_that_cannot_be_mapped_is_refused_and_nothing_is_left(tmp_path: Path, command: str, kind: str) -> None:
    (tmp_path / "logs").mkdir()
    log = BAD_LOGS[kind](tmp_path / "logs")
    error_line(hmt_slam(command, log, "--out", tmp_path / "out"))
    assert [entry.name for entry in tmp_path.iterdir()] == ["logs"]


def test_a_part_of_the_log_without_scans_is_refused(tmp_path: Path, carmen: Path) -> None:
    error_line(hmt_slam("map", carmen, "--out", tmp_path / "out", "--start", 1000))
    assert list(tmp_path.iterdir()) == [carmen]


@pytest.mark.parametrize("obstacle", ["out", "out/notes.txt"])
def test_an_output_path_that_holds_something_else_is_refused_and_kept(
    tmp_path: Path, carmen: Path, obstacle: str
) -> None:
    (tmp_path / obstacle).parent.mkdir(exist_ok=True)
    (tmp_path / obstacle).write_text("precious")
    assert "choose another --out" in error_line(hmt_slam("map", carmen, "--out", tmp_path / "out"))
    assert (tmp_path / obstacle).read_text() == "precious"


def test_map_makes_the_folder_and_replaces_it_and_plot_draws_from_it(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    for seed in (1, 2):
        result = hmt_slam("map", BAG, "--out", out, "--duration", 4, "--seed", seed)
        assert result.returncode == 0, result.stderr
        assert result.stdout.splitlines()[-1].startswith(f"{out}: ")
        assert (f"hmt_slam map: {out} has an earlier result, which is replaced" in result.stderr) is (seed == 2)
        assert ", 0 dropped" in result.stdout
        assert load_configuration(out / "hmt_map" / "configuration.yaml").seed == seed
    assert [entry.name for entry in out.parent.iterdir()] == ["out"]
    drawn = hmt_slam("plot", out)
    assert drawn.returncode == 0, drawn.stderr
    assert [Path(line).name for line in drawn.stdout.split()] == ["map.png", "pmf.png", "cost.png"]
    exported = hmt_slam("export", out)
    files = "".join(f"{out / name}\n" for name in ("topology.graphml", "landmarks.json", "places.json"))
    assert (exported.returncode, exported.stdout) == (0, files), exported.stderr


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_run_that_is_stopped_leaves_nothing_behind(tmp_path: Path, number: signal.Signals, status: int) -> None:
    command = [sys.executable, "-m", "hmt_slam_ros.cli.main", "map", str(BAG), "--out", str(tmp_path / "out")]
    run = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60.0
    while not any(tmp_path.iterdir()) and time.monotonic() < deadline:
        time.sleep(0.01)
    os.kill(run.pid, number)
    _, stderr = run.communicate(timeout=60)
    assert run.returncode == status, stderr
    assert "Traceback" not in stderr
    assert list(tmp_path.iterdir()) == []


STOPPED_WHILE_KERNELS_ARE_LOADED = """
import os, sys
from llvmlite.binding.executionengine import ExecutionEngine
from hmt_slam_ros.cli.main import main
find = ExecutionEngine._find_module_ptr
def told(self, pointer):
    # LLVM called back; the handler runs before this returns.
    os.kill(os.getpid(), {number})
    return find(self, pointer)
ExecutionEngine._find_module_ptr = told
sys.exit(main({arguments!r}))
"""


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_run_that_is_stopped_while_llvm_loads_a_kernel_ends_in_good_order(
    tmp_path: Path, number: signal.Signals, status: int
) -> None:
    """What is raised in a function that LLVM calls is lost, and the kernel with it: a crash, or a run that goes on."""
    assert hmt_slam("map", BAG, "--out", tmp_path / "out", "--duration", 4).returncode == 0
    shutil.rmtree(tmp_path / "out")
    arguments = ["map", str(BAG), "--out", str(tmp_path / "out"), "--duration", "4", "--jobs", "1"]
    code = STOPPED_WHILE_KERNELS_ARE_LOADED.format(number=int(number), arguments=arguments)
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120.0, check=False)
    assert result.returncode == status, result.stderr
    assert "Exception ignored" not in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_convert_says_what_it_wrote(tmp_path: Path, carmen: Path) -> None:
    result = hmt_slam("convert", carmen, tmp_path / "bag")
    assert result.returncode == 0, result.stderr
    assert "20 scans, 19.0 s" in result.stdout
    assert (tmp_path / "bag" / "metadata.yaml").is_file()
    error_line(hmt_slam("convert", carmen, tmp_path / "bag"))


def test_evaluate_prints_the_errors_of_a_trajectory(tmp_path: Path) -> None:
    (tmp_path / "trajectory.tum").write_text("0.0 0 0 0 0 0 0 1\n70.0 1 0 0 0 0 0 1\n")
    (tmp_path / "true.relations").write_text("0.0 70.0 1.25 0 0 0 0 0\n")
    result = hmt_slam("evaluate", tmp_path, "--relations", tmp_path / "true.relations")
    assert result.returncode == 0, result.stderr
    assert "0.250" in result.stdout
    assert "over 60 s" in result.stdout
    error_line(hmt_slam("evaluate", tmp_path, "--relations", tmp_path / "missing"))


@pytest.mark.parametrize("command", ["plot", "export"])
def test_plot_and_export_of_something_else_are_refused(tmp_path: Path, command: str) -> None:
    error_line(hmt_slam(command, tmp_path))


def test_parameters_prints_a_file_that_config_reads_back(tmp_path: Path) -> None:
    printed = hmt_slam("parameters", "--set", "filter.particles=7").stdout
    file = tmp_path / "mine.yaml"
    file.write_text(printed)
    again = hmt_slam("parameters", "--config", file, "--set", "robot.loop=true", "--seed", 3).stdout
    tree = yaml.safe_load(again)["/**"]["ros__parameters"]
    expected = as_nested(Configuration())
    expected["filter"]["particles"], expected["robot"]["loop"], expected["seed"] = 7, True, 3
    assert tree == expected
