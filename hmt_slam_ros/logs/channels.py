"""The topics of a bag: their number, and their quality of service, which is YAML within a text."""

from __future__ import annotations

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs.unpacking import DamageError
from hmt_slam_ros.untrusted_input import parse_yaml

MAX_CHANNELS = 2000
"""Topics of a file; a library compares each with each."""

_MAX_QOS = 400_000
"""Characters of all qualities of service; each publisher of a topic has 350."""


class ChannelCheck:
    """Checks the topics of one file, one after the other."""

    def __init__(self) -> None:
        self._count = self._characters = 0

    def add(self, topic: str, qos: str) -> None:
        """Check the next topic.

        :param qos: its offered qualities of service, YAML.
        :raises DamageError: where there are too many topics, or the YAML is none that a library may read.
        """
        self._count += 1
        self._characters += len(qos)
        if self._count > MAX_CHANNELS:
            raise DamageError(f"it has more than {MAX_CHANNELS} topics")
        if self._characters > _MAX_QOS:
            raise DamageError(f"its topics have more than {_MAX_QOS} characters of quality of service")
        try:
            parse_yaml(qos, f"the quality of service of {topic}")
        except HmtSlamError as fault:
            raise DamageError(str(fault)) from fault
