"""A managed node of ROS 2: others may bring it up, halt it and take it down, state by state; by itself it comes up.

docs/decisions/0034-managed-nodes.md says what the states mean. rclpy's part of it has three gaps that are filled here:
an exception in a transition is passed over in silence, a transition that the state does not have ends the process, and
nothing that was made for a state is destroyed with it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState
from rclpy.lifecycle.node import TransitionCallbackReturn
from rclpy.time_source import CLOCK_TOPIC

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.ros.diagnostics import STATE, NodeDiagnostics
from hmt_slam_ros.ros.parameters import ConfiguredNode

_AUTOSTART = ParameterDescriptor(
    description="Whether the node configures and activates itself; otherwise it waits for a lifecycle manager.",
    read_only=True,
)


class ManagedNode(LifecycleNodeMixin, ConfiguredNode):
    """A node with parameters, diagnostics and the services of its states; what it does in them is of subclasses.

    :ivar diagnostics: what it counts, also while it is not configured.
    :ivar is_configured: whether it is inactive or active.
    :ivar is_active: whether it takes part.
    """

    def __init__(self, name: str, changeable: Iterable[str] = ()) -> None:
        """Declare the parameters; where one cannot be, the node is never configured.

        :param name: of the node.
        :param changeable: dotted names of the parameters that may change while the node runs.
        """
        self.is_configured = self.is_active = False
        self._fault: Exception | None = None
        self._parameter_fault: HmtSlamError | None = None
        try:
            ConfiguredNode.__init__(self, name, changeable)
            self.declare_own_parameters()
        except HmtSlamError as fault:
            self._parameter_fault = fault
        self._autostart = bool(self.declare_parameter("autostart", True, _AUTOSTART).value)
        self.diagnostics = NodeDiagnostics(self)
        LifecycleNodeMixin.__init__(self)
        self._change_state = self._service_change_state.callback
        self._service_change_state.callback = self._handle_change_state
        self._permanent_entities = set(self._entities())
        self._update_state()

    def declare_own_parameters(self) -> None:
        """Declare the parameters that are not in the tree.

        :raises HmtSlamError: for a value that cannot be.
        """

    def configure_node(self) -> None:
        """Make all that the node needs to take part.

        :raises HmtSlamError: where it cannot be; what was made by then is destroyed.
        """

    def activate_node(self) -> None:
        """Begin, or go on after :meth:`deactivate_node`."""

    def deactivate_node(self) -> None:
        """Do nothing new, and lose nothing."""

    def check_clean_up(self) -> None:
        """See whether the node can be taken down and used on.

        :raises HmtSlamError: where that cannot be now.
        """

    def clean_up_node(self) -> None:
        """Forget what :meth:`configure_node` made, but for publishers, subscriptions, services and timers."""

    def abandon_configuration(self) -> None:
        """Forget what :meth:`configure_node` made before it failed."""
        self._destroy_configured_entities()

    def shut_down_node(self) -> None:
        """Do what is left to do when the node is shut down, and :meth:`tear_down` at its end."""
        self.tear_down()

    @property
    def startup_states(self) -> tuple[bool, bool]:
        """Whether the node configures itself at its start, and activates itself."""
        return self._autostart, self._autostart

    def enter_startup_states(self) -> None:
        """Enter the states in which the node starts.

        :raises HmtSlamError: where it cannot be configured.
        """
        if self._parameter_fault is not None and self._autostart:
            raise self._parameter_fault
        configure, activate = (False, False) if self._parameter_fault else self.startup_states
        for wanted, trigger in ((configure, self.trigger_configure), (activate, self.trigger_activate)):
            if wanted:
                trigger()
                self._update_state()
                if self._fault is not None:
                    raise self._fault

    def tear_down(self) -> None:
        """Destroy all that was made since the node is there."""
        self.clean_up_node()
        self.is_configured = self.is_active = False
        self._destroy_configured_entities()

    def on_configure(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """From unconfigured to inactive."""
        return self._run_transition(self._configure)

    def on_activate(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """From inactive to active."""
        return self._run_transition(self._activate)

    def on_deactivate(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """From active to inactive."""
        return self._run_transition(self._deactivate)

    def on_cleanup(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """From inactive to unconfigured."""
        return self._run_transition(self._clean_up)

    def on_shutdown(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """From any of them to finalized."""
        return self._run_transition(self.shut_down_node if self.is_configured else lambda: None)

    def _configure(self) -> None:
        if self._parameter_fault is not None:
            raise self._parameter_fault
        self.diagnostics.clear()
        try:
            self.configure_node()
        except HmtSlamError:
            self.abandon_configuration()
            raise
        self.is_configured = True

    def _activate(self) -> None:
        self.is_active = True
        self.activate_node()

    def _deactivate(self) -> None:
        self.is_active = False
        self.deactivate_node()

    def _clean_up(self) -> None:
        self.check_clean_up()
        self.tear_down()

    def _run_transition(self, change: Callable[[], None]) -> TransitionCallbackReturn:
        """Keep what rclpy would pass over."""
        self._fault = None
        try:
            change()
        except HmtSlamError as fault:
            self._fault = fault
            return TransitionCallbackReturn.FAILURE
        except Exception as fault:
            self._fault = fault
            return TransitionCallbackReturn.ERROR
        return TransitionCallbackReturn.SUCCESS

    def _handle_change_state(
        self, request: ChangeState.Request, response: ChangeState.Response
    ) -> ChangeState.Response:
        """Change the state as somebody asks; a transition that there is not is refused, and a defect ends the node."""
        self._fault = None
        try:
            self._change_state(request, response)
        except rclpy_implementation.RCLError:
            response.success = False  # rcl has told why
        self._update_state()
        if isinstance(self._fault, HmtSlamError):
            self.diagnostics.fail(str(self._fault))
        elif self._fault is not None:
            raise self._fault
        return response

    @property
    def state(self) -> str:
        """Name of the node's state, such as unconfigured, inactive, active, finalized."""
        return str(self._state_machine.current_state[1])

    def destroy_node(self) -> None:
        """As any node; the services and the publisher of the states are not the node's own for rclpy."""
        super().destroy_node()
        self._state_machine.destroy_when_not_in_use()

    def _update_state(self) -> None:
        self.diagnostics.values[STATE] = self.state

    def _entities(self) -> Iterator[Any]:
        for there in (self.publishers, self.subscriptions, self.services, self.timers):
            yield from there

    def _destroy_configured_entities(self) -> None:
        for there, destroy in (
            (self.subscriptions, self.destroy_subscription),
            (self.services, self.destroy_service),
            (self.timers, self.destroy_timer),
            (self.publishers, self.destroy_publisher),
        ):
            for entity in set(there) - self._permanent_entities:
                # Made by rclpy, maybe later, as use_sim_time is set.
                if getattr(entity, "topic_name", "") != CLOCK_TOPIC:
                    destroy(entity)
