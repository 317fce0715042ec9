"""Files and folders that the package writes: whole or not at all, and nothing of others is ever removed.

What is under way has a name of its own beside its place, with a dot in front. A process that is killed leaves it
behind, and the next one that writes to the same place removes it.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import re
import secrets
import shutil
import weakref
from contextlib import suppress
from pathlib import Path

from hmt_slam_ros.errors import HmtSlamError

_LOCK = "lock"
"""File of a scratch folder that is locked for as long as its process lives."""

_AT_FDCWD, _RENAME_EXCHANGE = -100, 2
"""Arguments of renameat2(2): paths are relative to the working directory; exchange two names."""

_ASIDE = "old"
"""Folder within a scratch folder that was its target for as long as there is no other."""

_REMAINS = re.compile(r"\.(?P<name>.+)\.partial-(?P<process>[0-9]+)")
"""Name of a file under way."""


def write_file(path: Path, content: bytes) -> None:
    """Write a file, which has its old content or the new one at any time.

    :raises HmtSlamError: where that cannot be done; nothing is left behind then.
    """
    partial = path.with_name(f".{path.name}.partial-{os.getpid()}")
    try:
        _clear_files(path)
        with partial.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
        with suppress(OSError):  # it stands there
            _flush_folder(path.parent)
    except OSError as fault:
        with suppress(OSError):
            partial.unlink()
        raise HmtSlamError(
            f"{path} cannot be written ({fault.strerror}): make room, or choose another folder"
        ) from fault


def is_remains_of(path: Path, names: frozenset[str]) -> bool:
    """Whether a file is what a killed process left of one of some names."""
    match = _REMAINS.fullmatch(path.name)
    return match is not None and match["name"] in names and path.is_file() and not path.is_symlink()


def _clear_files(path: Path) -> None:
    """Remove the files that killed processes left beside a path."""
    for entry in path.parent.iterdir():
        match = _REMAINS.fullmatch(entry.name)
        if match is not None and match["name"] == path.name and not _is_alive(int(match["process"])):
            entry.unlink(missing_ok=True)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True


def replace_folder(new: Path, target: Path) -> None:
    """Exchange a folder with ``target``, or move it there where ``target`` does not exist.

    :param new: complete folder on the same file system.
    :raises OSError: where the folder cannot be moved; ``target`` is as it was then.
    """
    _flush(new)
    if not target.exists():
        new.rename(target)
    elif not _exchange(new, target):
        _replace_in_two_steps(new, target)
    with suppress(OSError):  # it stands there
        _flush_folder(target.parent)


def _replace_in_two_steps(new: Path, target: Path) -> None:
    """Replace a folder where two names cannot be exchanged: for a moment, there is no target."""
    aside = new.with_name(_ASIDE)
    target.rename(aside)
    try:
        new.rename(target)
    except OSError:
        aside.rename(target)
        raise
    with suppress(OSError):  # it stands there
        aside.rename(new)


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


class ScratchFolder:
    """A folder for what is under way, locked by its process.

    :ivar path: of the folder.
    """

    def __init__(self, place: Path, folder: Path) -> None:
        """Make the folder, and remove those that killed processes left for the same place.

        :param place: path of what is made.
        :param folder: where the scratch folder is made, on the same file system.
        :raises OSError: where it cannot be made.
        """
        prefix = f".{place.name}.partial-"
        for entry in folder.iterdir():
            if entry.name.startswith(prefix) and not entry.is_symlink():
                _remove_abandoned(entry, place)
        self.path = folder / f"{prefix}{os.getpid()}-{secrets.token_hex(4)}"
        # Before it is made, since a signal may end the program between any two lines.
        self._removal = weakref.finalize(self, _remove_own_scratch, self.path, os.getpid())
        self.path.mkdir(mode=0o700)
        try:
            self._lock = os.open(self.path / _LOCK, os.O_CREAT | os.O_WRONLY | os.O_CLOEXEC)
        except OSError:
            self._removal()
            raise
        with suppress(OSError):  # a file system without locks: the folder is never taken for an abandoned one
            fcntl.flock(self._lock, fcntl.LOCK_EX)
            # Only now: another process that looks at an empty lock takes the folder for one that is being made.
            os.write(self._lock, f"{os.getpid()}\n".encode())

    def remove(self) -> None:
        """Remove the folder with all in it, as happens otherwise when it is not used any more or the program ends."""
        self._removal()
        os.close(self._lock)


def _remove_own_scratch(folder: Path, process: int) -> None:
    """Remove a scratch folder, but not in a process that was forked from its own."""
    if os.getpid() == process:
        _remove_scratch(folder)


def _remove_abandoned(folder: Path, place: Path) -> None:
    """Remove a scratch folder whose process is gone; what it had put aside goes back to its place."""
    with suppress(OSError):
        if not (folder / _LOCK).exists():
            if _is_of_dead(folder, place):
                folder.rmdir()  # which others keep from being empty
            return
        descriptor = os.open(folder / _LOCK, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.read(descriptor, 1) or _is_of_dead(folder, place):
                if (folder / _ASIDE).exists() and not place.exists():
                    (folder / _ASIDE).rename(place)
                _remove_scratch(folder)
        finally:
            os.close(descriptor)


def _remove_scratch(folder: Path) -> None:
    """Remove a scratch folder as far as possible, its lock last: by this the next process knows what is left."""
    with suppress(OSError):
        for entry in folder.iterdir():
            if entry.name != _LOCK:
                shutil.rmtree(entry)
        (folder / _LOCK).unlink(missing_ok=True)
        folder.rmdir()


def _is_of_dead(folder: Path, place: Path) -> bool:
    """Whether a folder has the name that a process gave it that is gone now."""
    match = re.fullmatch(r"([0-9]+)-\w+", folder.name.removeprefix(f".{place.name}.partial-"))
    return match is not None and not _is_alive(int(match[1]))
