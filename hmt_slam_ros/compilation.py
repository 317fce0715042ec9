"""Compilation of kernels, which are cached for later starts, and reports on it.

numba notices only that the file of a kernel has changed. A kernel has in it the functions and constants of other files
that it uses, so it is cached under a digest of its file and of those that its kernels, constants and types come from.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from numba.core.caching import Cache

_reporters: list[Callable[[str], None]] = []
_declared: list[Any] = []

_KEPT = 8
"""Digests that are kept for each module, those of the last use: of several installations, and of versions before."""

_END_OF_IMPORTS = b"\n\n\n"
"""Two empty lines, which the formatter puts before the first function or class."""

_IMPORT = re.compile(r"^(?:from ([\w.]+) import (\([^)]*\)|[^\n#]*)|import ([\w.]+))", re.MULTILINE)
"""An import at the top of a file."""


def njit(**options: object) -> Callable[[Callable[..., Any]], Any]:
    """numba's decorator of the same name, with a cache that notices changes in all files that a kernel comes from.

    Without a folder that can be written, kernels are compiled at each start.

    :param options: those of numba.
    """
    import numba  # noqa: PLC0415  the command line imports this module, and needs no kernels for --help

    def compile_lazily(function: Callable[..., Any]) -> Any:  # noqa: ANN401  a class of numba, which has no types
        folder = _cache_folder(function.__module__, Path(function.__code__.co_filename))
        chosen = options if folder is not None else {**options, "cache": False}
        before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(folder or "")
        try:
            _declared.append(numba.njit(**chosen)(function))
        finally:
            numba.config.CACHE_DIR = before
        return _declared[-1]

    return compile_lazily


def declared_kernels() -> Sequence[Any]:
    """The kernels of all modules in memory, as numba's dispatchers."""
    return tuple(_declared)


@cache
def _cache_folder(module: str, file: Path) -> Path | None:
    """The folder for the kernels of a module, which exists; None where none can be written."""
    try:
        name = f"{module}-{_digest(module, file)}"
    except OSError:  # without its source
        return None
    for parent in _cache_parents(module, file):
        with suppress(OSError):
            folder = parent / name
            is_new = not folder.is_dir()
            folder.mkdir(parents=True, exist_ok=True)
            if os.access(folder, os.W_OK):
                os.utime(folder)
                if is_new:
                    _remove_old(parent, module)
                return folder
    return None


def _cache_parents(module: str, file: Path) -> Iterator[Path]:
    """Where kernels may be cached: in the folder of NUMBA_CACHE_DIR, else of the user, else beside the sources."""
    from numba import config  # noqa: PLC0415  see above

    if config.CACHE_DIR:
        yield Path(config.CACHE_DIR)
        return
    with suppress(RuntimeError):  # no home
        yield Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hmt_slam_ros" / "kernels"
    yield file.parents[max(module.count(".") - 1, 0)] / "__pycache__" / "kernels"


def _remove_old(parent: Path, module: str) -> None:
    """Remove all but the last digests of a module; another process may do the same."""
    folders = [
        entry for entry in parent.iterdir() if entry.name.rpartition("-")[0] == module and not entry.is_symlink()
    ]
    times = {}
    for folder in folders:
        with suppress(OSError):
            times[folder] = folder.stat().st_mtime_ns
    for folder in sorted(times, key=times.__getitem__, reverse=True)[_KEPT:]:
        shutil.rmtree(folder, ignore_errors=True)


def _digest(module: str, file: Path) -> str:
    """A digest of a module's file, of those that its kernels have parts of, and of the versions that compile them."""
    root = str(file.parents[module.count(".")])
    files, waiting = {str(file)}, [str(file)]
    while waiting:
        new = [other for other in _read_source(waiting.pop(), root)[1] if other not in files]
        files.update(new)
        waiting += new
    digest = hashlib.sha256(_versions().encode())
    for path in sorted(files):
        digest.update(os.fsencode(path.removeprefix(root)) + _read_source(path, root)[0])
    return digest.hexdigest()[:16]


@cache
def _versions() -> str:
    import numba  # noqa: PLC0415  see above
    import numpy as np  # noqa: PLC0415

    return " ".join([sys.version, numba.__version__, np.__version__])


@cache
def _read_source(file: str, root: str) -> tuple[bytes, list[str]]:
    """The digest of a file, and the files of its package that it imports at its top and kernels can have parts of."""
    content = _read(file)
    package = file.removeprefix(root).split("/")[1]
    found: list[str] = []
    for origin, names, whole in _IMPORT.findall(content.partition(_END_OF_IMPORTS)[0].decode()):
        parts, words = (origin or whole).split("."), re.findall(r"\w+", names)
        if parts[0] == package:
            # What begins with a capital is a constant or the type of an argument. Functions without kernels are called
            # by Python.
            is_value = any(word[0].isupper() for word in words)
            files = _module_files("/".join((root, *parts)), words)
            found.extend(one for one in files if one != __file__ and (is_value or b"njit" in _read(one)))
    return hashlib.sha256(content).digest(), found


@cache
def _read(file: str) -> bytes:
    return Path(file).read_bytes()


def _module_files(path: str, names: list[str]) -> list[str]:
    """The file of a module, or those of a package and of the modules of it among some names."""
    if os.path.isfile(f"{path}.py"):  # noqa: PTH113  a Path costs ten times as much, at each start
        return [f"{path}.py"]
    files = [f"{path}/__init__.py", *(f"{path}/{name}.py" for name in names)]
    return [file for file in files if os.path.isfile(file)]  # noqa: PTH113


def report_compilation(report: Callable[[str], None]) -> None:
    """Report the first compilation of a kernel that is not cached, and the first failure to cache one.

    numba would raise an exception where the cache cannot be written, such as on a full disk: a node has to continue.
    Without numba in memory there are no kernels, and numba is not imported. Only the first call has an effect, since a
    node calls this whenever it is configured.

    :param report: called with a sentence.
    """
    if "numba" not in sys.modules or _reporters:
        return
    _reporters.append(report)
    from numba.core import event  # noqa: PLC0415  only where numba is loaded
    from numba.core.caching import Cache  # noqa: PLC0415

    class FirstCompilation(event.Listener):
        reported = False

        def on_start(self, _event: object) -> None:
            if not self.reported:
                self.reported = True
                report("compiling kernels for this machine, once: this takes up to a minute")

        def on_end(self, _event: object) -> None:
            pass

    # The event is sent only for kernels that are not cached.
    event.register("numba:compile", FirstCompilation())
    Cache.save_overload = _tolerate_unwritable_cache(Cache.save_overload, report)


def _tolerate_unwritable_cache(save: Callable[..., None], report: Callable[[str], None]) -> Callable[..., None]:
    """The method of numba that caches a kernel, with the first failure reported and all ignored."""
    reported = False

    def save_if_possible(cache: Cache, signature: object, kernel: object) -> None:
        nonlocal reported
        try:
            save(cache, signature, kernel)
        except OSError as fault:
            if not reported:
                reported = True
                sentence = (
                    f"compiled kernels cannot be kept in {cache.cache_path}: {fault.strerror}; each start compiles "
                    "them anew, which takes up to a minute: make room there, or set NUMBA_CACHE_DIR to another folder"
                )
                report(sentence)

    return save_if_possible
