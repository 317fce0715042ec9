"""Nodes of TSBI, TLCA and RTL, which publish standard ROS messages beside those of their processes."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from nav_msgs.msg import Path as PathMessage
from nav_msgs.srv import GetMap
from std_msgs.msg import Bool, Float64, Float64MultiArray, String
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.alternatives import Alternatives
from hmt_slam_ros.messages.ambiguity import Ambiguity
from hmt_slam_ros.messages.documents import encode
from hmt_slam_ros.messages.evidence import Evidence
from hmt_slam_ros.messages.messages import ClosureDecision, Hypotheses, Message, RealTimePose, TrackingReset
from hmt_slam_ros.messages.statements import parse_statement
from hmt_slam_ros.messages.topology import Topology
from hmt_slam_ros.real_time_localization.rtl import CorrectionSmoother
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import (
    area_frame,
    header_message,
    pose_message,
    pose_with_covariance_message,
    table_message,
    transform_message,
)
from hmt_slam_ros.ros.execution import set_realtime_priority
from hmt_slam_ros.ros.landmark_publisher import LandmarkPublisher
from hmt_slam_ros.ros.map_publisher import MapPublisher
from hmt_slam_ros.ros.map_view import MapRenderer, MapRendererState
from hmt_slam_ros.ros.odometry_frames import ODOM_FRAME, OdometryFrames, declare_odometry_frame
from hmt_slam_ros.ros.parameters import declare_frame
from hmt_slam_ros.ros.process_node import ProcessNode
from hmt_slam_ros.ros.recovery import CHECKPOINT
from hmt_slam_ros.ros.topics import (
    AMBIGUITY_GOAL,
    DOCUMENTS,
    ENTROPY,
    GRAPH,
    HMT_POSE,
    IS_LOCALIZED,
    MAP,
    PATH,
    PMF,
    POSE,
    STATEMENT,
    transform_publisher,
)
from hmt_slam_ros.saved_map.folder import VERSION, FolderReader

if TYPE_CHECKING:
    from hmt_slam_ros.loop_closure.tlca import Tlca
    from hmt_slam_ros.topological_inference.tsbi import Tsbi

_RENDERER_STATE, _EVIDENCE = "view", "evidence"
"""Names of documents in a checkpoint."""
_AMBIGUITY = "ambiguity"
"""Name of the value in /diagnostics."""
_CHECK_PERIOD = 1.0
"""Time between two checks whether the map has to be published again, s."""
_DRAWING_PERIOD, _DATA_PERIOD = 2.9, 0.9
"""Least times between two drawings of the map, and between two messages of its data, s; just below whole checks."""


class TsbiNode(ProcessNode):
    """The node ``tsbi``: the distribution of Eq. (14), whether the robot is localized, and statements of people."""

    process: Tsbi

    def configure_node(self) -> None:
        """As any process node; also publish whether the robot is localized, and subscribe to statements of people."""
        super().configure_node()
        self._pmf = self.create_publisher(Float64MultiArray, PMF, topics.LATCHED)
        self._localized_publisher = self.create_publisher(Bool, IS_LOCALIZED, topics.LATCHED)
        self._entropy_publisher = self.create_publisher(Float64, ENTROPY, topics.LATCHED)
        self.create_subscription(String, STATEMENT, self._on_statement, topics.STREAM)
        self._evidence_publisher = self.create_publisher(String, DOCUMENTS[Evidence], topics.LATCHED)
        self._published_evidence: Evidence | None = None
        self._publish_localization()

    def publish_views(self, message: Message, outputs: list[Message]) -> None:
        """Publish the distribution over the topological paths, Eq. (14), its evidence, and whether it is localized."""
        if outputs or isinstance(message, ClosureDecision | TrackingReset):
            self._publish_localization()
        for output in outputs:
            if isinstance(output, Hypotheses):
                self._pmf.publish(pmf_message(output))
        if self.process.evidence is not self._published_evidence:
            self._publish_evidence()

    def _publish_evidence(self) -> None:
        self._published_evidence = self.process.evidence
        document = encode(self._published_evidence, self.reset_number, self.diagnostics.system.name)
        self._evidence_publisher.publish(String(data=document))

    def node_state(self) -> dict[str, object]:
        """The evidence, which people read."""
        return {_EVIDENCE: self.process.evidence}

    def restore_node_state(self, folder: Path) -> None:
        """Restore the evidence, and publish it for those who come later."""
        self.process.restore_evidence(FolderReader(folder, CHECKPOINT, VERSION).read(_EVIDENCE, Evidence))
        self._publish_evidence()

    def _on_statement(self, message: String) -> None:
        """Deliver what a person states about two areas."""
        try:
            statement = parse_statement(message.data)
        except HmtSlamError as fault:
            self.diagnostics.refuse(STATEMENT, fault)
            return
        self.inbox.receive(statement)

    def reset(self, folder: str, reset_number: int = 0) -> None:
        """As any process node; also publish that the robot is not localized."""
        super().reset(folder, reset_number)
        self._publish_localization()

    def _publish_localization(self) -> None:
        status = self.process.localization
        self._localized_publisher.publish(Bool(data=status.localized))
        self._entropy_publisher.publish(Float64(data=status.entropy))
        self.diagnostics.values["localized"] = "yes" if status.localized else "no, the robot may be anywhere in the map"
        self.diagnostics.values["area as open as"] = f"{math.exp(status.entropy):.2f} places"


def pmf_message(hypotheses: Hypotheses) -> Float64MultiArray:
    """Rows of (hypothesis, area, probability) by falling probability; the last is (-1, -1, unexamined probability)."""
    by_probability = sorted(hypotheses.hypotheses, key=lambda hypothesis: (-hypothesis.probability, hypothesis.id))
    rows = [(hypothesis.id, hypothesis.area, hypothesis.probability) for hypothesis in by_probability]
    return table_message("hypothesis", ("hypothesis", "area", "probability"), [*rows, (-1, -1, hypotheses.unexamined)])


class TlcaNode(ProcessNode):
    """The node ``tlca``: the map as a grid, as markers, as data and as a path, and where a look would decide."""

    process: Tlca

    def declare_own_parameters(self) -> None:
        """As any process node; also declare ``map_frame``."""
        super().declare_own_parameters()
        self._map_frame = declare_frame(self, "map", "map")

    def configure_node(self) -> None:
        """As any process node; also publish the map."""
        super().configure_node()
        self._renderer = self._make_renderer(MapRendererState.from_document(self.initial_state.map))
        self._map_publishers: tuple[MapPublisher[MapRenderer] | LandmarkPublisher, ...] = (
            MapPublisher(self, OccupancyGrid, MAP, MapRenderer.occupancy_grid, _DRAWING_PERIOD),
            MapPublisher(self, MarkerArray, GRAPH, MapRenderer.graph_markers, _DRAWING_PERIOD),
            MapPublisher(self, PathMessage, PATH, MapRenderer.path, _DATA_PERIOD),
            MapPublisher(self, String, DOCUMENTS[Topology], self._topology_document, _DATA_PERIOD),
            MapPublisher(self, String, DOCUMENTS[Alternatives], self._alternatives_document, _DATA_PERIOD),
            LandmarkPublisher(self, self.kernels, self.configuration),
        )
        self._ambiguity_goals = self.create_publisher(PoseStamped, AMBIGUITY_GOAL, topics.STREAM)
        self.create_timer(_CHECK_PERIOD, self._publish_if_changed, clock=self.diagnostics.steady_clock)
        self.create_service(GetMap, "~/get_map", self._get_map)
        self.create_service(Trigger, "~/get_graphml", self._get_graphml)

    def _make_renderer(self, state: MapRendererState) -> MapRenderer:
        return MapRenderer(self.configuration, self._map_frame, state, self.initial_state.events)

    def reset(self, folder: str, reset_number: int = 0) -> None:
        """As any process node; also publish the new map."""
        super().reset(folder, reset_number)
        self.diagnostics.values.pop(_AMBIGUITY, None)
        self._renderer = self._make_renderer(MapRendererState.from_document(self.initial_state.map))
        for publisher in self._map_publishers:
            publisher.invalidate()

    def node_state(self) -> dict[str, object]:
        """State of the renderer."""
        return {_RENDERER_STATE: self._renderer.state}

    def restore_node_state(self, folder: Path) -> None:
        """Restore the renderer."""
        reader = FolderReader(folder, CHECKPOINT, VERSION)
        self._renderer = self._make_renderer(reader.read(_RENDERER_STATE, MapRendererState))

    def _get_map(self, _request: GetMap.Request, response: GetMap.Response) -> GetMap.Response:
        """Answer with the current grid, an empty one before the first keyframe."""
        response.map = self._renderer.occupancy_grid() or response.map
        return response

    def publish_views(self, message: Message, outputs: list[Message]) -> None:
        """Update the map, which a timer publishes; publish where a look would decide."""
        for value in (message, *outputs):
            self._renderer.update(value)
            if isinstance(value, Ambiguity):
                self._publish_ambiguity(value)

    def _publish_ambiguity(self, ambiguity: Ambiguity) -> None:
        self.diagnostics.values[_AMBIGUITY] = ambiguity.text or "one hypothesis is probable"
        best = ambiguity.best_look()
        pose = (
            None if best is None else self._renderer.pose_in_map(ambiguity.looks[best].area, ambiguity.looks[best].pose)
        )
        if pose is not None:
            header = header_message(self._renderer.stamp, self._map_frame)
            self._ambiguity_goals.publish(PoseStamped(header=header, pose=pose_message(pose)))

    def _publish_if_changed(self) -> None:
        if self.is_active:
            for publisher in self._map_publishers:
                publisher.publish_if_due(self._renderer)

    def _topology_document(self, renderer: MapRenderer) -> String:
        topology = renderer.topology(self.process.robot_poses)
        return String(data=encode(topology, self.reset_number, self.diagnostics.system.name))

    def _alternatives_document(self, renderer: MapRenderer) -> String:
        alternatives = renderer.alternatives(self.process.robot_poses)
        return String(data=encode(alternatives, self.reset_number, self.diagnostics.system.name))

    def _get_graphml(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Answer with the areas and arcs as GraphML."""
        from hmt_slam_ros.results.graphml import topology_graphml  # noqa: PLC0415  networkx takes long to load

        topology = self._renderer.topology(self.process.robot_poses)
        response.success = bool(topology.areas)
        response.message = topology_graphml(topology) if topology.areas else "nothing is mapped yet, drive first"
        return response


