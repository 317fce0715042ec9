"""The command ``hmt_slam``: runs a subcommand and turns its faults into one sentence and an exit status."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path

from hmt_slam_ros.cli.arguments import build_parser
from hmt_slam_ros.cli.terminal import install_signal_handlers
from hmt_slam_ros.compilation import report_compilation
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.process_table import resolve
from hmt_slam_ros.untrusted_input import one_sentence, shorten

FAULT, INTERRUPTED = 2, 130
"""Exit status where the input is at fault, and where the user stopped the command."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a subcommand.

    :param arguments: those of the process where None.
    :returns: exit status: 0 for a complete result, 1 where ``doctor`` found something wrong, 2 where the input is at
        fault, 130 where the user stopped it.
    """
    install_signal_handlers()
    options = build_parser().parse_args(arguments)
    try:
        # A subcommand is imported only when it is run, so that --help does not wait for numba and matplotlib.
        run = resolve(options.function)
        report_compilation(lambda text: print(f"hmt_slam {options.command}: {text}", file=sys.stderr))
        return run(options) or 0
    except BrokenPipeError:
        # The reader of the output, such as `head`, has ended. What the interpreter flushes at its end goes nowhere.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (HmtSlamError, MemoryError, OSError) as fault:
        print(f"hmt_slam {options.command}: {one_sentence(_describe(fault))}", file=sys.stderr)
        return FAULT
    except KeyboardInterrupt:
        print(f"hmt_slam {options.command}: stopped, nothing was written", file=sys.stderr)
        return INTERRUPTED
    return 0


def _describe(fault: Exception) -> str:
    """A fault in the user's words; that of the system says neither what to do nor, at times, where it was."""
    if isinstance(fault, MemoryError):
        return "there is no memory left: give a smaller input, or free some"
    if isinstance(fault, OSError):
        path = shorten(Path(os.fsdecode(fault.filename))) if isinstance(fault.filename, str | bytes) else "a file"
        return f"{path} cannot be used ({fault.strerror or fault}): look at it, at its folder and at the disk"
    return str(fault)


if __name__ == "__main__":
    sys.exit(main())
