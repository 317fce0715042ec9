"""The exception for faults that a user can correct."""


class HmtSlamError(Exception):
    """A fault in the input or in the configuration.

    The message is one sentence with the value at fault and the remedy. A command prints it on stderr and exits with
    status 2.
    """


class EarlierSystemError(HmtSlamError):
    """A system that was started earlier runs on the topics of a node, which gives way to it."""
