"""A folder of typed documents with a manifest that tells whether all is well, replaced at one stroke.

The manifest lists every file with its size and its SHA-256, and holds its own, so that nothing is read that is not what
was written.
"""

from __future__ import annotations

import ctypes
import errno
import gc
import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.plain_data import PlainDataReader, ReaderFactory, to_plain
from hmt_slam_ros.saved_map.arrays import ArrayReader, ArrayWriter
from hmt_slam_ros.saved_map.scans import ScanReader, ScanTable, ScanWriter
from hmt_slam_ros.sensors import Scan

FORMAT, VERSION = "hmt_map", 18

HMT_MAP = "hmt_map"
"""The folder in an output folder."""

CONFIGURATION = "configuration.yaml"
"""The file of its parameters."""


_AT_FDCWD = -100  # AT_FDCWD: paths are relative to the working directory
_RENAME_EXCHANGE = 2  # RENAME_EXCHANGE


def replace_folder(new: Path, target: Path) -> None:
    """Make a folder stand at ``target``; what stood there before then stands at ``new``.

    :param new: on the same file system, written to the end.
    :raises OSError: where that cannot be.
    """
    _flush(new)
    if not target.exists():
        new.rename(target)
    elif not _exchange(new, target):
        # A file system that cannot exchange two names: for a moment there is none.
        aside = new.with_name(f"{new.name}.old")
        target.rename(aside)
        new.rename(target)
        aside.rename(new)
    _flush_folder(target.parent)


def _exchange(one: Path, other: Path) -> bool:
    """Whether two names were exchanged; not every file system can."""
    libc = ctypes.CDLL(None, use_errno=True)
    if not hasattr(libc, "renameat2"):
        return False
    if libc.renameat2(_AT_FDCWD, os.fsencode(one), _AT_FDCWD, os.fsencode(other), _RENAME_EXCHANGE) == 0:
        return True
    fault = ctypes.get_errno()
    if fault in (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP):
        return False
    raise OSError(fault, os.strerror(fault), str(other))


def _flush(folder: Path) -> None:
    """See to it that a folder and all in it outlast a loss of power."""
    for entry in folder.iterdir():
        if entry.is_dir():
            _flush(entry)
        else:
            with entry.open("rb") as file:
                os.fsync(file.fileno())
    _flush_folder(folder)


def _flush_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


MANIFEST = "manifest.json"
FORMAT_DOC = "docs/reference/map_format.md"
SCANS = "scans"
_REMEDY = "take a copy that is whole, or map the log again"

Document = TypeVar("Document")


@dataclass(frozen=True)
class FileRecord:
    """A file as it was written.

    :ivar name: its name in the folder.
    :ivar size: its size.
    :ivar sha256: its hash, hexadecimal.
    """

    name: str
    size: int
    sha256: str


class _HashingFile:
    """A file that counts and hashes what is written to it."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._digest = hashlib.sha256()
        self._size = 0

    def write(self, content: bytes) -> None:
        self._file.write(content)
        self._digest.update(content)
        self._size += len(content)

    def to_record(self, name: str) -> FileRecord:
        return FileRecord(name, self._size, self._digest.hexdigest())


class FolderWriter:
    """Writes documents into a folder, then all scans that they speak of, then the manifest."""

    def __init__(self, directory: Path) -> None:
        """:param directory: made where it is missing."""
        directory.mkdir(exist_ok=True)
        self._directory = directory
        self._scans = ScanWriter()
        self._files: dict[str, FileRecord] = {}

    @property
    def files(self) -> tuple[FileRecord, ...]:
        """What was written."""
        return tuple(self._files.values())

    def add_files(self, files: Iterable[FileRecord]) -> None:
        """Take in what another process wrote into the folder; the scans of that are among one's own."""
        self._files |= {file.name: file for file in files}

    def write(self, name: str, document: object) -> None:
        """Write a document, the same byte for byte for the same content."""
        with (self._directory / f"{name}.bin").open("wb") as file, _without_garbage_collection():
            hashed = _HashingFile(file)
            content = to_plain(document, {np.ndarray: ArrayWriter(hashed).store, Scan: self._scans.store})
        self.add_files([hashed.to_record(f"{name}.bin")])
        self.write_text(f"{name}.json", json.dumps(content, allow_nan=False, separators=(",", ":")) + "\n")

    def write_text(self, name: str, text: str) -> None:
        """Write a file of text."""
        with (self._directory / name).open("wb") as file:
            hashed = _HashingFile(file)
            hashed.write(text.encode())
        self.add_files([hashed.to_record(name)])

    def finish(self, kind: str, version: int) -> None:
        """Write the scans and the manifest.

        :param kind: what the folder holds; a reader refuses any other.
        :param version: of the form of its documents, likewise.
        """
        self.write(SCANS, self._scans.table)
        files = {name: {"bytes": file.size, "sha256": file.sha256} for name, file in sorted(self._files.items())}
        content: dict[str, object] = {"format": kind, "version": version, "files": files}
        content["sha256"] = _manifest_digest(content)
        text = json.dumps(content, indent=1, allow_nan=False) + "\n"
        (self._directory / MANIFEST).write_text(text, encoding="utf-8")


