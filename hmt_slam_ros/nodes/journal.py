"""What a node hears and says, one value after the other, on disk before it works on it.

Each value is a line of JSON that names its type; arrays are in a file beside it, written before the line. A line that
was not written to its end, as the process was killed, is no line. Nothing is flushed to the disk itself: a process that
is killed takes nothing with it that the system has taken over.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.persistence.arrays import ReadArrays, WrittenArrays
from hmt_slam_ros.plain_data import Values, plain

_LINES, _ARRAYS = "jsonl", "bin"
_DESCRIBED = "docs/architecture.md"


class Entry(NamedTuple):
    """A value in a journal.

    :ivar role: what it is there for.
    :ivar value: itself.
    """

    role: str
    value: object


class Journal:
    """A journal that is written, a pair of files ``<stem>.jsonl`` and ``<stem>.bin``.

    :ivar size: bytes written.
    """

    def __init__(self, folder: Path, stem: str) -> None:
        """Begin it.

        :raises OSError: where it cannot be written.
        """
        self.size = 0
        self._lines = (folder / f"{stem}.{_LINES}").open("xb", buffering=0)
        self._bytes = (folder / f"{stem}.{_ARRAYS}").open("xb")
        self._arrays = WrittenArrays(self._bytes)

    def append(self, role: str, value: object) -> None:
        """Write a value.

        :raises OSError: where it cannot be written.
        """
        content = plain(value, {np.ndarray: self._arrays.plain})
        self._bytes.flush()
        entry = {"role": role, "kind": type(value).__name__, "value": content}
        line = json.dumps(entry, separators=(",", ":")).encode() + b"\n"
        if self._lines.write(line) != len(line):
            raise OSError(0, "the disk is full")
        self.size = self._bytes.tell() + self._lines.tell()

    def close(self) -> None:
        """Write nothing more."""
        self._lines.close()
        with suppress(OSError):  # what a full disk did not take, of which there is no line either
            self._bytes.close()


def journal_entries(folder: Path, stem: str, kinds: Mapping[str, type]) -> Iterator[Entry]:
    """The values of a journal in their order.

    :param kinds: {name: type} of those that it may hold.
    :raises HmtSlamError: where it holds something else.
    """
    arrays = ReadArrays((folder / f"{stem}.{_ARRAYS}").read_bytes())
    values = Values(_DESCRIBED, {np.ndarray: arrays.reader})
    content = (folder / f"{stem}.{_LINES}").read_bytes()
    for number, line in enumerate(content.split(b"\n")[:-1]):
        path = f"{folder / stem}.{_LINES}[{number}]"
        try:
            entry = json.loads(line)
            role, kind = entry["role"], kinds[entry["kind"]]
        except (ValueError, KeyError) as fault:
            raise HmtSlamError(f"{path} is damaged ({fault}): remove {folder.parent}, and restart all nodes") from fault
        yield Entry(role, values.value(entry["value"], kind, path))
