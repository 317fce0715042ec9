"""Coverage-guided fuzzing of the readers by atheris, a process for each; ``python -m benchmark fuzz --logs guided``."""

from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from hmt_slam_ros.errors import HmtSlamError

_ROOT = Path(__file__).parents[2]

_LIMITS = ("-timeout=10", "-rss_limit_mb=1536", "-max_len=65536", "-print_final_stats=1", "-verbosity=0")


class GuidedRun(NamedTuple):
    """A run of one target.

    :ivar target: its name.
    :ivar executions: how often the reader was called.
    :ivar fault: what ended it, empty where nothing did.
    :ivar file: with the bytes that did, None without.
    """

    target: str
    executions: int
    fault: str
    file: Path | None


def fuzz_guided(target: str, seconds: float, folder: Path, seed: int) -> GuidedRun:
    """Fuzz a target from its corpus.

    :param folder: for what is found, made where it is missing.
    :raises HmtSlamError: where atheris is not installed.
    """
    if find_spec("atheris") is None:
        raise HmtSlamError("atheris is not installed: pip install -r requirements/fuzz.txt")
    from benchmark.fuzz.targets import CORPUS  # noqa: PLC0415  the process that fuzzes imports it with its counters

    found = folder / target
    found.mkdir(parents=True, exist_ok=True)
    limits = (*_LIMITS, f"-max_total_time={max(int(seconds), 1)}", f"-seed={seed + 1}")
    finished = subprocess.run(
        [sys.executable, "-m", __name__, target, f"-artifact_prefix={found}/fault-", *limits, found, CORPUS / target],
        capture_output=True,
        check=False,
        timeout=seconds + 300.0,
    )
    text = finished.stderr.decode("utf-8", "replace")
    executions = [int(line.split()[-1]) for line in text.splitlines() if "number_of_executed_units" in line]
    faults = sorted(found.glob("fault-*"))
    if finished.returncode == 0 and not faults:
        return GuidedRun(target, sum(executions), "", None)
    return GuidedRun(target, sum(executions), text[-3000:], faults[0] if faults else None)


def main(arguments: list[str]) -> None:
    """Fuzz the target that the first argument names; the others are those of libFuzzer."""
    import atheris  # noqa: PLC0415  only here

    with atheris.instrument_imports(include=["hmt_slam_ros", "rosbags"], exclude=_modules_with_kernels()):
        from benchmark.fuzz import targets  # noqa: PLC0415  with counters

    name = arguments[0]
    for content in targets.corpus(name):
        targets.accepts(name, content)  # compiles and loads what it needs
    atheris.Setup([sys.argv[0], *arguments[1:]], lambda content: targets.accepts(name, content) and None)
    atheris.Fuzz()


def _modules_with_kernels() -> list[str]:
    """Modules that are left as they are: numba cannot compile functions that count their branches."""
    package = _ROOT / "hmt_slam_ros"
    return [
        ".".join(path.relative_to(_ROOT).with_suffix("").parts)
        for path in package.rglob("*.py")
        if "import njit" in path.read_text(encoding="utf-8")
    ]


if __name__ == "__main__":
    main(sys.argv[1:])
