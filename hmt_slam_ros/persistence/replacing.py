"""A folder that takes the place of another at one stroke, so that whoever looks finds the one or the other."""

from __future__ import annotations

import ctypes
import errno
import os
from pathlib import Path

_HERE = -100  # AT_FDCWD: paths are relative to the working directory
_EXCHANGE = 2  # RENAME_EXCHANGE


def put_in_place(new: Path, target: Path) -> None:
    """Make a folder stand at ``target``; what stood there before then stands at ``new``.

    :param new: on the same file system, written to the end.
    :raises OSError: where that cannot be.
    """
    _flush(new)
    if not target.exists():
        new.rename(target)
    elif not _exchanged(new, target):
        # A file system that cannot exchange two names: for a moment there is none.
        aside = new.with_name(f"{new.name}.old")
        target.rename(aside)
        new.rename(target)
        aside.rename(new)
    _flush_folder(target.parent)


def _exchanged(one: Path, other: Path) -> bool:
    """Whether two names were exchanged; not every file system can."""
    libc = ctypes.CDLL(None, use_errno=True)
    if not hasattr(libc, "renameat2"):
        return False
    if libc.renameat2(_HERE, os.fsencode(one), _HERE, os.fsencode(other), _EXCHANGE) == 0:
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
