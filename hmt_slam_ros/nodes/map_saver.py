"""The map of all nodes, saved when the service ``save`` of slam asks for it.

Slam waits until no keyframe event is under way, writes its own part and asks the others for theirs; until these are
there it sends no keyframe, so that all parts are of one moment. Then the folder takes the place of the one before.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.task import Future
from std_msgs.msg import String
from std_srvs.srv import Trigger

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.nodes import qos
from hmt_slam_ros.nodes.figures import PERIOD
from hmt_slam_ros.nodes.part_saver import PARTS
from hmt_slam_ros.nodes.topics import SAVE, SAVED
from hmt_slam_ros.persistence.folder import MANIFEST
from hmt_slam_ros.persistence.hmt_map import HMT_MAP
from hmt_slam_ros.persistence.replacing import put_in_place
from hmt_slam_ros.processes.documents import SavedPart, SaveRequest, decode, encode

if TYPE_CHECKING:
    from hmt_slam_ros.nodes.slam_node import SlamNode
    from hmt_slam_ros.offline.saved_map import MapWriter

_PATIENCE = 20.0  # s, for the end of a keyframe event and for the parts of the others


class _Saving(NamedTuple):
    """A map that is being saved.

    :ivar scratch: folder that vanishes at the end.
    :ivar writer: of the map in it.
    :ivar parts: the answers of the others so far.
    """

    scratch: Path
    writer: MapWriter
    parts: dict[str, SavedPart]

    @property
    def folder(self) -> Path:
        return self.scratch / "new"


class MapSaver:
    """Answers the service ``save``.

    :ivar holding: whether slam has to wait with what it hears.
    """

    def __init__(self, node: SlamNode, release: Callable[[], None]) -> None:
        """Offer the service.

        :param release: called when slam need not wait any more.
        """
        self.holding = False
        self._node, self._release = node, release
        self._target = Path(node.declare_parameter("save_to", HMT_MAP, _DESCRIPTOR).value).absolute()
        self._asked: Future | None = None
        self._last: Future | None = None
        self._ending = False
        self._since, self._number = 0.0, 0
        self._saving: _Saving | None = None
        self._requests = node.create_publisher(String, SAVE, qos.CHAIN)
        node.create_subscription(String, SAVED, self._hear, qos.CHAIN_FROM_NOW)
        # A group of its own, so that the node goes on while the answer is awaited.
        group = MutuallyExclusiveCallbackGroup()
        node.create_service(Trigger, "~/save", self._answer, callback_group=group)
        node.create_timer(PERIOD, self._lose_patience, clock=node.figures.steady_clock)

    async def _answer(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._asked is not None:
            response.message = "a map is being saved already: ask again"
            return response
        response.success, response.message = await self._ask()
        return response

    def _ask(self) -> Future:
        """The outcome of saving a map from now on: whether it was saved, and a sentence."""
        asked = self._asked = Future()
        self._since = time.monotonic()
        self.look()
        return asked

    def saved_last(self) -> bool:
        """Whether the map of a node that was told to end is saved, or cannot be; the first call asks for it."""
        self._ending = True
        if self._last is None and self._asked is None:
            self._last = self._ask()
        return self._last is not None and self._last.done()

    def look(self) -> None:
        """Begin to save where that is asked for and no keyframe event is under way."""
        if self._asked is None or self._saving is not None or self._node.process.waiting:
            return
        try:
            self._check()
            self._begin()
        except (HmtSlamError, OSError) as fault:
            self._end(f"{self._target} cannot be saved: {fault}")

    def _check(self) -> None:
        if self._node.estimate is None:
            raise HmtSlamError("nothing is mapped yet, drive first")
        if self._target.exists() and not (self._target / MANIFEST).is_file():
            raise HmtSlamError("something else than a map stands there, set save_to of slam to another folder")

    def _begin(self) -> None:
        """Write the part of slam, and ask the others for theirs."""
        from hmt_slam_ros.offline.saved_map import MapWriter  # noqa: PLC0415  only where something is saved

        state = self._node.process.state
        self._target.parent.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(prefix=f".{self._target.name}.partial-", dir=self._target.parent))
        self._saving = _Saving(scratch, MapWriter(scratch / "new"), {})
        self.holding = True
        self._saving.writer.write_slam(state)
        self._node.write_map(self._saving.writer)
        self._number += 1
        request = SaveRequest(self._number, state.events, str(self._saving.folder), self._ending)
        self._requests.publish(String(data=encode(request)))

    def _hear(self, message: String) -> None:
        part = decode(message.data, SavedPart)
        saving = self._saving
        if saving is None or part.number != self._number:
            return
        saving.parts[part.part] = part
        if part.fault:
            self._end(f"the map cannot be saved: {part.part} says that {part.fault}")
        elif set(PARTS) <= saving.parts.keys():
            self._finish(saving)

    def _finish(self, saving: _Saving) -> None:
        try:
            for part in saving.parts.values():
                saving.writer.join(part.files)
            saving.writer.finish(self._node.configuration)
            put_in_place(saving.folder, self._target)
        except OSError as fault:
            self._end(f"{self._target} cannot be written ({fault.strerror}): set save_to of slam to another folder")
        else:
            self._end(None)

    def _lose_patience(self) -> None:
        if self._asked is None or time.monotonic() - self._since < _PATIENCE:
            return
        missing = [name for name in PARTS if self._saving is not None and name not in self._saving.parts]
        late = f"{' and '.join(missing)} did not answer" if missing else "a keyframe event is not answered"
        self._end(f"the map cannot be saved: {late} within {_PATIENCE:g} s, look at /diagnostics")

    def _end(self, fault: str | None) -> None:
        """Answer, and let slam go on."""
        if self._saving is not None:
            shutil.rmtree(self._saving.scratch, ignore_errors=True)
        self._saving, self.holding = None, False
        if fault is not None:
            self._node.figures.warn(fault)
        asked, self._asked = self._asked, None
        if asked is not None:
            asked.set_result((fault is None, fault or f"saved to {self._target}"))
        self._release()


_DESCRIPTOR = ParameterDescriptor(description="Folder into which the service save writes the map.", read_only=True)
