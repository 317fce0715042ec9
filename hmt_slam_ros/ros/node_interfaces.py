"""Parts of a node's interface, for the helpers that the node makes and that call it back."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.messages.messages import LocalEstimate, Message
from hmt_slam_ros.messages.routing import Checkpointable
from hmt_slam_ros.ros.diagnostics import NodeDiagnostics
from hmt_slam_ros.ros.inbox import Inbox
from hmt_slam_ros.ros.initial_state import InitialState

if TYPE_CHECKING:
    from hmt_slam_ros.metric_slam.slam import MetricSlam
    from hmt_slam_ros.results.hmt_map import MapWriter


class DiagnosedNode(Protocol):
    """A node with diagnostics; rclpy has no types for what it makes."""

    @property
    def diagnostics(self) -> NodeDiagnostics:
        """Counts, values and faults for /diagnostics."""

    def create_publisher(self, kind: type, topic: str, profile: Any) -> Any:  # noqa: ANN401  rclpy's
        """Make a publisher."""

    def create_subscription(self, kind: type, topic: str, callback: Callable[[Any], None], profile: Any) -> Any:  # noqa: ANN401
        """Make a subscription."""

    def create_timer(self, period: float, callback: Callable[[], None], **options: Any) -> Any:  # noqa: ANN401
        """Make a timer; ``period`` in s."""

    def create_service(self, kind: type, name: str, callback: Callable[..., Any], **options: Any) -> Any:  # noqa: ANN401
        """Make a service."""


class ParticipantNode(DiagnosedNode, Protocol):
    """A process node that answers coordinated requests."""

    @property
    def process(self) -> Checkpointable:
        """The process of the node."""

    @property
    def inbox(self) -> Inbox:
        """The subscriptions of the process."""

    @property
    def initial_state(self) -> InitialState:
        """The map from which the process started."""

    @property
    def reset_number(self) -> int:
        """Number of the last reset request that was answered, 0 before the first."""

    def reset(self, folder: str, reset_number: int = 0) -> None:
        """Start anew from the map in ``folder``, or from nothing where that is empty."""


class CoordinatorNode(DiagnosedNode, Protocol):
    """The node of metric SLAM, as far as a coordinated request concerns it."""

    @property
    def process(self) -> MetricSlam:
        """Metric SLAM."""


class MapServicesNode(CoordinatorNode, Protocol):
    """The node of metric SLAM, as the services that save and load maps need it.

    :ivar save_to: folder into which maps are saved.
    :ivar map_frame: name of the map's frame.
    :ivar estimate: the last estimate of metric SLAM, None before the first.
    """

    save_to: Path
    map_frame: str
    estimate: LocalEstimate | None

    @property
    def configuration(self) -> Configuration:
        """The parameters of the node."""

    @property
    def is_busy(self) -> bool:
        """Whether a map is being saved or exchanged."""

    @property
    def unchanged_map_folder(self) -> Path | None:
        """Folder of the loaded map where the run did not change it, else None."""

    def write_map(self, writer: MapWriter) -> None:
        """Write the current map."""

    def reset(self, folder: str, reset_number: int = 0) -> None:
        """Start anew from the map in ``folder``, or from nothing where that is empty."""

    def get_logger(self) -> Any:  # noqa: ANN401  rclpy's
        """The logger of the node."""


class ScanReceiver(DiagnosedNode, Protocol):
    """The node of metric SLAM, as the intake of its scans needs it."""

    @property
    def process(self) -> MetricSlam:
        """Metric SLAM."""

    def deliver(self, message: Message) -> None:
        """Let the process handle a message and publish its answers."""

    def deliver_ready_scans(self) -> None:
        """Deliver the scans whose mounting is known."""
