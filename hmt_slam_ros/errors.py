"""The one exception that a user of this package ever has to read."""


class HmtSlamError(Exception):
    """A fault in the input or in the configuration.

    The message is one sentence that names the value at fault and the remedy; a command prints it on stderr and
    exits with status 2.
    """
