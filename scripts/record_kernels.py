#!/usr/bin/env python3
"""Write hmt_slam_ros/kernel_table.txt: the kernels that nodes and commands call, with the types of the arguments.

Simulated drives and the bundled log are mapped, and each process handles its messages once more in an OS process of its
own. The nodes replay the bundled log. A table that exists keeps its lines, unless ``--new`` is given: what these drives
do not reach may be there already.
"""

from __future__ import annotations

import argparse
import os
import pickle
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

from hmt_slam_ros.kernel_table import COMMAND, TABLE, KernelCall, describe_types, known_calls

ROOT = Path(__file__).resolve().parents[1]
FOLDER = "KERNEL_CALLS"
"""Environment variable with the folder for the calls of one program: a file named ``USER.N``, and its inputs."""

LANDMARKS = ("aam.area_policy=both", "places.prior=true", "places.loops=true")
BUNDLED, OUT = str(ROOT / "data" / "malaga_one_loop"), "{out}"
COMMANDS: tuple[tuple[str, ...], ...] = (
    ("map", BUNDLED),
    ("map", "sim:office,seed=3,people=2,carried=0.6,to=0.2"),
    ("map", "sim:office,seed=3,visit=1", "--from", OUT, "--mode", "lifelong"),
    ("map", "sim:office,seed=3,visit=2", "--from", OUT, "--mode", "localization"),
    ("map", "sim:ring,laps=2,sweep=0.1", *(word for one in LANDMARKS for word in ("--set", one))),
    ("map", "sim:twins", "--set", "places.prior=true", "--set", "places.loops=true"),
    ("map", "sim:office,seed=5", "--duration", "120", "--set", "local_map.kind=lines"),
    ("map", "sim:nested", "--duration", "600"),
    ("map", "sim:institute", "--duration", "200"),
    ("map", "sim:office,size=0.7,seed=51", "sim:office,size=0.7,seed=51,visit=1", "--team", "--duration", "150"),
    ("doctor", BUNDLED),
    ("doctor", "sim:office", "--duration", "60"),
)
"""Commands; ``{out}`` is the folder of the last one that mapped without --from."""

FOR_SUBSCRIBERS = dict.fromkeys(
    (
        "hmt_slam_ros.grids.occupancy_map:_vote",
        "hmt_slam_ros.grids.virtual_scan:_cast_beams",
        "hmt_slam_ros.landmarks.landmarks:_find_corners",
        "hmt_slam_ros.landmarks.line_extraction:_extract",
        "hmt_slam_ros.landmarks.line_extraction:_gap_starts",
        "hmt_slam_ros.landmarks.line_extraction:_visible_segments",
        "hmt_slam_ros.landmarks.line_extraction:partition_beams",
        "hmt_slam_ros.landmarks.openings:_select_openings",
    ),
    "tlca",
)
"""{kernel: node} of what a node calls only for subscribers of a topic."""

Calls = dict[tuple[str, str], set[str]]
"""{("module:name", types of the arguments): users}."""


