"""The system that a node belongs to, so that two systems in one ROS domain do not take each other's messages.

DDS does not show who sent a message. So every document names the system of its sender, and a node leaves out those of
another one. docs/decisions/0044-system-names.md has the reasons.
"""

from __future__ import annotations

import re
import time

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.untrusted_input import shorten

_NAME = re.compile(r"[\w.:+-]{0,100}", re.ASCII)
_MEMORY = 60.0
"""Time for which another system is reported after its last document, s."""

REMEDY = "give each system a namespace or a ROS_DOMAIN_ID of its own"


class ForeignDocumentError(HmtSlamError):
    """A document is of another system.

    :ivar system: its name, empty where it has none.
    """

    def __init__(self, system: str, own: str) -> None:
        super().__init__(f"it is of the system '{system}', not of '{own}' as this node: {REMEDY}")
        self.system = system


class SystemName:
    """Name of a node's system.

    :ivar name: empty where the system has none, or it is not known yet.
    """

    def __init__(self, name: str = "") -> None:
        """:param name: of the system; empty to adopt that of the first document that has one.

        :raises HmtSlamError: where it is no name.
        """
        if _NAME.fullmatch(name) is None:
            raise HmtSlamError(f"system = {shorten(name)} is no name: use letters, digits and '_-.:+', 100 at most")
        self.name = name
        self._other, self._other_at = "", -_MEMORY

    def admit(self, name: str) -> None:
        """Check that a document is of this system, or adopt its name.

        :raises ForeignDocumentError: where it is of another one.
        :raises HmtSlamError: where it has no name of a system.
        """
        if name == self.name:
            return
        if _NAME.fullmatch(name) is None:
            raise HmtSlamError(f"system = {shorten(name)} is no name: {REMEDY}")
        if not self.name:
            self.name = name
            return
        raise ForeignDocumentError(name, self.name)

    def note_other(self, name: str) -> None:
        """Take note that another system sent a document."""
        self._other, self._other_at = name or "without a name", time.monotonic()

    def forget_other(self) -> None:
        """Take note that the other system has ended."""
        self._other_at = -_MEMORY

    @property
    def other(self) -> str:
        """The other system that sent a document lately, empty without."""
        return self._other if time.monotonic() - self._other_at < _MEMORY else ""