class FolderReader:
    """Reads documents from a folder of which everything is as it was written.

    :ivar names: of the files.
    """

    def __init__(self, directory: Path, kind: str, version: int) -> None:
        """Check the whole folder.

        :param kind: what it has to hold.
        :param version: of the form of its documents.
        :raises HmtSlamError: where it holds something else, of another version, or a file is missing or damaged.
        """
        self._directory = directory
        manifest = self._read_manifest(kind, version)
        self.names = frozenset(manifest["files"])
        for name, entry in manifest["files"].items():
            self._check_file(name, entry["bytes"], entry["sha256"])
        self._scans = ScanReader(self._read_document(SCANS, ScanTable, {}))

    def _read_manifest(self, kind: str, version: int) -> dict[str, Any]:
        path = self._directory / MANIFEST
        try:
            manifest = json.loads(path.read_text(encoding="utf-8"))
        except OSError as fault:
            raise HmtSlamError(
                f"{self._directory} holds no {kind}, there is no {MANIFEST} to read ({fault.strerror}): give an "
                f"output folder, or the {kind} in it"
            ) from fault
        except ValueError as fault:
            raise HmtSlamError(f"{path} is truncated or damaged, it is no JSON: {_REMEDY}") from fault
        if not isinstance(manifest, dict) or manifest.get("format") != kind:
            raise HmtSlamError(f"{path} is of something else than a {kind}: give an output folder, or the {kind} in it")
        if manifest.get("version") != version:
            raise HmtSlamError(
                f"{self._directory} is a {kind} of version {manifest.get('version')}, this program reads version "
                f"{version}: map the log again"
            )
        if manifest.get("sha256") != _manifest_digest(manifest):
            raise HmtSlamError(f"{path} is damaged, it is not as it was written: {_REMEDY}")
        return manifest

    def _check_file(self, name: str, size: int, digest: str) -> None:
        path = self._directory / name
        try:
            found = path.stat().st_size
            if found != size:
                raise HmtSlamError(f"{path} is truncated or damaged, it has {found} of {size} bytes: {_REMEDY}")
            with path.open("rb") as file:
                same = hashlib.file_digest(file, "sha256").hexdigest() == digest
        except OSError as fault:
            raise HmtSlamError(f"{path} is missing or cannot be read ({fault.strerror}): {_REMEDY}") from fault
        if not same:
            raise HmtSlamError(f"{path} is damaged, its SHA-256 is not that of {MANIFEST}: {_REMEDY}")

    def read(self, name: str, kind: type[Document]) -> Document:
        """A document.

        :raises HmtSlamError: where it is not of this form.
        """
        return self._read_document(name, kind, {Scan: self._scans.reader})

    def _read_document(self, name: str, kind: type[Document], forms: Mapping[type, ReaderFactory]) -> Document:
        arrays = ArrayReader((self._directory / f"{name}.bin").read_bytes())
        with _without_garbage_collection():
            content = json.loads((self._directory / f"{name}.json").read_text(encoding="utf-8"))
            return PlainDataReader(FORMAT_DOC, {np.ndarray: arrays.reader, **forms}).read(content, kind, name)


@contextmanager
def _without_garbage_collection() -> Iterator[None]:
    """The garbage collector need not look again and again through much that is made at once and stays."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _manifest_digest(manifest: Mapping[str, object]) -> str:
    """SHA-256 of all that a manifest holds besides it."""
    content = {name: value for name, value in manifest.items() if name != "sha256"}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
