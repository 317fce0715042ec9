"""External programs that place one occupancy grid in another, run beside ``python -m benchmark merge``.

A program is called as ``PROGRAM first/map.yaml second/map.yaml``, with maps as nav2's map_server reads them. It prints
one line: ``x y yaw confidence``, the pose of the second map's frame in that of the first, m and rad; or ``none``.
``benchmark/map_merge`` builds such a program.
"""

from __future__ import annotations

import math
import os
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmark.placement_truth import MIN_OVERLAP, RIGHT, RIGHT_ANGLE, KeyframePoses, are_right, rigid_errors
from hmt_slam_ros.errors import HmtSlamError

VARIABLE = "MAP_MERGE_PROGRAMS"
"""Environment variable with the paths of programs, separated as in PATH."""

NONE = "none"
"""The line of a program that does not join the maps."""

TIMEOUT = 600.0
"""Longest time for two maps, s."""

_SHOWN = 200  # characters of an output that go into a message

PROGRAM_POLICY = (
    "External programs get the occupancy grids of both maps. A join is due where the second part has "
    f"{MIN_OVERLAP:g} m of path or more on ground of the first. A join by one pose is right if most keyframes of the "
    f"second part on common ground are within {RIGHT:g} m and {math.degrees(RIGHT_ANGLE):.0f} degrees of the truth, as "
    "seen from the nearest one of the first."
)

JOINS = ("right", "wrong", "none")
"""What becomes of two maps."""

FAILED = "failed"
"""Where a program gave no answer."""


@dataclass(frozen=True)
class GridAnswer:
    """What a program found for two grids.

    :ivar pose: ``first_T_second``, (x, y, theta), m and rad; None where it does not join them.
    :ivar confidence: by the program's own measure, NaN without a pose.
    :ivar fault: why there is no answer; empty for an answer.
    """

    pose: tuple[float, float, float] | None = None
    confidence: float = math.nan
    fault: str = ""


@dataclass(frozen=True)
class ProgramOutcome:
    """What an external program made of two maps.

    :ivar program: its file name.
    :ivar outcome: of ``JOINS``, or ``FAILED``.
    :ivar answer: as it was given.
    """

    program: str
    outcome: str
    answer: GridAnswer


def chosen_programs() -> Mapping[str, Path]:
    """{file name: program} of those that the environment variable names.

    :raises HmtSlamError: for one that cannot be run, and for two with the same name.
    """
    paths = [Path(word).absolute() for word in os.environ.get(VARIABLE, "").split(os.pathsep) if word]
    for path in paths:
        if not (path.is_file() and os.access(path, os.X_OK)):
            raise HmtSlamError(f"{VARIABLE} names {path}, which cannot be run: build it, or unset {VARIABLE}")
    programs = {path.name: path for path in paths}
    if len(programs) < len(paths):
        raise HmtSlamError(f"{VARIABLE} names two programs with the same file name: rename one of them")
    return programs


def place_grids(program: Path, first: Path, second: Path) -> GridAnswer:
    """Where a program places one grid in another.

    :param first: folder with map.yaml and map.pgm; ``second`` likewise.
    """
    command = [str(program), str(first / "map.yaml"), str(second / "map.yaml")]
    try:
        result = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=TIMEOUT,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return GridAnswer(fault=f"{program.name} took more than {TIMEOUT:g} s")
    except OSError as fault:
        return GridAnswer(fault=f"{program.name} did not start: {fault.strerror}")
    if result.returncode:
        last = result.stderr.strip()[-_SHOWN:] or "nothing"
        return GridAnswer(fault=f"{program.name} ended with {result.returncode}, and its errors with: {last}")
    return parse_answer(program.name, result.stdout)


def parse_answer(name: str, output: str) -> GridAnswer:
    """The answer that a program printed.

    :param name: of the program.
    """
    if output.strip() == NONE:
        return GridAnswer()
    try:
        x, y, yaw, confidence = map(float, output.split())
    except ValueError:
        x = y = yaw = confidence = math.nan
    if not all(map(math.isfinite, (x, y, yaw, confidence))):
        return GridAnswer(fault=f"{name} printed {output[:_SHOWN]!r} instead of 'x y yaw confidence' or '{NONE}'")
    return GridAnswer((x, y, yaw), confidence)


def judge_answer(name: str, answer: GridAnswer, poses: tuple[KeyframePoses, KeyframePoses] | None) -> ProgramOutcome:
    """The answer of a program, right or wrong.

    :param name: of the program.
    :param poses: keyframes of both maps, None where they are of different buildings.
    """
    if answer.fault:
        return ProgramOutcome(name, FAILED, answer)
    if answer.pose is None:
        return ProgramOutcome(name, "none", answer)
    is_right = poses is not None and are_right(rigid_errors(np.array(answer.pose), *poses))
    return ProgramOutcome(name, "right" if is_right else "wrong", answer)
