"""What a node begins with: nothing, or its part of a saved map."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from rcl_interfaces.msg import ParameterDescriptor

from hmt_slam_ros.configuration import load_configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.nodes.parameters import ConfiguredNode
from hmt_slam_ros.nodes.recovery import CHECKPOINT
from hmt_slam_ros.offline.going_on import differences, map_folder
from hmt_slam_ros.persistence.folder import FolderReader
from hmt_slam_ros.persistence.hmt_map import CONFIGURATION, FORMAT, VERSION

if TYPE_CHECKING:
    from hmt_slam_ros.nodes.recovery import Base
    from hmt_slam_ros.offline.saved_map import MapDocument

State = TypeVar("State")

_FROM = ParameterDescriptor(description="Output folder or hmt_map to go on from.", read_only=True)
_CARRIED = ParameterDescriptor(
    description="Whether the robot may be anywhere in the map of start_from; otherwise it is where it was.",
    read_only=True,
)


class Beginning:
    """A saved map, or nothing.

    :ivar events: keyframe events in it, 0 without.
    :ivar carried: whether nothing tells how the robot came from where it was then.
    :ivar folder: of the map, None without.
    :ivar scans: scans that had a pose before; those to come are numbered on, so that they are told from these.
    """

    def __init__(self, node: ConfiguredNode, path: str, *, carried: bool, scans: int = 0) -> None:
        """Check the map.

        :param path: its folder or the output folder around it, empty for nothing.
        :raises HmtSlamError: where it is damaged, or the node's parameters do not go with it.
        """
        self.events, self.carried, self.scans = 0, carried and bool(path), scans
        self._folder: FolderReader | None = None
        self.folder: Path | None = None
        if path:
            self.folder = map_folder(Path(path)).absolute()
            self._open(node, self.folder, FORMAT)
            # The other processes need not be loaded for it.
            self.events = self._chain_events()

    @classmethod
    def at_checkpoint(cls, node: ConfiguredNode, state: Path, base: Base) -> Beginning:
        """Where a node that was killed goes on.

        :param state: the folder of its checkpoint.
        :param base: what it was then.
        :raises HmtSlamError: as for a map.
        """
        made = cls(node, "", carried=False)
        made._open(node, state, CHECKPOINT)
        made.events, made.folder = base.events, Path(base.folder) if base.folder else None
        made.map = None  # what was shown of it is part of the checkpoint
        return made

    def _open(self, node: ConfiguredNode, folder: Path, kind: str) -> None:
        self._folder = FolderReader(folder, kind, VERSION)
        saved = load_configuration(folder / CONFIGURATION)
        told = differences(saved, replace(node.configuration, robot=saved.robot))
        if told:
            node.get_logger().warning(told)

    def _chain_events(self) -> int:
        from hmt_slam_ros.offline.saved_map import ChainState  # noqa: PLC0415

        state = self.part("chain", ChainState)
        return 0 if state is None else state.events

    def part(self, name: str, kind: type[State]) -> State | None:
        """A part of the map, None where the node begins with nothing.

        :raises HmtSlamError: where the map lacks it.
        """
        if self._folder is None:
            return None
        if f"{name}.json" not in self._folder.names:
            raise HmtSlamError(
                f"the map to start from lacks the part {name}: give one that hmt_slam map wrote or nodes saved"
            )
        return self._folder.read(name, kind)

    @cached_property
    def map(self) -> MapDocument | None:
        """The map itself."""
        from hmt_slam_ros.offline.saved_map import MapDocument  # noqa: PLC0415  for those who ask for it

        return self.part("map", MapDocument)


def declare_map(node: ConfiguredNode) -> str:
    """Path of the map, empty for none."""
    return str(node.declare_parameter("start_from", "", _FROM).value)


def declare_beginning(node: ConfiguredNode) -> tuple[str, bool]:
    """Path of the map, empty for none, and whether the robot may be anywhere in it."""
    return declare_map(node), bool(node.declare_parameter("start_carried", True, _CARRIED).value)
