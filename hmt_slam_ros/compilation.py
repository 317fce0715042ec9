"""Kernels are compiled once after an installation or a change, which takes half a minute, and kept for later starts."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from numba.core.caching import Cache

_reporters: list[Callable[[str], None]] = []


def report_compilation(say: Callable[[str], None]) -> None:
    """See to it that ``say`` is called when the first kernel has to be compiled, as its cache has nothing of it.

    And when it cannot be kept, for which numba would end the program: where a disk is full, a node has to go on.

    A program that has not loaded numba by then has no kernels, and will not load it for this. The first to ask is the
    only one to be told: a node asks as often as it is configured.
    """
    if "numba" not in sys.modules or _reporters:
        return
    _reporters.append(say)
    from numba.core import event  # noqa: PLC0415  see above
    from numba.core.caching import Cache  # noqa: PLC0415

    class FirstCompilation(event.Listener):
        told = False

        def on_start(self, _event: object) -> None:
            if not self.told:
                self.told = True
                say("compiling kernels for this machine, once: this takes up to a minute")

        def on_end(self, _event: object) -> None:
            pass

    # Heard only where no cache helps.
    event.register("numba:compile", FirstCompilation())
    Cache.save_overload = _tolerate_unwritable_cache(Cache.save_overload, say)


def _tolerate_unwritable_cache(keep: Callable[..., None], say: Callable[[str], None]) -> Callable[..., None]:
    """How numba keeps a kernel, but that it goes on without where there is no room; said once."""
    told = False

    def keep_if_possible(cache: Cache, signature: object, kernel: object) -> None:
        nonlocal told
        try:
            keep(cache, signature, kernel)
        except OSError as fault:
            if not told:
                told = True
                sentence = (
                    f"compiled kernels cannot be kept in {cache.cache_path}: {fault.strerror}; each start compiles "
                    "them anew, which takes up to a minute: make room there, or set NUMBA_CACHE_DIR to another folder"
                )
                say(sentence)

    return keep_if_possible
