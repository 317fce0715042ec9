"""Two hosts on this machine, network namespaces, and a link between them that delays packets and loses some.

As a program it is the link: ``python lossy_link.py NAME_OF_A NAME_OF_B DELAY JITTER LOSS``, in seconds and a share.
Linux's own netem does the same, where the kernel has it.
"""

import contextlib
import ctypes
import fcntl
import heapq
import os
import random
import select
import shutil
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

_TUNSETIFF, _IFF_TAP_NO_PI = 0x400454CA, 0x0002 | 0x1000
_CLONE_NEWNET = 0x40000000
_MTU = 65535
DEVICE = "hmt0"


def reason_against():
    """Why there can be no such hosts here, as a sentence; empty where there can."""
    if os.geteuid() != 0:
        return "network namespaces need root"
    if not Path("/dev/net/tun").exists():
        return "the kernel has no /dev/net/tun"
    if shutil.which("ip") is None:
        return "ip is not installed: apt install iproute2"
    try:
        with LossyLink(0.0, 0.0, 0.0) as link:
            for number in range(2):
                subprocess.run([*link.host_command(number), "true"], check=True, capture_output=True)
    except subprocess.CalledProcessError as fault:
        return f"two network namespaces are not permitted here: {fault.stderr.decode().strip()}"
    return ""


class LossyLink:
    """Two hosts with the addresses 10.77.0.1 and .2; as a context, they are gone at its end.

    :ivar hosts: their names.
    """

    def __init__(self, delay, jitter, loss):
        self.hosts = tuple(f"hmt_{os.getpid()}_{side}" for side in "ab")
        self._how = (delay, jitter, loss)
        self._end = contextlib.ExitStack()

    def __enter__(self):
        with contextlib.ExitStack() as undo:
            self._make(undo)
            self._end = undo.pop_all()
        return self

    def _make(self, undo):
        for host in self.hosts:
            _ip("netns", "add", host)
            undo.callback(_ip, "netns", "del", host)
            _ip("-n", host, "link", "set", "lo", "up")
        command = [sys.executable, __file__, *self.hosts, *map(str, self._how)]
        link = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        undo.callback(_end, link)
        link.stdout.readline()
        for number, host in enumerate(self.hosts, 1):
            _ip("-n", host, "addr", "add", f"10.77.0.{number}/24", "dev", DEVICE)
            _ip("-n", host, "link", "set", DEVICE, "up", "multicast", "on")
            _ip("-n", host, "route", "add", "224.0.0.0/4", "dev", DEVICE)

    def __exit__(self, *_fault):
        self._end.close()

    def host_command(self, number):
        """The beginning of a command that runs on one of the hosts, of which the second shares this one's memory."""
        apart = ["sh", "-c", 'mount -t tmpfs tmpfs /dev/shm && exec "$@"', "sh"]
        return ["ip", "netns", "exec", self.hosts[number], *([] if number else apart)]


def _end(link):
    """End the program that is the link, and print how many packets it forwarded."""
    link.terminate()
    print(link.communicate()[0])


def _ip(*words):
    subprocess.run(["ip", *words], check=True, capture_output=True)


@contextlib.contextmanager
def inside(host):
    """Sockets and threads that are made meanwhile are on a host."""
    libc = ctypes.CDLL(None, use_errno=True)
    with Path("/proc/self/ns/net").open() as own, Path("/var/run/netns", host).open() as theirs:
        if libc.setns(theirs.fileno(), _CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), host)
        try:
            yield
        finally:
            libc.setns(own.fileno(), _CLONE_NEWNET)


def _device(host):
    """The end of the link on a host."""
    with inside(host):
        device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
        fcntl.ioctl(device, _TUNSETIFF, struct.pack("16sH22x", DEVICE.encode(), _IFF_TAP_NO_PI))
    return device


def carry(hosts, delay, jitter, loss):
    """Forward packets between the hosts for ever."""
    ends = [_device(host) for host in hosts]
    lost, number = 0, 0

    def stop(*_signal):
        print(f"the link carried {number} packets and lost {lost}")
        sys.exit()

    signal.signal(signal.SIGTERM, stop)
    print("ready", flush=True)
    draw = random.Random(1)
    under_way = []
    while True:
        wait = max(0.0, under_way[0][0] - time.monotonic()) if under_way else None
        for end in select.select(ends, [], [], wait)[0]:
            packet = os.read(end, _MTU)
            if draw.random() < loss:
                lost += 1
            else:
                number += 1
                other = ends[1 - ends.index(end)]
                heapq.heappush(under_way, (time.monotonic() + delay + draw.random() * jitter, number, other, packet))
        while under_way and under_way[0][0] <= time.monotonic():
            _, _, other, packet = heapq.heappop(under_way)
            # At first the device is not up.
            with contextlib.suppress(OSError):
                os.write(other, packet)


if __name__ == "__main__":
    carry(sys.argv[1:3], *map(float, sys.argv[3:]))
