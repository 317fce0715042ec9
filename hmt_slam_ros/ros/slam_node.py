"""Node of metric SLAM: scans wait for the laser's transform, and the end of the log for the last scan."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped
from rclpy.subscription import Subscription
from std_srvs.srv import SetBool, Trigger

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.documents import RobotStatus
from hmt_slam_ros.messages.gate import check_belief
from hmt_slam_ros.messages.map_changes import AreaPose, InitialPose
from hmt_slam_ros.messages.messages import (
    ClosureDecision,
    EndOfLog,
    Keyframe,
    LocalEstimate,
    Message,
    PoseReset,
    TrackingReset,
)
from hmt_slam_ros.messages.replica import FIRST_AREA
from hmt_slam_ros.metric_slam.look_ahead import EarlyEstimateRecord
from hmt_slam_ros.process_table import process_row
from hmt_slam_ros.ros import conversions, topics
from hmt_slam_ros.ros.diagnostics import PERIOD
from hmt_slam_ros.ros.initial_state import InitialState, declare_initial_pose, locate_in_map
from hmt_slam_ros.ros.laser_mountings import LaserMountings
from hmt_slam_ros.ros.map_services import MapLoader, MapSaver, MapServicesNode, StaleSubscribers, declare_folders
from hmt_slam_ros.ros.message_io import subscribe_document
from hmt_slam_ros.ros.odometry_frames import BASE_FRAME, OdometryFrames, declare_odometry_frame
from hmt_slam_ros.ros.parameters import declare_frame, declare_laser_poses
from hmt_slam_ros.ros.recovery import CHECKPOINT, ControlEvent, FrameMounting, PauseChange
from hmt_slam_ros.ros.scan_intake import ScanIntake
from hmt_slam_ros.ros.topics import INITIAL_POSE, PARTICLES
from hmt_slam_ros.saved_map.folder import VERSION, FolderReader
from hmt_slam_ros.sensors import MarkObservation, Odometry, Scan

if TYPE_CHECKING:
    from hmt_slam_ros.metric_slam.speculation import SpeculativeSlam
    from hmt_slam_ros.results.hmt_map import MapWriter


@dataclass(frozen=True, eq=False)
class SlamNodeState:
    """State of the node beside its process.

    :ivar area_poses: ``map_T_area`` of the areas of the most probable hypothesis.
    :ivar estimate: the last one that was sent.
    :ivar map_unchanged: whether the map is as it was loaded.
    :ivar dropped_scans: number of scans that the process did not get.
    """

    area_poses: tuple[AreaPose, ...]
    estimate: LocalEstimate | None
    map_unchanged: bool
    dropped_scans: int


_NODE_STATE = "node"
_BATCH_SIZE, _BATCH_PAUSE = 2, 0.002
"""Scans that are processed at a stretch, and the time until the next, s, in which new scans get early estimates."""
_END_TIMEOUT = 5.0
"""Time without scans after which the last ones of a log are no longer awaited, s."""


class SlamNode(MapServicesNode):
    """The node ``slam``."""

    # While inactive it processes the scans that it has, but gets no new ones.
    is_always_listening = True
    changeable_parameters = ("mode",)

    def __init__(self, name: str) -> None:
        """Declare the parameters."""
        super().__init__(name)
        self._stale_subscribers = StaleSubscribers(self)

    def declare_own_parameters(self) -> None:
        """As any process node; also declare frames, laser pose, folders of maps and ``initial_pose``.

        :raises HmtSlamError: for an invalid pose, or an initial pose without a map.
        """
        super().declare_own_parameters()
        self.map_frame, self._base_frame = declare_frame(self, "map", "map"), declare_odometry_frame(self, BASE_FRAME)
        self._laser_poses = declare_laser_poses(self, self.configuration.sensors.topics)
        declare_folders(self)
        self._initial_pose = declare_initial_pose(self)
        if self._initial_pose is not None and not self.start_from:
            raise HmtSlamError("initial_pose is set, but no map that it is a pose in: set start_from, or leave it away")

    def make_process(self, initial_state: InitialState) -> SpeculativeSlam:
        """As any process node; scans are numbered on from those before."""
        row = process_row("slam")
        state = initial_state.read_part(row.name, row.state_class) or row.state_class()
        offset = max(0, initial_state.previous_scans - state.processed_scans)
        state = replace(
            state,
            processed_scans=state.processed_scans + offset,
            first_unpublished_scan=state.first_unpublished_scan + offset,
        )
        process: SpeculativeSlam = row.make(self.configuration, state)
        process.batch_size = _BATCH_SIZE
        return process

    def configure_node(self) -> None:
        """As any process node; also make the services of slam, and set the initial pose.

        :raises HmtSlamError: for a map that is damaged or does not match, or that the other processes lack.
        """
        self._stale_subscribers.check_gone()
        self.odometry_frames = OdometryFrames(self.diagnostics, base_frame=self._base_frame)
        super().configure_node()
        self._mountings = LaserMountings(
            self,
            self.diagnostics,
            self.odometry_frames,
            self._laser_poses,
            self.deliver_ready_scans,
            self.recovery.record_input,
        )
        self._scan_intake = ScanIntake(self, self._mountings, self.deliver_ready_scans, self.resume_stamps.get("Scan"))
        self._end_status: RobotStatus | None = None
        self._scans_at_end = -1
        self._area_poses: dict[int, AreaPose] = {}
        self.estimate: LocalEstimate | None = None
        self._is_map_unchanged = True
        self._early_estimates = EarlyEstimateRecord()
        self._adopt_map()
        self._held: deque[Message] = deque()
        self._last_message: Message = PoseReset()
        self._next_batch = self.create_timer(_BATCH_PAUSE, self._process_batch, clock=self.diagnostics.steady_clock)
        self._saver = MapSaver(self, self._deliver_held)
        self._loader = MapLoader(self, self._deliver_held)
        self._particles = self.create_publisher(PoseArray, PARTICLES, topics.STREAM)
        subscribe_document(self, RobotStatus, self._on_robot_status, topics.LATCHED, may_be_unnamed=True)
        self.create_service(Trigger, "~/relocalize", self._relocalize)
        self.create_service(SetBool, "~/pause", self._pause)
        self.create_timer(PERIOD, self._check_inputs, clock=self.diagnostics.steady_clock)
        self.create_subscription(PoseWithCovarianceStamped, INITIAL_POSE, self._on_initial_pose, topics.STREAM)
        self._marks: Subscription | None = None
        self._deliver_initial_pose()

    def activate_node(self) -> None:
        """As any process node; also subscribe to marks and scans; missed scans come first where the robot kept them."""
        super().activate_node()
        if topic := self.configuration.marks.topic:
            self._marks = self.create_subscription(PoseWithCovarianceStamped, topic, self._on_mark, topics.SENSOR)
        self._scan_intake.start()
        self.deliver_ready_scans()

    def deactivate_node(self) -> None:
        """As any process node; also unsubscribe from scans and marks."""
        super().deactivate_node()
        self._scan_intake.stop()
        if self._marks is not None:
            self.destroy_subscription(self._marks)
            self._marks = None

    def check_clean_up(self) -> None:
        """Check that no save or load is under way.

        :raises HmtSlamError: where one is.
        """
        if self.is_busy:
            raise HmtSlamError("a map is being saved or loaded: clean up again after that")
        if self.save_on_shutdown and self.estimate is not None:
            self.diagnostics.note(
                "the map is given up; save_on_shutdown saves it at the end alone, and slam/save before"
            )

    def clean_up_node(self) -> None:
        """As any process node; the other processes then have a map that slam lacks."""
        super().clean_up_node()
        if self.process.keyframe_events > self.initial_state.events or self.reset_number:
            self._stale_subscribers.mark_current()

    def _adopt_map(self) -> None:
        """Take poses and estimate from the map of the initial state."""
        document = self.initial_state.map
        self._area_poses = {FIRST_AREA: AreaPose(FIRST_AREA, PoseGaussian(np.zeros(3), np.zeros((3, 3))))}
        self._area_poses |= {entry.area: entry for entry in document.area_poses} if document else {}
        self.estimate = document.last_estimate if document else None
        self._is_map_unchanged = not self.process.is_mapping

    def on_configuration_changed(self, configuration: Configuration) -> None:
        """As any process node; another mode holds from the next keyframe on."""
        if self.is_configured:
            self._finish_queue()
        super().on_configuration_changed(configuration)
        if self.is_configured:
            self.process.mode = configuration.mode
            self._is_map_unchanged = self._is_map_unchanged and not self.process.is_mapping

    @property
    def unchanged_map_folder(self) -> Path | None:
        """Folder of the loaded map where the run did not change it, else None."""
        return self.initial_state.folder if self._is_map_unchanged else None

    @property
    def scans(self) -> int:
        """Number of scans with a pose."""
        return self.process.processed_scans

    @property
    def is_busy(self) -> bool:
        """Whether a map is being saved or exchanged."""
        return self._saver.is_busy or self._loader.is_busy

    @property
    def is_blocking(self) -> bool:
        """Whether messages have to wait for that."""
        return self._saver.is_blocking or self._loader.is_blocking

    def reset(self, folder: str, reset_number: int = 0) -> None:
        """As any process node; also drop waiting scans, and start global localization."""
        super().reset(folder, reset_number)
        self._scan_intake.discard_waiting()
        self._adopt_map()
        self._held.appendleft(PoseReset())

    def _pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self.recovery.record_input(PauseChange(request.data))
        self._scan_intake.pause(on=request.data)
        self._scan_intake.process_skipped()
        self.deliver_ready_scans()
        response.success, response.message = True, "paused, scans are passed over" if request.data else "mapping"
        self.get_logger().info(response.message)
        return response

    def _deliver_initial_pose(self) -> None:
        """Set the pose in the map of the initial state."""
        if self.is_recovering:
            return
        if not self.process.is_mapping and self.initial_state.map is None:
            self.diagnostics.warn("mode = localization, but there is no map: call slam/load, or set start_from or mode")
        if self._initial_pose is not None:
            self.deliver(PoseReset(self._locate_in_map(self._initial_pose)))
        elif self.initial_state.lost:
            self.deliver(PoseReset())

    def _locate_in_map(self, belief: PoseGaussian) -> InitialPose:
        return locate_in_map(self.process, self._area_poses, belief, self.configuration.tsbi.place_radius)

    def _on_initial_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Reset the pose; scans that wait for a transform are older, and are dropped."""
        try:
            if message.header.frame_id != self.map_frame:
                raise HmtSlamError(
                    f"the pose is in the frame '{message.header.frame_id}', not in '{self.map_frame}': set the fixed "
                    "frame of RViz, or map_frame"
                )
            belief = conversions.gaussian_from_message(message.pose)
            check_belief(belief, "pose")
            initial_pose = self._locate_in_map(belief)
        except HmtSlamError as fault:
            self.diagnostics.refuse(INITIAL_POSE, fault)
            return
        self._scan_intake.discard_waiting()
        self.deliver(PoseReset(initial_pose))

    def _on_mark(self, message: PoseWithCovarianceStamped) -> None:
        """Deliver the observation of a mark, unless scans are passed over."""
        try:
            observation = conversions.mark_from_message(message)
        except HmtSlamError as fault:
            self.diagnostics.refuse(self.configuration.marks.topic, fault)
            return
        self.diagnostics.received[type(observation).__name__] += 1
        if not self._scan_intake.is_paused:
            self.deliver(observation)

    def deliver_ready_scans(self) -> None:
        """Deliver the scans whose laser's transform is known, and the end of the log after the last."""
        self._scan_intake.deliver_ready()
        self._end_log_if_complete()

    def _on_robot_status(self, status: RobotStatus) -> None:
        if status.state == "ended" and self.diagnostics.received["Scan"] != self._scans_at_end:
            self._end_status = status
            self._end_log_if_complete()

    def _relocalize(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Start global localization; scans that wait for a transform are older, and are dropped."""
        self._scan_intake.discard_waiting()
        self.deliver(PoseReset())
        response.success, response.message = True, "the next scan may be from anywhere"
        return response

    def deliver(self, message: Message) -> None:
        """As any process node; messages are held while a save or load is blocking, and jumps back in time detected."""
        if self.is_blocking:
            self._held.append(message)
            return
        if isinstance(message, PoseReset):
            self._scan_intake.reset_stamp_order()
            self.inbox.reset_odometry_order()
        elif (
            isinstance(message, Scan | Odometry)
            and self._scan_intake.monitor.detect_backward_jump(message)
            and not self.is_recovering
        ):
            super().deliver(PoseReset())
        self._last_message = message
        super().deliver(message)
        self._after_batch()

    def _process_batch(self) -> None:
        """Process the next scans that are ready; new ones are received between two batches."""
        self._next_batch.cancel()
        if self.process.has_more:
            self.compute(self._last_message, self.process.process_batch)
            self._after_batch()

    def _finish_queue(self) -> None:
        """Process all scans that are ready."""
        if self.process.is_interrupted:
            self.compute(self._last_message, self.process.finish_queue)

    def _after_batch(self) -> None:
        if self.process.has_more:
            self._next_batch.reset()
        if self._end_status is not None:
            self._end_log_if_complete()
        self._saver.start_if_ready()
        self._loader.start_if_ready()

    def _publish_early_estimates(self) -> None:
        """Publish where the robot is at scans that wait for an answer."""
        if self.is_recovering:
            return
        for estimate in self.process.look_ahead():
            self.outbox.send(estimate)
            self._early_estimates.add(estimate)
            self.diagnostics.sent[type(estimate).__name__] += 1

    def _deliver_held(self) -> None:
        """Deliver the held messages."""
        while self._held and not self.is_blocking:
            self.deliver(self._held.popleft())

    def replay_input(self, value: Message | ControlEvent) -> None:
        """As any process node; also scans, which do not come by the inbox, and what concerns them."""
        if isinstance(value, PauseChange):
            self._scan_intake.pause(on=value.paused)
        elif isinstance(value, FrameMounting):
            self._mountings.restore(value)
        elif isinstance(value, Scan | MarkObservation | PoseReset | EndOfLog):
            if isinstance(value, Scan):
                self._scan_intake.count_scan()
            self.deliver(value)
        else:
            super().replay_input(value)

    @property
    def resume_stamps(self) -> Mapping[str, int]:
        """As any process node; after a kill all scans and odometry since are wanted."""
        return self.recovery.stamps if self.is_recovering else {}

    @property
    def is_quiescent(self) -> bool:
        """Whether no scan waits for a transform, and nothing for a save or load."""
        is_waiting = self._scan_intake.waiting_count or self._held or self.process.is_interrupted
        return not (is_waiting or self.is_blocking or self.is_busy)

    def node_state(self) -> dict[str, object]:
        """State of the node beside its process."""
        return {
            _NODE_STATE: SlamNodeState(
                tuple(self._area_poses.values()), self.estimate, self._is_map_unchanged, self._scan_intake.dropped_count
            )
        }

    def restore_node_state(self, folder: Path) -> None:
        """Restore the state of the node beside its process."""
        state = FolderReader(folder, CHECKPOINT, VERSION).read(_NODE_STATE, SlamNodeState)
        self._area_poses = {entry.area: entry for entry in state.area_poses}
        self.estimate, self._is_map_unchanged = state.estimate, state.map_unchanged
        self._scan_intake.dropped_count = state.dropped_scans

    def poll_final_save(self) -> bool:
        """Whether the last save has ended."""
        return not self.is_configured or self._saver.poll_final_save()

    def write_map(self, writer: MapWriter) -> None:
        """Write the map as it is known now."""
        from hmt_slam_ros.results.recorder import complete_area_poses  # noqa: PLC0415  only where something is saved

        assert self.estimate is not None
        replica = self.process.replica
        poses = complete_area_poses(replica.maps[replica.best_hypothesis], tuple(self._area_poses.values()))
        writer.write_map(replica, poses, self.estimate)

    def _end_log_if_complete(self, *, force: bool = False) -> None:
        end = self._end_status
        if end is None or self._scan_intake.waiting_count or self._scan_intake.is_paused or not self.is_active:
            return
        complete = (
            self.diagnostics.received["Scan"] >= end.scans
            and self.diagnostics.received["Odometry"] >= end.odometry_readings
        )
        if complete or force:
            self._end_status, self._scans_at_end = None, self.diagnostics.received["Scan"]
            self.deliver(EndOfLog())

    def _check_inputs(self) -> None:
        """Report missing inputs once a second, and stop to wait for lost scans."""
        self.diagnostics.values["early estimates"] = str(self._early_estimates)
        self.diagnostics.values["speculation"] = str(self.process.record)
        self.diagnostics.values["waiting scans"] = self.process.queued_scans + self._scan_intake.waiting_count
        self.deliver_ready_scans()
        self._scan_intake.warn_if_waiting()
        if not self.is_active:
            return
        self._scan_intake.monitor.check_silence(self.diagnostics.received["Odometry"])
        if self._end_status is not None and time.monotonic() - self._scan_intake.last_scan_at > _END_TIMEOUT:
            count = self.diagnostics.received["Scan"]
            self.diagnostics.warn(f"the log ended, but only {count} of its {self._end_status.scans} scans came")
            self._end_log_if_complete(force=True)

    def publish_views(self, message: Message, outputs: list[Message]) -> None:
        """Publish early estimates, and at keyframes the particles of the most probable hypothesis in the map."""
        if isinstance(message, ClosureDecision) and message.global_poses:
            self._area_poses = {entry.area: entry for entry in message.global_poses}
        for output in outputs:
            if isinstance(output, TrackingReset):
                self._early_estimates.clear()
            if isinstance(output, LocalEstimate):
                self.estimate = output
                self._early_estimates.compare(output)
            if isinstance(output, Keyframe):
                self._report_particles(output)
                self._publish_particles(output.scan.stamp)
        self._publish_early_estimates()

    def _report_particles(self, keyframe: Keyframe) -> None:
        best = self.process.replica.best_hypothesis
        for estimate in keyframe.estimates:
            if estimate.hypothesis == best:
                particles = len(self.process.particles[1])
                self.diagnostics.values["effective samples"] = f"{estimate.effective_samples:.1f} of {particles}"
                self.diagnostics.values["modes of the pose"] = str(estimate.mode_count)

    def _publish_particles(self, stamp: int) -> None:
        area, poses = self.process.particles
        if area in self._area_poses and self._particles.get_subscription_count():
            in_map = se2.compose(self._area_poses[area].pose.mean, poses)
            header = conversions.header_message(stamp, self.map_frame)
            self._particles.publish(PoseArray(header=header, poses=[conversions.pose_message(pose) for pose in in_map]))
