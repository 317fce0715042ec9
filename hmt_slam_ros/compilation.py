"""Says that kernels are being compiled: once after an installation or a change, and for half a minute."""

from __future__ import annotations

import sys
from collections.abc import Callable


def tell_of_compilation(say: Callable[[str], None]) -> None:
    """See to it that ``say`` is called when the first kernel has to be compiled, as its cache has nothing of it.

    A program that has not loaded numba by then has no kernels, and will not load it for this.
    """
    if "numba" not in sys.modules:
        return
    from numba.core import event  # noqa: PLC0415  see above

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
