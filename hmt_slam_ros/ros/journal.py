"""Journal of a node: values on lines of JSON that name their types, and their arrays in a file beside them.

Arrays are written before the line. An incomplete last line is ignored. Nothing is flushed to the disk, since the system
keeps what a killed process has written.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.plain_data import PlainDataReader, to_plain
from hmt_slam_ros.saved_map.arrays import ArrayReader, ArrayWriter

LINES, _ARRAYS = "jsonl", "bin"
"""Suffixes of the files of a journal."""

HEADER, OUTPUT, INPUT = "base", "said", "heard"
"""Roles of values in a journal."""

_FORMAT_DOC = "docs/decisions/0033-journal-recovery.md"


class JournalEntry(NamedTuple):
    """A value in a journal with its role: header, output or input."""

    role: str
    value: object


class Journal:
    """Writer of a journal, the files ``<stem>.jsonl`` and ``<stem>.bin``.

    :ivar size: bytes written.
    """

    def __init__(self, folder: Path, stem: str) -> None:
        """Create the files.

        :raises OSError: where that fails.
        """
        self.size = 0
        lines = folder / f"{stem}.{LINES}"
        if lines.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(lines))
        # First, since a reader that finds lines looks for their arrays. Arrays without lines count for nothing.
        self._bytes = (folder / f"{stem}.{_ARRAYS}").open("wb")
        try:
            self._lines = lines.open("xb", buffering=0)
            fcntl.flock(self._lines, fcntl.LOCK_EX)  # released when the process ends, however it does
        except OSError:
            self._bytes.close()
            raise
        self._arrays = ArrayWriter(self._bytes)

    def append(self, role: str, value: object) -> None:
        """Write a value.

        :raises OSError: where that fails.
        """
        content = to_plain(value, {np.ndarray: self._arrays.store})
        self._bytes.flush()
        entry = {"role": role, "kind": type(value).__name__, "value": content}
        line = json.dumps(entry, separators=(",", ":")).encode() + b"\n"
        if self._lines.write(line) != len(line):
            raise OSError(0, "the disk is full")
        self.size = self._bytes.tell() + self._lines.tell()

    def close(self) -> None:
        """Close the files."""
        self._lines.close()
        with suppress(OSError):  # a full disk refused bytes that no line refers to
            self._bytes.close()


@dataclass(frozen=True)
class UnreadableInput:
    """An input in a journal that is none, such as one of an older version; ``fault`` says why."""

    fault: str


def is_in_use(path: Path) -> bool:
    """Whether a running process writes a journal."""
    with path.open("rb") as file, suppress(BlockingIOError):
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        return False
    return True


def read_journal(folder: Path, stem: str, kinds: Mapping[str, type]) -> Iterator[JournalEntry]:
    """The values of a journal in their order; an input that cannot be read is :class:`UnreadableInput`.

    :param kinds: {name: type} of the allowed values.
    :raises HmtSlamError: where the journal is damaged.
    """
    arrays = ArrayReader((folder / f"{stem}.{_ARRAYS}").read_bytes())
    values = PlainDataReader(_FORMAT_DOC, {np.ndarray: arrays.reader})
    content = (folder / f"{stem}.{LINES}").read_bytes()
    for number, line in enumerate(content.split(b"\n")[:-1]):
        path = f"{folder / stem}.{LINES}[{number}]"
        try:
            entry = json.loads(line)
            role, kind = entry["role"], kinds[entry["kind"]]
        except (ValueError, KeyError) as fault:
            raise HmtSlamError(f"{path} is damaged ({fault}): remove {folder.parent}, and restart all nodes") from fault
        try:
            value: object = values.read(entry["value"], kind, path)
        except HmtSlamError as fault:
            if role != INPUT:
                raise
            value = UnreadableInput(str(fault))
        yield JournalEntry(role, value)
