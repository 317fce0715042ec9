"""A node that no message and no request can end: what a callback cannot handle is refused and counted.

rclpy ends the executor with whatever a callback raises, also in the services of parameters and in the clock that it
makes by itself. So every callback of every subscription, service and timer of a node passes this one gate.
"""

from __future__ import annotations

import inspect
import traceback
from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, Any

from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.system_name import ForeignDocumentError
from hmt_slam_ros.ros.topics import BETWEEN_NODES
from hmt_slam_ros.untrusted_input import shorten

if TYPE_CHECKING:
    from hmt_slam_ros.ros.diagnostics import NodeDiagnostics

Callback = Callable[..., Any]


class GuardedNode(Node):
    """Base of all nodes.

    :ivar diagnostics: where refusals are counted; a subclass sets it in its constructor.
    """

    diagnostics: NodeDiagnostics

    def create_publisher(self, msg_type: type, topic: str, *options: Any, **named: Any) -> Any:  # noqa: ANN401  rclpy's
        """As rclpy's, without its warning of subscriptions that do not match, which warn in their own program.

        Each event of the middleware is one more entity that the executor looks at before every callback
        (docs/decisions/0099-events-of-the-middleware.md).
        """
        named.setdefault("event_callbacks", PublisherEventCallbacks(use_default_callbacks=False))
        return super().create_publisher(msg_type, topic, *options, **named)

    def create_subscription(self, msg_type: type, topic: str, callback: Callback, *options: Any, **named: Any) -> Any:  # noqa: ANN401  rclpy's
        """As rclpy's; a message on which the callback raises an error is refused.

        It warns of publishers that do not match, where these may be of other programs.
        """
        if topic in BETWEEN_NODES:
            named.setdefault("event_callbacks", SubscriptionEventCallbacks(use_default_callbacks=False))
        return super().create_subscription(msg_type, topic, self.guard(topic, callback), *options, **named)

    def create_service(self, srv_type: type, srv_name: str, callback: Callback, **options: Any) -> Any:  # noqa: ANN401  rclpy's
        """As rclpy's; a request on which the callback raises an error gets the answer as it is by then."""
        guard = self._guard_coroutine if inspect.iscoroutinefunction(callback) else self.guard
        return super().create_service(srv_type, srv_name, guard(srv_name, callback), **options)

    def create_timer(self, timer_period_sec: float, callback: Callback, *options: Any, **named: Any) -> Any:  # noqa: ANN401  rclpy's
        """As rclpy's; an error that the callback raises is reported, unless it is the sentence that ends the node."""

        def run() -> None:
            try:
                callback()
            except HmtSlamError:
                raise
            except Exception as fault:
                self._refuse("a timer", fault, (None,))

        return super().create_timer(timer_period_sec, run, *options, **named)

    def guard(self, name: str, callback: Callback) -> Callback:
        """The callback of a topic, service or action that refuses and counts what it cannot handle."""

        @wraps(callback)
        def run(*arguments: Any) -> Any:  # noqa: ANN401  rclpy's
            try:
                return callback(*arguments)
            except Exception as fault:
                return self._refuse(name, fault, arguments)

        return run

    def _guard_coroutine(self, name: str, callback: Callback) -> Callback:
        @wraps(callback)
        async def run(*arguments: Any) -> Any:  # noqa: ANN401  rclpy's
            try:
                return await callback(*arguments)
            except Exception as fault:
                return self._refuse(name, fault, arguments)

        return run

    def _refuse(self, name: str, fault: Exception, arguments: tuple[Any, ...]) -> Any:  # noqa: ANN401  a response
        """Report what a callback raised; return the response of a service.

        :raises Exception: ``fault``, where the node is to end.
        """
        if not isinstance(fault, HmtSlamError):
            if isinstance(fault, ExternalShutdownException) or not self.context.ok():
                raise fault
            if self.diagnostics.is_new_cause(name, type(fault).__name__):
                self.get_logger().error("".join(traceback.format_exception(fault)))
            fault = HmtSlamError(f"it cannot be handled ({shorten(repr(fault))}): correct who sends it, or report this")
        if isinstance(fault, ForeignDocumentError):
            self.diagnostics.system.note_other(fault.system)
        self.diagnostics.refuse(name, fault)
        return arguments[-1]
