"""Under which names a page may be requested: a page of another site, whose name resolves here, gets nothing."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Iterable
from email.message import Message
from urllib.parse import urlsplit

_LOOPBACK = frozenset({"localhost", "127.0.0.1", "::1"})


class HostCheck:
    """Accepts the loopback names, the address that a browser connected to, this computer's names and given ones."""

    def __init__(self, allowed: Iterable[str]) -> None:
        """:param allowed: further host names, without ports."""
        name = socket.gethostname().lower()
        own_names = {name, f"{name}.local"} if name else set()
        self._names = _LOOPBACK | own_names | {host.strip().lower() for host in allowed if host.strip()}

    def objection(self, headers: Message, local_address: str) -> str:
        """Why a request is refused, in a sentence; empty where it is not.

        :param local_address: IP address of this computer that the browser connected to.
        """
        hosts = headers.get_all("Host") or []
        name = _host_name(hosts[0]) if len(hosts) == 1 else ""
        if not name or name not in self._names | {_plain_address(local_address)}:
            return "the page is not served under this host name: ask for its address, or start view with allowed_hosts"
        origin = headers.get("Origin")
        if origin is not None and _authority(origin) != hosts[0].strip().lower():
            return "the page is not served to other sites: open it by its own address"
        return ""


def _host_name(host: str) -> str:
    """The name in a Host header, without the port; empty where it is none."""
    try:
        return _plain_address(urlsplit(f"//{host}").hostname or "")
    except ValueError:
        return ""


def _authority(origin: str) -> str:
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return ""


def _plain_address(name: str) -> str:
    """An IP address in its shortest form, IPv4 also where IPv6 has it inside; other names as they are."""
    try:
        address = ipaddress.ip_address(name)
    except ValueError:
        return name
    return str(getattr(address, "ipv4_mapped", None) or address)
