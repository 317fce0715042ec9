"""The map of all nodes, saved when the service ``save`` of slam asks for it.

When the parts of all processes are there, the folder takes the place of the one before.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.nodes.round import Round
from hmt_slam_ros.nodes.topics import SAVE, SAVED
from hmt_slam_ros.persistence.folder import MANIFEST
from hmt_slam_ros.persistence.hmt_map import HMT_MAP
from hmt_slam_ros.persistence.replacing import put_in_place
from hmt_slam_ros.processes.documents import SavedPart, SaveRequest

if TYPE_CHECKING:
    from hmt_slam_ros.nodes.slam_node import SlamNode
    from hmt_slam_ros.offline.saved_map import MapWriter


_REMEDY = "the map of before stays; make room, or set save_to of slam to another folder"


class _Saving(NamedTuple):
    """A map that is being saved.

    :ivar scratch: folder that vanishes at the end.
    :ivar writer: of the map in it.
    """

    scratch: Path
    writer: MapWriter

    @property
    def folder(self) -> Path:
        return self.scratch / "new"


class MapSaver(Round):
    """Answers the service ``save``."""

    def __init__(self, node: SlamNode, release: Callable[[], None]) -> None:
        """Offer the service.

        :param release: called when slam need not wait any more.
        """
        self._target = node.save_to
        super().__init__(node, release, (SAVE, SAVED), SavedPart, f"{self._target} cannot be saved")
        self._last: Future | None = None
        self._ending = False
        self._saving: _Saving | None = None
        # A group of its own, so that the node goes on while the answer is awaited.
        group = MutuallyExclusiveCallbackGroup()
        node.create_service(Trigger, "~/save", self._answer, callback_group=group)

    async def _answer(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._node.busy:
            response.message = "a map is being saved or loaded already: ask again"
            return response
        response.success, response.message = await self.ask()
        return response

    def saved_last(self) -> bool:
        """Whether the map of a node that was told to end is saved, or cannot be; the first call asks for it."""
        self._ending = True
        if self._last is None and not self._node.busy:
            self._last = self.ask()
        return self._last is not None and self._last.done()

    def _begin(self, number: int, events: int) -> SaveRequest:
        """Write the part of slam, and ask the others for theirs."""
        from hmt_slam_ros.offline.saved_map import MapWriter  # noqa: PLC0415  only where something is saved

        if self._node.estimate is None:
            raise HmtSlamError("nothing is mapped yet, drive first")
        if self._target.exists() and not (self._target / MANIFEST).is_file():
            raise HmtSlamError("something else than a map stands there, set save_to of slam to another folder")
        try:
            self._target.parent.mkdir(parents=True, exist_ok=True)
            scratch = Path(tempfile.mkdtemp(prefix=f".{self._target.name}.partial-", dir=self._target.parent))
            self._saving = _Saving(scratch, MapWriter(scratch / "new"))
            self._saving.writer.write_slam(self._node.process.state)
            self._node.write_map(self._saving.writer)
        except OSError as fault:
            raise HmtSlamError(f"{fault.strerror}; {_REMEDY}") from fault
        return SaveRequest(number, events, str(self._saving.folder), self._ending)

    def _finish(self) -> str:
        assert self._saving is not None
        try:
            for part in self._answers.values():
                assert isinstance(part, SavedPart)
                self._saving.writer.join(part.files)
            self._saving.writer.finish(self._node.configuration)
            put_in_place(self._kept() or self._saving.folder, self._target)
        except OSError as fault:
            raise HmtSlamError(f"{self._target} cannot be saved: {fault.strerror}; {_REMEDY}") from fault
        return f"saved to {self._target}"

    def _kept(self) -> Path | None:
        """A copy of the map that was loaded, where the robot was only localized in it, without what it saw since."""
        assert self._saving is not None
        loaded = self._node.unchanged_map
        return None if loaded is None else Path(shutil.copytree(loaded, self._saving.scratch / "kept"))

    def _clean_up(self) -> None:
        if self._saving is not None:
            shutil.rmtree(self._saving.scratch, ignore_errors=True)
        self._saving = None


def declare_target(node: Node) -> Path:
    """The folder for the map, from the parameter ``save_to``."""
    return Path(node.declare_parameter("save_to", HMT_MAP, _DESCRIPTOR).value).absolute()


_DESCRIPTOR = ParameterDescriptor(description="Folder into which the service save writes the map.", read_only=True)
