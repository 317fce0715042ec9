"""Outcomes of a measurement in a file, from which an interrupted one continues; work that shares a large value."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

from benchmark import localization
from benchmark.simulated.records import code_hash

Shared = TypeVar("Shared")
Item = TypeVar("Item")
Result = TypeVar("Result")

_SHARED: list[Any] = []


class OutcomesFile:
    """A file with a JSON document in each line.

    :ivar file: its path; it need not exist.
    """

    def __init__(self, file: Path) -> None:
        self.file = file

    def rows(self) -> list[Any]:
        """The documents, in the order in which they were added."""
        lines = self.file.read_text(encoding="utf-8").splitlines() if self.file.is_file() else []
        return [json.loads(line) for line in lines]

    def add(self, row: Any) -> None:  # noqa: ANN401  any document
        """Add a document."""
        self.file.parent.mkdir(parents=True, exist_ok=True)
        with self.file.open("a", encoding="utf-8") as target:
            target.write(json.dumps(row) + "\n")


def fingerprint(changes: Sequence[str], *files: Path) -> str:
    """A hash of the program and the changed parameters, which names the file of its outcomes.

    :param changes: parameters that differ from the file, as ``name=value``.
    :param files: of the measurement.
    """
    digest = hashlib.sha256("\n".join([code_hash(), *changes]).encode())
    for file in (Path(localization.__file__), *files):
        digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def map_shared(
    function: Callable[[Shared, Item], Result], shared: Shared, items: Iterable[Item], jobs: int
) -> Iterator[Result]:
    """The results of a function of a value and each of some items, in their order.

    :param shared: the value, which forked processes share.
    :param jobs: number of processes.
    """
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("fork"), _SHARED.append, (shared,)) as pool:
        yield from pool.map(_apply, ((function, item) for item in items))


def _apply(call: tuple[Callable[[Any, Any], Any], Any]) -> Any:  # noqa: ANN401  the result of any function
    function, item = call
    return function(_SHARED[-1], item)
