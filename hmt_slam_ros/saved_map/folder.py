"""A folder of typed documents with a manifest, replaced atomically.

The manifest lists every file with its size and SHA-256, and has an SHA-256 of its own. A reader verifies all of them.
"""

from __future__ import annotations

import gc
import hashlib
import json
import stat
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
from hmt_slam_ros.saved_map.validation import check_record
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.untrusted_input import MAX_FILE_BYTES, is_short_text, parse_json, read_file, shorten

FORMAT, VERSION = "hmt_map", 32
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

_MAX_MANIFEST_BYTES = 1_000_000
"""Of a manifest; that of a map has 3,000."""

_MAX_JSON_BYTES = 1_000_000_000
"""Of a document without its arrays; that of a map of 1,000 areas has some millions."""

Document = TypeVar("Document")


def foreign_entry(folder: Path, kind: str) -> Path | None:
    """What keeps a folder from being one of documents that the package wrote, None where nothing does.

    :param kind: format of the folder; the version may be any.
    :returns: the manifest where it is missing or of something else, or an entry that it does not list.
    """
    manifest = folder / MANIFEST
    try:
        content = parse_json(read_file(manifest, _MAX_MANIFEST_BYTES), shorten(manifest))
    except HmtSlamError:
        return manifest
    files = content.get("files") if isinstance(content, dict) and content.get("format") == kind else None
    if not isinstance(files, dict) or manifest.is_symlink():
        return manifest
    own = {*files, MANIFEST}
    return next((entry for entry in sorted(folder.iterdir()) if entry.name not in own or not _is_file(entry)), None)


def _is_file(path: Path) -> bool:
    return path.is_file() and not path.is_symlink()


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
        self._sizes = {name: entry["bytes"] for name, entry in manifest["files"].items()}
        self.names = frozenset(self._sizes)
        for name, entry in manifest["files"].items():
            self._check_file(name, entry["bytes"], entry["sha256"])
        self._scans = ScanReader(self._read_document(SCANS, ScanTable, {}))

    def _read_manifest(self, kind: str, version: int) -> dict[str, Any]:
        path, shown = self._directory / MANIFEST, shorten(self._directory)
        try:
            manifest = parse_json(read_file(path, _MAX_MANIFEST_BYTES), shorten(path))
        except HmtSlamError as fault:
            if isinstance(fault.__cause__, OSError):
                raise HmtSlamError(
                    f"{shown} holds no {kind}, there is no {MANIFEST} to read ({fault.__cause__.strerror}): give an "
                    f"output folder, or the {kind} in it"
                ) from fault
            if isinstance(fault.__cause__, ValueError):
                raise HmtSlamError(f"{path} is truncated or damaged, it is no JSON: {_REMEDY}") from fault
            raise
        if not isinstance(manifest, dict) or manifest.get("format") != kind:
            raise HmtSlamError(f"{path} is of something else than a {kind}: give an output folder, or the {kind} in it")
        if manifest.get("version") != version:
            raise HmtSlamError(
                f"{shown} is a {kind} of version {shorten(manifest.get('version'))}, this program reads version "
                f"{version}: map the log again"
            )
        if manifest.get("sha256") != _manifest_digest(manifest):
            raise HmtSlamError(f"{path} is damaged, it is not as it was written: {_REMEDY}")
        _check_entries(manifest.get("files"), path)
        return manifest

    def _check_file(self, name: str, size: int, digest: str) -> None:
        path = self._directory / name
        try:
            status = path.stat()
            if not stat.S_ISREG(status.st_mode):
                raise HmtSlamError(f"{path} is no regular file: {_REMEDY}")
            if status.st_size != size:
                raise HmtSlamError(
                    f"{path} is truncated or damaged, it has {status.st_size} of {size} bytes: {_REMEDY}"
                )
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
        for file in (f"{name}.json", f"{name}.bin"):
            if file not in self.names:
                raise HmtSlamError(f"{self._directory / MANIFEST} does not list {file}: {_REMEDY}")
        arrays = ArrayReader(self._read_file(f"{name}.bin"))
        with _without_garbage_collection():
            content = parse_json(self._read_file(f"{name}.json"), f"{name}.json of the map", _MAX_JSON_BYTES)
            forms = {np.ndarray: arrays.reader, **forms}
            return PlainDataReader(FORMAT_DOC, forms, check_record).read(content, kind, name)

    def _read_file(self, name: str) -> bytes:
        return read_file(self._directory / name, self._sizes[name])


def _check_entries(files: object, path: Path) -> None:
    """Check that the entries of a manifest are files of its folder.

    :raises HmtSlamError: where one has another form, or a name that leads elsewhere.
    """
    if not isinstance(files, dict):
        raise HmtSlamError(f"{path} lists no files: {_REMEDY}")
    for name, entry in files.items():
        if not is_short_text(name) or "/" in name or name in ("", ".", "..", MANIFEST):
            raise HmtSlamError(f"{path} lists {shorten(name)}, which is no file of its folder: {_REMEDY}")
        match entry:
            case {"bytes": int(size), "sha256": str()} if 0 <= size <= MAX_FILE_BYTES:
                pass
            case _:
                raise HmtSlamError(f"{path} lists {name} without its bytes and SHA-256: {_REMEDY}")


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
