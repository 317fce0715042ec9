"""Reports on the compilation of kernels, which numba caches for later starts."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from numba.core.caching import Cache

_reporters: list[Callable[[str], None]] = []


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
