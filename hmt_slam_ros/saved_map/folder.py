"""A folder of typed documents with a manifest, replaced atomically.

The manifest lists every file with its size and SHA-256, and has an SHA-256 of its own. A reader verifies all of them.
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
"""Format of a saved map, and the version of its documents."""

HMT_MAP = "hmt_map"
"""Folder of the map in an output folder."""

CONFIGURATION = "configuration.yaml"
"""File of the parameters in a map."""

MANIFEST = "manifest.json"
"""File with size and SHA-256 of all other files."""

SCANS = "scans"
"""Document of all scans."""

FORMAT_DOC = "docs/reference/map_format.md"
"""Description of the documents."""

_REMEDY = "take a copy that is whole, or map the log again"
"""Advice for a damaged folder."""

_AT_FDCWD, _RENAME_EXCHANGE = -100, 2
"""Arguments of renameat2(2): paths are relative to the working directory; exchange two names."""

Document = TypeVar("Document")


def replace_folder(new: Path, target: Path) -> None:
    """Exchange a folder with ``target``, or move it there where ``target`` does not exist.

    :param new: complete folder on the same file system.
    :raises OSError: where the folder cannot be moved.
    """
    _flush(new)
    if not target.exists():
        new.rename(target)
    elif not _exchange(new, target):
        # The file system cannot exchange two names: for a moment, there is no target.
        aside = new.with_name(f"{new.name}.old")
        target.rename(aside)
        new.rename(target)
        aside.rename(new)
    _flush_folder(target.parent)


def _exchange(one: Path, other: Path) -> bool:
    """Exchange two names; returns False where the file system cannot."""
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
    """Flush a folder and all in it to the disk."""
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


@dataclass(frozen=True)
class FileRecord:
    """A file of a folder.

    :ivar name: name of the file.
    :ivar size: size, bytes.
    :ivar sha256: SHA-256 of its content, hexadecimal.
    """

    name: str
    size: int
    sha256: str


class _HashingFile:
    """A file that counts and hashes its content while it is written."""

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
    """Writes documents into a folder, then their scans, then the manifest."""

    def __init__(self, directory: Path) -> None:
        """:param directory: folder, made where it is missing."""
        directory.mkdir(exist_ok=True)
        self._directory = directory
        self._scans = ScanWriter()
        self._files: dict[str, FileRecord] = {}

    @property
    def files(self) -> tuple[FileRecord, ...]:
        """The files that were written or added."""
        return tuple(self._files.values())

    def add_files(self, files: Iterable[FileRecord]) -> None:
        """Add files that another process wrote into the folder. Their scans must be in documents of this writer."""
        self._files |= {file.name: file for file in files}

    def write(self, name: str, document: object) -> None:
        """Write a document; equal documents give equal bytes."""
        with (self._directory / f"{name}.bin").open("wb") as file, _without_garbage_collection():
            hashed = _HashingFile(file)
            content = to_plain(document, {np.ndarray: ArrayWriter(hashed).store, Scan: self._scans.store})
        self.add_files([hashed.to_record(f"{name}.bin")])
        self.write_text(f"{name}.json", json.dumps(content, allow_nan=False, separators=(",", ":")) + "\n")

    def write_text(self, name: str, text: str) -> None:
        """Write a text file."""
        with (self._directory / name).open("wb") as file:
            hashed = _HashingFile(file)
            hashed.write(text.encode())
        self.add_files([hashed.to_record(name)])

    def finish(self, kind: str, version: int) -> None:
        """Write the scans and the manifest.

        :param kind: format of the folder.
        :param version: version of its documents.
        """
        self.write(SCANS, self._scans.table)
        files = {name: {"bytes": file.size, "sha256": file.sha256} for name, file in sorted(self._files.items())}
        content: dict[str, object] = {"format": kind, "version": version, "files": files}
        content["sha256"] = _manifest_digest(content)
        text = json.dumps(content, indent=1, allow_nan=False) + "\n"
        (self._directory / MANIFEST).write_text(text, encoding="utf-8")


class FolderReader:
    """Reads documents from a folder and verifies it.

    :ivar names: names of the files.
    """

    def __init__(self, directory: Path, kind: str, version: int) -> None:
        """Verify the whole folder.

        :param kind: expected format.
        :param version: expected version of its documents.
        :raises HmtSlamError: where format or version differ, or a file is missing or damaged.
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

        :param name: name of the document.
        :param kind: its class.
        :raises HmtSlamError: where it has another form; names the field.
        """
        return self._read_document(name, kind, {Scan: self._scans.reader})

    def _read_document(self, name: str, kind: type[Document], forms: Mapping[type, ReaderFactory]) -> Document:
        arrays = ArrayReader((self._directory / f"{name}.bin").read_bytes())
        with _without_garbage_collection():
            content = json.loads((self._directory / f"{name}.json").read_text(encoding="utf-8"))
            return PlainDataReader(FORMAT_DOC, {np.ndarray: arrays.reader, **forms}).read(content, kind, name)


@contextmanager
def _without_garbage_collection() -> Iterator[None]:
    """A context without garbage collection, which is wasted on many lasting objects made at once."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _manifest_digest(manifest: Mapping[str, object]) -> str:
    """SHA-256 of a manifest without its own digest."""
    content = {name: value for name, value in manifest.items() if name != "sha256"}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
