"""Hosts on one computer, as network namespaces, and a link between them that loses, repeats and reorders frames."""

from __future__ import annotations

import fcntl
import heapq
import os
import select
import shutil
import struct
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.errors import HmtSlamError

_SET_INTERFACE = 0x400454CA
_TAP_WITHOUT_HEADER = 0x0002 | 0x1000
_MAX_FRAME = 2048
_IP = "/usr/sbin/ip"
_POLL = 0.05
"""Longest time without a look at frames that wait, s."""


@dataclass(frozen=True)
class LinkFaults:
    """What happens to a frame.

    :ivar lost: probability that it does not arrive.
    :ivar repeated: probability that it arrives twice.
    :ivar late: probability that it is delayed, so that others overtake it.
    :ivar delay: largest delay, s.
    """

    lost: float = 0.0
    repeated: float = 0.0
    late: float = 0.0
    delay: float = 0.2


class FrameCounts(NamedTuple):
    """Frames of the link.

    :ivar sent: by all hosts, once for each of the others.
    :ivar lost: of these.
    """

    sent: int
    lost: int


class LossyLink:
    """An Ethernet switch, each port of which is a host; it runs in a thread.

    :ivar faults: of the frames from now on.
    :ivar cut_off: numbers of the hosts that nothing reaches, and from which nothing arrives.
    :ivar counts: frames so far.
    """

    def __init__(self, ports: Sequence[int], seed: int) -> None:
        """:param ports: file descriptors of the hosts' TAP interfaces."""
        self.faults, self.cut_off, self.counts = LinkFaults(), frozenset[int](), FrameCounts(0, 0)
        self._ports, self._random = ports, np.random.default_rng(seed)
        self._waiting: list[tuple[float, int, int, bytes]] = []
        self._is_stopped = threading.Event()
        self._thread = threading.Thread(target=self._forward, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread."""
        self._is_stopped.set()
        self._thread.join()

    def _forward(self) -> None:
        while not self._is_stopped.is_set():
            timeout = _POLL
            if self._waiting:
                timeout = min(timeout, max(0.0, self._waiting[0][0] - time.monotonic()))
            for port in select.select(self._ports, [], [], timeout)[0]:
                self._take(self._ports.index(port), os.read(port, _MAX_FRAME))
            while self._waiting and self._waiting[0][0] <= time.monotonic():
                _, _, host, frame = heapq.heappop(self._waiting)
                os.write(self._ports[host], frame)

    def _take(self, sender: int, frame: bytes) -> None:
        """Pass a frame on to all other hosts: they drop what is not for them."""
        for host in range(len(self._ports)):
            if host == sender:
                continue
            copies = 0 if {host, sender} & self.cut_off else self._copies()
            self.counts = FrameCounts(self.counts.sent + 1, self.counts.lost + (not copies))
            for _ in range(copies):
                due = time.monotonic()
                if self._random.random() < self.faults.late:
                    due += self._random.uniform(0.0, self.faults.delay)
                heapq.heappush(self._waiting, (due, self.counts.sent, host, frame))

    def _copies(self) -> int:
        if self._random.random() < self.faults.lost:
            return 0
        return 2 if self._random.random() < self.faults.repeated else 1


@contextmanager
def linked_hosts(count: int, seed: int) -> Iterator[tuple[LossyLink, list[list[str]]]]:
    """Make hosts with one link; also yields the words before a command that run it on a host.

    :raises HmtSlamError: where this user or computer cannot make them.
    """
    if os.geteuid() != 0 or shutil.which(_IP) is None:
        raise HmtSlamError(f"hosts on this computer are network namespaces: run as root, where {_IP} is")
    names = [f"hmt-{os.getpid()}-{n}" for n in range(count)]
    with ExitStack() as stack:
        ports = []
        for number, name in enumerate(names):
            _ip("netns", "add", name)
            stack.callback(_ip, "netns", "delete", name)
            ports.append(_tap(f"hmt{os.getpid()}n{number}"))
            stack.callback(os.close, ports[-1])
            _connect(name, f"hmt{os.getpid()}n{number}", number)
        link = LossyLink(ports, seed)
        stack.callback(link.stop)
        # A host has shared memory of its own, by which DDS would pass the link by.
        shell = 'mount -t tmpfs tmpfs /dev/shm && exec "$@"'
        yield link, [[_IP, "netns", "exec", name, "sh", "-c", shell, "sh"] for name in names]


def _tap(name: str) -> int:
    """File descriptor of a new TAP interface."""
    try:
        port = os.open("/dev/net/tun", os.O_RDWR)
        fcntl.ioctl(port, _SET_INTERFACE, struct.pack("16sH22x", name.encode(), _TAP_WITHOUT_HEADER))
    except OSError as fault:
        raise HmtSlamError(f"/dev/net/tun gives no interface ({fault.strerror}): allow it, as for a VPN") from fault
    return port


def _connect(host: str, interface: str, number: int) -> None:
    _ip("link", "set", interface, "netns", host)
    for words in (
        ("addr", "add", f"10.77.0.{number + 1}/24", "dev", interface),
        ("link", "set", "lo", "up"),
        ("link", "set", interface, "up"),
        ("route", "add", "224.0.0.0/4", "dev", interface),
    ):
        _ip("-n", host, *words)


def _ip(*words: str) -> None:
    ended = subprocess.run([_IP, *words], capture_output=True, text=True, check=False)
    if ended.returncode:
        raise HmtSlamError(f"ip {' '.join(words)} failed: {ended.stderr.strip()}; see whether this user may do that")
