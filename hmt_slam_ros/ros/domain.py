"""A DDS domain of one's own, in which no other nodes are heard."""

from __future__ import annotations

import fcntl
import socket
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hmt_slam_ros.errors import HmtSlamError

# Beyond 101 the ports of a domain run into those that Linux gives to outgoing connections. 0 is everybody's.
_DOMAINS = range(1, 102)
# Ports of a domain, after the RTPS standard: 7400 + 250 * domain + 10 + 2 * participant.
_PORT_BASE, _DOMAIN_GAIN, _UNICAST_OFFSET, _PARTICIPANT_GAIN = 7400, 250, 10, 2
_PARTICIPANTS = 4


@contextmanager
def own_domain() -> Iterator[int]:
    """The id of a domain in which nobody on this computer is, and which nobody else gets as long as it is held.

    :raises HmtSlamError: where all are in use.
    """
    for domain in _DOMAINS:
        with _lock(domain) as locked:
            if locked and _is_silent(domain):
                yield domain
                return
    raise HmtSlamError(f"all ROS domains from {_DOMAINS[0]} to {_DOMAINS[-1]} are in use: end some ROS nodes")


@contextmanager
def _lock(domain: int) -> Iterator[bool]:
    """Whether the domain is reserved for this process; the system lifts it when the process ends, however it ends."""
    path = Path(tempfile.gettempdir()) / f"hmt_slam_domain_{domain}.lock"
    try:
        file = path.open("a")
    except OSError:  # another user's
        yield False
        return
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            yield False
        else:
            yield True


def _is_silent(domain: int) -> bool:
    """Whether the ports that the first participants of the domain would listen on are free."""
    first = _PORT_BASE + _DOMAIN_GAIN * domain + _UNICAST_OFFSET
    return all(_is_free(first + _PARTICIPANT_GAIN * number) for number in range(_PARTICIPANTS))


def _is_free(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("", port))
        except OSError:
            return False
    return True