class RtlNode(ProcessNode):
    """The node ``rtl``: /hmt/pose, /pose and map -> odom at the rate of the odometry."""

    # Nobody waits for rtl, and dead reckoning must have no gap.
    is_always_listening = True
    changeable_parameters = ("rtl.publish_tf", "rtl.correction_time")
    odometry_frames: OdometryFrames

    def declare_own_parameters(self) -> None:
        """As any process node; also declare ``map_frame`` and ``odom_frame``."""
        super().declare_own_parameters()
        self._map_frame, self._odom_frame = declare_frame(self, "map", "map"), declare_odometry_frame(self, ODOM_FRAME)

    def configure_node(self) -> None:
        """As any process node; also publish poses and transforms."""
        self.odometry_frames = OdometryFrames(self.diagnostics, odom_frame=self._odom_frame)
        super().configure_node()
        self._hmt_poses = self.create_publisher(PoseWithCovarianceStamped, HMT_POSE, topics.STREAM)
        self._poses = self.create_publisher(PoseWithCovarianceStamped, POSE, topics.STREAM)
        self._correction = CorrectionSmoother()
        self._send_transforms = transform_publisher(self, "tf")
        self.outbox.set_writer(RealTimePose, self._publish)
        if self.configuration.rtl.realtime_priority:
            self.diagnostics.values["real-time scheduling"] = "yes" if set_realtime_priority() else "not permitted"

    def _publish(self, pose: RealTimePose) -> None:
        self._hmt_poses.publish(pose_with_covariance_message(pose.stamp, area_frame(pose.area), pose.pose_in_area))
        self._poses.publish(pose_with_covariance_message(pose.stamp, self._map_frame, pose.map_pose))
        settings = self.configuration.rtl
        odom_frame = self.odometry_frames.odom
        if settings.publish_tf and odom_frame:
            map_T_odom = self._correction.smooth(pose.stamp, pose.map_T_odom, pose.odometry, settings.correction_time)
            self._send_transforms([transform_message(pose.stamp, self._map_frame, odom_frame, map_T_odom)])
