"""Metric SLAM as a node: scans wait for the laser's transform, and the end of the log for the last scan."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.documents import RobotStatus, decode
from hmt_slam_ros.messages.map_changes import AreaPose, Place
from hmt_slam_ros.messages.messages import (
    Accepted,
    Arriving,
    Carried,
    EndOfLog,
    Finished,
    Keyframe,
    LocalEstimate,
    Message,
    Trail,
)
from hmt_slam_ros.messages.replica import FIRST_AREA
from hmt_slam_ros.ros import conversions, topics
from hmt_slam_ros.ros.diagnostics import PERIOD
from hmt_slam_ros.ros.execution import run
from hmt_slam_ros.ros.initial_state import Beginning, declare_initial_pose, place_of
from hmt_slam_ros.ros.map_services import Listeners, MapChanger, MapSaver, declare_target, spin
from hmt_slam_ros.ros.parameters import declare_frame, declare_laser_pose
from hmt_slam_ros.ros.process_node import ProcessNode
from hmt_slam_ros.ros.recovery import CHECKPOINT, Mounted, Paused, Told
from hmt_slam_ros.ros.scan_intake import ScanIntake
from hmt_slam_ros.ros.topics import INITIAL_POSE, PARTICLES, ROBOT_STATUS
from hmt_slam_ros.ros.transforms import LaserMounting
from hmt_slam_ros.saved_map.folder import VERSION, FolderReader
from hmt_slam_ros.sensors import Odometry, Scan

if TYPE_CHECKING:
    from hmt_slam_ros.metric_slam.slam import MetricSlam
    from hmt_slam_ros.results.hmt_map import MapWriter


@dataclass(frozen=True, eq=False)
class SlamMemory:
    """As a value.

    :ivar areas: of the most probable hypothesis, in the map.
    :ivar estimate: the last one that was said.
    :ivar unchanged: whether the map is as it was loaded.
    :ivar dropped: scans that the node did not let the process hear.
    """

    areas: tuple[AreaPose, ...]
    estimate: LocalEstimate | None
    unchanged: bool
    dropped: int


_MEMORY = "node"
# The last scans of a log are awaited this long, since status and scans are separate topics.
_END_PATIENCE = 5.0  # s


class SlamNode(ProcessNode):
    """The node ``slam``."""

    process: MetricSlam
    # What it took in is worked off while it is inactive; only scans are not listened to.
    hears_on = True

    def __init__(self) -> None:
        super().__init__("slam", _make_process, (Arriving, Keyframe, Trail, LocalEstimate, Finished), ("mode",))
        self._listeners = Listeners(self)

    def declare(self) -> None:
        """Declare what slam alone has too.

        :raises HmtSlamError: for what is no pose, or a pose in no map.
        """
        super().declare()
        self.map_frame, self._base_frame = declare_frame(self, "map", "map"), declare_frame(self, "base", "base_link")
        self._laser_pose, self.save_to = declare_laser_pose(self), declare_target(self)
        self._initial_pose = declare_initial_pose(self)
        if self._initial_pose is not None and not self.start_from:
            raise HmtSlamError("initial_pose is set, but no map that it is a pose in: set start_from, or leave it away")

    def set_up(self) -> None:
        """As any process node, and say where the robot is in the map that it begins with.

        :raises HmtSlamError: for a map that cannot be, or one that the others do not have.
        """
        self._listeners.check()
        super().set_up()
        self._mounting = LaserMounting(self, self._base_frame, self._laser_pose, self.work_off, self.recovery.heard)
        self._scans = ScanIntake(self, self._mounting, self.after.get("Scan"))
        self._end: RobotStatus | None = None
        self._scans_at_end = -1
        self._areas: dict[int, AreaPose] = {}
        self.estimate: LocalEstimate | None = None
        self._unchanged = True
        self._take_over_map()
        self._held: deque[Message] = deque()
        self._saver = MapSaver(self, self._release)
        self._changer = MapChanger(self, self._release)
        self._particles = self.create_publisher(PoseArray, PARTICLES, topics.STREAM)
        self.create_subscription(String, ROBOT_STATUS, self._hear_status, topics.LATCHED)
        self.create_service(Trigger, "~/carried", self._hear_carried)
        self.create_service(SetBool, "~/pause", self._pause)
        self.create_timer(PERIOD, self._look_around, clock=self.figures.steady_clock)
        self.create_subscription(PoseWithCovarianceStamped, INITIAL_POSE, self._hear_initial_pose, topics.STREAM)
        self._begin()

    def take_part(self) -> None:
        """As any process node, and listen to scans; those that were missed come first where the robot kept them."""
        super().take_part()
        self._scans.begin()
        self.work_off()

    def stand_still(self) -> None:
        """As any process node, and listen to scans no more."""
        super().stand_still()
        self._scans.end()

    def check_clean_up(self) -> None:
        """See whether nothing is under way.

        :raises HmtSlamError: amid a save, or an exchange of the map.
        """
        if self.busy:
            raise HmtSlamError("a map is being saved or loaded: clean up again after that")
        if self.saves_at_end and self.estimate is not None:
            self.figures.note("the map is given up; save_at_end saves it at the end alone, and slam/save before")

    def give_up(self) -> None:
        """As any process node; from then on the others have a map that slam does not."""
        super().give_up()
        if self.process.events > self.beginning.events or self.answered:
            self._listeners.remember()

    def _take_over_map(self) -> None:
        """What the node shows of the map that it begins with."""
        known = self.beginning.map
        self._areas = {FIRST_AREA: AreaPose(FIRST_AREA, PoseGaussian(np.zeros(3), np.zeros((3, 3))))}
        self._areas |= {entry.area: entry for entry in known.area_poses} if known else {}
        self.estimate = known.robot if known else None
        self._unchanged = not self.process.mapping

    def configuration_changed(self, configuration: Configuration) -> None:
        """Take note of another mode, from the next keyframe on."""
        super().configuration_changed(configuration)
        if self.configured:
            self.process.mode = configuration.mode
            self._unchanged = self._unchanged and not self.process.mapping

    @property
    def unchanged_map(self) -> Path | None:
        """The folder of the map that the node began with, where nothing but localization was done since."""
        return self.beginning.folder if self._unchanged else None

    @property
    def scans(self) -> int:
        """Scans that have a pose."""
        return self.process.scans

    @property
    def busy(self) -> bool:
        """Whether a map is being saved or exchanged."""
        return self._saver.busy or self._changer.busy

    @property
    def holding(self) -> bool:
        """Whether what is heard has to wait for that."""
        return self._saver.holding or self._changer.holding

    def begin_anew(self, folder: str, request: int = 0) -> None:
        """As any process node; what waits was of before, and scans are numbered on."""
        super().begin_anew(folder, request)
        self._scans.forget()
        self._take_over_map()
        self._held.appendleft(Carried())

    def _pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        """Scans are passed over, or no more."""
        self.recovery.heard(Paused(request.data))
        self._scans.pause(on=request.data)
        self._scans.take_skipped()
        self.work_off()
        response.success, response.message = True, "paused, scans are passed over" if request.data else "mapping"
        self.get_logger().info(response.message)
        return response

    def _begin(self) -> None:
        """Say where the robot is in the map that the node starts from."""
        if self.recovering:
            return
        if not self.process.mapping and self.beginning.map is None:
            self.figures.warn("mode = localization, but there is no map: call load_map, or set start_from or mode")
        if self._initial_pose is not None:
            self.deliver(Carried(self._place(self._initial_pose)))
        elif self.beginning.carried:
            self.deliver(Carried())

    def _place(self, belief: PoseGaussian) -> Place:
        return place_of(self.process, self._areas, belief, self.configuration.tsbi.place_radius)

    def _hear_initial_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Somebody says where the robot is; scans whose laser is not known yet were taken before."""
        try:
            if message.header.frame_id != self.map_frame:
                raise HmtSlamError(
                    f"the pose is in the frame '{message.header.frame_id}', not in '{self.map_frame}': set the fixed "
                    "frame of RViz, or map_frame"
                )
            place = self._place(conversions.belief_from(message.pose))
        except HmtSlamError as fault:
            self.figures.warn(f"{INITIAL_POSE} is left out: {fault}")
            return
        self._scans.forget()
        self.deliver(Carried(place))

    def work_off(self) -> None:
        """Deliver the scans whose laser's place is known, and the end behind the last."""
        self._scans.work_off()
        self._end_if_all_came()

    def _hear_status(self, message: String) -> None:
        try:
            status = decode(message.data, RobotStatus)
        except HmtSlamError as error:
            self.figures.fail(f"{ROBOT_STATUS}: {error}")
            return
        if status.state == "ended" and self.figures.received["Scan"] != self._scans_at_end:
            self._end = status
            self._end_if_all_came()

    def _hear_carried(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """The robot may be anywhere; scans whose laser is not known yet were taken before."""
        self._scans.forget()
        self.deliver(Carried())
        response.success, response.message = True, "the next scan may be from anywhere"
        return response

    def deliver(self, message: Message) -> None:
        """As any process node; the odometry may have been the last thing that was missing.

        While the other nodes save their parts of a map, what comes is held.
        """
        if self.holding:
            self._held.append(message)
            return
        if isinstance(message, Carried):
            self._scans.forget_time()
            self.inbox.forget_odometry()
        elif isinstance(message, Scan | Odometry) and self._scans.watch.is_back(message) and not self.recovering:
            super().deliver(Carried())
        super().deliver(message)
        if self._end is not None:
            self._end_if_all_came()
        self._saver.look()
        self._changer.look()

    def _release(self) -> None:
        """Go on with what was held."""
        while self._held and not self.holding:
            self.deliver(self._held.popleft())

    def hear_again(self, value: Message | Told) -> None:
        """As any process node; scans have come by another way."""
        if isinstance(value, Paused):
            self._scans.pause(on=value.on)
        elif isinstance(value, Mounted):
            self._mounting.remember(value)
        elif isinstance(value, Scan | Carried | EndOfLog):
            if isinstance(value, Scan):
                self._scans.count()
            self.deliver(value)
        else:
            super().hear_again(value)

    @property
    def after(self) -> Mapping[str, int]:
        """Slam that was killed wants all scans and all odometry since, where somebody has them."""
        return self.recovery.stamps if self.recovering else {}

    @property
    def at_rest(self) -> bool:
        """Whether no scan waits for its laser's place, and nothing for the other nodes."""
        return not (self._scans.waiting or self._held or self.holding or self.busy)

    def memory(self) -> dict[str, object]:
        """What the node knows beside its process."""
        return {_MEMORY: SlamMemory(tuple(self._areas.values()), self.estimate, self._unchanged, self._scans.dropped)}

    def remember(self, state: Path) -> None:
        """Take it over."""
        known = FolderReader(state, CHECKPOINT, VERSION).read(_MEMORY, SlamMemory)
        self._areas = {entry.area: entry for entry in known.areas}
        self.estimate, self._unchanged, self._scans.dropped = known.estimate, known.unchanged, known.dropped

    def saved_last(self) -> bool:
        """Whether the last map is saved, or cannot be."""
        return not self.configured or self._saver.saved_last()

    def write_map(self, writer: MapWriter) -> None:
        """Write the map as it is known now."""
        from hmt_slam_ros.results.recorder import placed_areas  # noqa: PLC0415  only where something is saved

        assert self.estimate is not None
        replica = self.process.replica
        poses = placed_areas(replica.maps[replica.best], tuple(self._areas.values()))
        writer.write_map(replica, poses, self.estimate)

    def _end_if_all_came(self, *, give_up: bool = False) -> None:
        end = self._end
        if end is None or self._scans.waiting or self._scans.paused or not self.active:
            return
        complete = self.figures.received["Scan"] >= end.scans and self.figures.received["Odometry"] >= end.odometry
        if complete or give_up:
            self._end, self._scans_at_end = None, self.figures.received["Scan"]
            self.deliver(EndOfLog())

    def _look_around(self) -> None:
        """Once a second: tell what is missing, and stop waiting for scans that were lost."""
        self.figures.state["waiting scans"] = self.process.waiting_scans + self._scans.waiting
        self._scans.complain()
        if not self.active:
            return
        self._scans.watch.look(self.figures.received["Odometry"])
        if self._end is not None and time.monotonic() - self._scans.last > _END_PATIENCE:
            came = self.figures.received["Scan"]
            self.figures.warn(f"the log ended, but only {came} of its {self._end.scans} scans came")
            self._end_if_all_came(give_up=True)

    def show(self, heard: Message, said: list[Message]) -> None:
        """Publish the particles of the most probable hypothesis in the map, at keyframes."""
        if isinstance(heard, Accepted) and heard.global_poses:
            self._areas = {area.area: area for area in heard.global_poses}
        for message in said:
            if isinstance(message, LocalEstimate):
                self.estimate = message
            if isinstance(message, Keyframe):
                self._tell_effective_samples(message)
                self._publish_particles(message.scan.stamp)

    def _tell_effective_samples(self, keyframe: Keyframe) -> None:
        best = self.process.replica.best
        for leaf in keyframe.leaves:
            if leaf.hypothesis == best:
                particles = len(self.process.particles[1])
                self.figures.state["effective samples"] = f"{leaf.effective_samples:.1f} of {particles}"

    def _publish_particles(self, stamp: int) -> None:
        area, poses = self.process.particles
        if area in self._areas and self._particles.get_subscription_count():
            placed = se2.compose(self._areas[area].pose.mean, poses)
            header = conversions.header(stamp, self.map_frame)
            self._particles.publish(PoseArray(header=header, poses=[conversions.pose_message(pose) for pose in placed]))


def _make_process(configuration: Configuration, beginning: Beginning) -> MetricSlam:
    # It takes time, in which a signal has to be heard.
    from hmt_slam_ros import composition  # noqa: PLC0415
    from hmt_slam_ros.metric_slam.slam import SlamState  # noqa: PLC0415

    state = beginning.part("slam", SlamState) or SlamState()
    more = max(0, beginning.scans - state.scans)
    numbered_on = replace(state, scans=state.scans + more, first_of_trail=state.first_of_trail + more)
    return composition.metric_slam(configuration, numbered_on)


def main() -> None:
    """Run the node."""
    sys.exit(run(SlamNode, spin))


if __name__ == "__main__":
    main()