def main() -> None:
    """Record all calls and write the table, or run one program that is recorded."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--new", action="store_true", help="begin with an empty table")
    parser.add_argument("--run", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.run:
        run_recorded(*options.run)
        return
    calls: Calls = defaultdict(set)
    if options.new:
        TABLE.unlink(missing_ok=True)
    for call in () if options.new else known_calls():
        calls[call.kernel, call.arguments].update(call.users)
    with tempfile.TemporaryDirectory() as folder:
        record_commands(Path(folder), calls)
        record_program(Path(folder), calls, "command", "replay", BUNDLED, "--out", f"{folder}/replay")
    for (kernel, _), users in calls.items():
        users.update([FOR_SUBSCRIBERS[kernel]] if kernel in FOR_SUBSCRIBERS else [])
    write_table(calls)


def record_commands(folder: Path, calls: Calls) -> None:
    """Run all commands, and the processes of those that map."""
    out = folder / "out0"
    for number, (name, *words) in enumerate(COMMANDS):
        arguments = [word.format(out=out) for word in words]
        if name == "map":
            out = out if "--from" in arguments else folder / f"out{number}"
            # With two jobs copies of metric SLAM work ahead, and would record in its place.
            arguments += ["--jobs", "1", "--out", str(out if "--from" not in arguments else folder / "further")]
        record_program(folder, calls, "command", name, *arguments)


def record_program(folder: Path, calls: Calls, *words: str) -> None:
    """Run a program and the processes in it, and add their calls."""
    print(*words, flush=True)
    with tempfile.TemporaryDirectory(dir=folder) as recorded:
        run_program(recorded, *words)
        for inputs in Path(recorded).glob("*.inputs"):
            run_program(recorded, "process", inputs.stem)
        for path in Path(recorded).glob("*.calls"):
            for call in pickle.loads(path.read_bytes()):  # noqa: S301  written below
                calls[call].add(path.name.partition(".")[0])


def run_program(recorded: str, *words: str) -> None:
    """Run this file with ``--run``."""
    command = [sys.executable, __file__, "--run", *words]
    subprocess.run(command, env=os.environ | {FOLDER: recorded}, check=True, stdout=subprocess.DEVNULL)


def run_recorded(kind: str, *words: str) -> None:
    """Run a command, a node or a process, and write its calls of kernels at its end."""
    folder, calls = Path(os.environ[FOLDER]), record_calls()
    try:
        if kind == "command":
            run_command(folder, *words)
        elif kind == "node":
            from hmt_slam_ros.ros.run_node import run_node  # noqa: PLC0415  it sets handlers of signals

            sys.argv = ["-m", *words[1:]]
            run_node(words[0])
        else:
            run_process(folder, words[0])
    finally:
        user = COMMAND if kind == "command" else words[0]
        (folder / f"{user}.{os.getpid()}.calls").write_bytes(pickle.dumps(calls))


def record_calls() -> set[tuple[str, str]]:
    """A set to which each call from Python adds its kernel and types, if it is the first one of these types."""
    import hmt_slam_ros.cli  # noqa: PLC0415, F401  it sets the number of threads before numpy is loaded

    # isort: split
    from numba.core.dispatcher import Dispatcher  # noqa: PLC0415

    calls: set[tuple[str, str]] = set()
    compile_for_arguments = Dispatcher._compile_for_args  # type: ignore[attr-defined]

    def compile_recorded(kernel: Any, *arguments: Any, **named: Any) -> Any:  # noqa: ANN401  numba has no types
        assert not named, "a kernel is called with arguments by name"
        types = tuple(kernel.typeof_pyval(argument) for argument in arguments)
        if kernel.py_func.__module__.startswith("hmt_slam_ros."):
            calls.add((f"{kernel.py_func.__module__}:{kernel.py_func.__name__}", describe_types(types)))
        return compile_for_arguments(kernel, *arguments)

    Dispatcher._compile_for_args = compile_recorded  # type: ignore[attr-defined]
    return calls


def run_command(folder: Path, *words: str) -> None:
    """Run a command; write the initial states and inputs of its processes, and record nodes that it starts."""
    from hmt_slam_ros.cli.main import main as run_main  # noqa: PLC0415  after the settings of numpy
    from hmt_slam_ros.process_table import ProcessRow  # noqa: PLC0415

    inputs: dict[str, list[bytes]] = {}
    make = ProcessRow.make

    def make_recorded(row: ProcessRow, configuration: Any, state: Any = None) -> Any:  # noqa: ANN401  any process
        own = inputs[row.name] = [pickle.dumps((configuration, state))]  # of a team, those of the last robot
        process = make(row, configuration, state)
        handle = process.handle

        def handle_recorded(message: Any) -> Any:  # noqa: ANN401  any message
            own.append(pickle.dumps(message))
            return handle(message)

        process.handle = handle_recorded
        return process

    if words[0] == "replay":
        from hmt_slam_ros.ros import node_processes  # noqa: PLC0415

        node_processes.node_command = lambda name: [__file__, "--run", "node", name]  # type: ignore[attr-defined]
    else:
        ProcessRow.make = make_recorded  # type: ignore[method-assign, assignment]
    assert run_main(list(words)) in (0, 1)
    for name, content in inputs.items():
        (folder / f"{name}.inputs").write_bytes(pickle.dumps(content))


def run_process(folder: Path, name: str) -> None:
    """Let a process handle its inputs once more."""
    from hmt_slam_ros.process_table import process_row  # noqa: PLC0415

    first, *messages = pickle.loads((folder / f"{name}.inputs").read_bytes())  # noqa: S301  written above
    process = process_row(name).make(*pickle.loads(first))  # noqa: S301
    for message in messages:
        process.handle(pickle.loads(message))  # noqa: S301


def write_table(calls: Calls) -> None:
    """Compile each kernel for its time, and write the table."""
    lines = [KernelCall(tuple(sorted(users)), 0.0, *call) for call, users in sorted(calls.items())]
    with tempfile.TemporaryDirectory() as cache:
        os.environ["NUMBA_CACHE_DIR"] = cache
        timed = [time_compilation(call) for call in lines]
    head = "# Users, seconds of compilation, kernel and arguments. Written by scripts/record_kernels.py."
    TABLE.write_text("\n".join([head, *(call.line() for call in timed if call), ""]), encoding="utf-8")


def time_compilation(call: KernelCall) -> KernelCall | None:
    """The call with the time that its compilation takes now; None for one that is no more."""
    try:
        kernel, types = call.resolve()
        begin = time.process_time()
        kernel.compile(types)
    except Exception as fault:  # numba's
        print(f"left out: {call.kernel}: {fault}")
        return None
    return KernelCall(call.users, time.process_time() - begin, call.kernel, call.arguments)


if __name__ == "__main__":
    main()
