"""Managed node of ROS 2: it configures and activates itself, unless a lifecycle manager does.

docs/decisions/0034-managed-nodes.md defines the states. Three gaps of rclpy are filled here. It ignores exceptions in
a transition, ends the process at a transition that the state does not have, and destroys nothing on cleanup.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState
from rclpy.lifecycle.node import TransitionCallbackReturn
from rclpy.task import Future
from rclpy.time_source import CLOCK_TOPIC

from hmt_slam_ros.compilation import report_compilation
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.system_name import SystemName
from hmt_slam_ros.ros.diagnostics import STATE, NodeDiagnostics
from hmt_slam_ros.ros.kernel_thread import KernelThread
from hmt_slam_ros.ros.parameters import ConfiguredNode
from hmt_slam_ros.ros.precedence_monitor import PrecedenceMonitor

_POLL = 0.02
"""Time between two checks whether the kernels are loaded, s."""
_PRECEDENCE_POLL = 0.5
"""Time between two checks whether an earlier system runs, s."""
_AUTOSTART = ParameterDescriptor(
    description="Whether the node configures and activates itself; otherwise it waits for a lifecycle manager.",
    read_only=True,
)


class ManagedNode(LifecycleNodeMixin, ConfiguredNode):
    """A node with parameters, diagnostics and lifecycle services; subclasses define the transitions.

    :ivar diagnostics: counts and faults, also while the node is unconfigured.
    :ivar is_configured: whether the node is inactive or active.
    :ivar is_active: whether the node is active.
    :ivar kernels: the thread that loads the kernels, started by ``configure``.
    :ivar precedence: whether a system that was started earlier runs on the topics of the node.
    """

    def __init__(self, name: str) -> None:
        """Declare the parameters; with an invalid one the node can never be configured."""
        self.is_configured = self.is_active = False
        self.kernels, self._loading_timer = KernelThread(name), None
        self._kernels_loaded = Future()
        self._activates_itself = False
        self._fault: Exception | None = None
        self._parameter_fault: HmtSlamError | None = None
        self.system = SystemName()
        try:
            ConfiguredNode.__init__(self, name)
            self.declare_own_parameters()
        except HmtSlamError as fault:
            self._parameter_fault = fault
        self._autostart = bool(self.declare_parameter("autostart", True, _AUTOSTART).value)
        self.diagnostics = NodeDiagnostics(self, self.system)
        self.diagnostics.kernels, self.diagnostics.progress = self.kernels.describe, lambda: self.kernels.progress
        self.precedence = PrecedenceMonitor(self, self.diagnostics)
        self.create_timer(_PRECEDENCE_POLL, self._follow_precedence, clock=self.diagnostics.steady_clock)
        # So that other requests are answered while one waits for the kernels; all of them run in one thread.
        LifecycleNodeMixin.__init__(self, callback_group=ReentrantCallbackGroup())
        self._change_state = self._service_change_state.callback
        self._service_change_state.callback = self._handle_change_state
        self._permanent_entities = set(self._entities())
        self._update_state()

    def declare_own_parameters(self) -> None:
        """Declare the parameters that are not in the configuration tree.

        :raises HmtSlamError: for an invalid value.
        """

    def configure_node(self) -> None:
        """Make the process, publishers, subscriptions, services and timers.

        :raises HmtSlamError: where that fails; what was made until then is destroyed.
        """

    def activate_node(self) -> None:
        """Start to process messages, or resume after :meth:`deactivate_node`."""

    def deactivate_node(self) -> None:
        """Stop to process new messages, without losing any."""

    def check_clean_up(self) -> None:
        """Check whether the node can be cleaned up now.

        :raises HmtSlamError: where it cannot.
        """

    def clean_up_node(self) -> None:
        """Drop what :meth:`configure_node` made, apart from publishers, subscriptions, services and timers."""

    def abandon_configuration(self) -> None:
        """Drop what :meth:`configure_node` made before it failed."""
        self._destroy_configured_entities()

    def shut_down_node(self) -> None:
        """Finish what is left to do at shutdown, then :meth:`tear_down`."""
        self.tear_down()

    @property
    def startup_states(self) -> tuple[bool, bool]:
        """Whether the node configures itself at startup, and whether it activates itself."""
        return self._autostart, self._autostart

    def enter_startup_states(self) -> None:
        """Make the transitions of startup; the second one comes when the kernels are loaded.

        :raises HmtSlamError: where the first one fails.
        """
        if self._parameter_fault is not None and self._autostart:
            raise self._parameter_fault
        configure, activate = (False, False) if self._parameter_fault else self.startup_states
        if configure:
            self._activates_itself = activate
            self._make_startup_transition(self.trigger_configure)

    def _make_startup_transition(self, trigger: Callable[[], object]) -> None:
        trigger()
        self._update_state()
        if self._fault is not None:
            raise self._fault

    def _load_kernels(self) -> None:
        """Load the kernels of what is configured, while the node spins."""
        report_compilation(self.get_logger().info)
        self._kernels_loaded = Future()
        self.kernels.start()
        self._loading_timer = self.create_timer(_POLL, self._check_kernels, clock=self.diagnostics.steady_clock)

    def _check_kernels(self) -> None:
        """Go on with the startup, and answer who waits, where the kernels are loaded."""
        if self.kernels.is_done:
            self._stop_loading()
            self._follow_precedence()

    def _follow_precedence(self) -> None:
        """Activate the node where that is due; halt it while an earlier system runs, and at last end it.

        :raises HmtSlamError: where the node is to end.
        """
        if self.precedence.check():
            if self.is_active:
                self._make_startup_transition(self.trigger_deactivate)
                self._activates_itself = True
            if self._autostart:
                self.precedence.check_patience()
        elif self._is_activation_due and (self.continues_killed_node or not self.precedence.is_unsure):
            self._make_startup_transition(self.trigger_activate)

    @property
    def _is_activation_due(self) -> bool:
        return self._activates_itself and self.is_configured and not self.is_active and self._loading_timer is None

    @property
    def continues_killed_node(self) -> bool:
        """Whether the node goes on where a killed one of its name was."""
        return False

    def _stop_loading(self) -> None:
        self.kernels.stop()
        if self._loading_timer is not None:
            self.destroy_timer(self._loading_timer)
            self._loading_timer = None
            self._kernels_loaded.set_result(None)

    def tear_down(self) -> None:
        """Destroy all that was made after the constructor."""
        self._stop_loading()
        self.clean_up_node()
        self.is_configured = self.is_active = self._activates_itself = False
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
        self._load_kernels()

    def _activate(self) -> None:
        self.precedence.check_first()
        self.is_active, self._activates_itself = True, False
        self.activate_node()

    def _deactivate(self) -> None:
        self.is_active = False
        self.deactivate_node()

    def _clean_up(self) -> None:
        self.check_clean_up()
        self.tear_down()

    def _run_transition(self, change: Callable[[], None]) -> TransitionCallbackReturn:
        """Run a transition, and keep the exception, which rclpy would ignore."""
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

    async def _handle_change_state(
        self, request: ChangeState.Request, response: ChangeState.Response
    ) -> ChangeState.Response:
        """Answer the service ``change_state``; refuse an unknown transition, and raise a programming error.

        The answer to ``configure``, and an activation, wait until the kernels are loaded.
        """
        transition = request.transition
        if _is_transition(transition, Transition.TRANSITION_ACTIVATE, "activate"):
            await self._wait_for_kernels()
        self._change_state_now(request, response)
        if response.success and _is_transition(transition, Transition.TRANSITION_CONFIGURE, "configure"):
            await self._wait_for_kernels()
        return response

    async def _wait_for_kernels(self) -> None:
        if self._loading_timer is not None:
            await self._kernels_loaded

    def _change_state_now(self, request: ChangeState.Request, response: ChangeState.Response) -> None:
        self._fault = None
        try:
            self._change_state(request, response)
        except rclpy_implementation.RCLError:
            response.success = False  # rcl has logged the reason
        self._update_state()
        if isinstance(self._fault, HmtSlamError):
            self.diagnostics.fail(str(self._fault))
        elif self._fault is not None:
            raise self._fault

    @property
    def state(self) -> str:
        """Name of the lifecycle state: unconfigured, inactive, active or finalized."""
        return str(self._state_machine.current_state[1])

    def destroy_node(self) -> None:
        """Destroy the node with its lifecycle services and publisher, which rclpy does not count to the node."""
        self.kernels.stop()
        super().destroy_node()
        self._state_machine.destroy_when_not_in_use()

    def _update_state(self) -> None:
        self.diagnostics.values[STATE] = self.state

    def _entities(self) -> Iterator[Any]:
        for entities in (self.publishers, self.subscriptions, self.services, self.timers):
            yield from entities

    def _destroy_configured_entities(self) -> None:
        for entities, destroy in (
            (self.subscriptions, self.destroy_subscription),
            (self.services, self.destroy_service),
            (self.timers, self.destroy_timer),
            (self.publishers, self.destroy_publisher),
        ):
            for entity in set(entities) - self._permanent_entities:
                # rclpy makes it when use_sim_time is set.
                if getattr(entity, "topic_name", "") != self.resolve_topic_name(CLOCK_TOPIC):
                    destroy(entity)


def _is_transition(transition: Transition, number: int, label: str) -> bool:
    """Whether a request is for a transition, which it names by its label, or else by its number."""
    return bool(transition.label == label if transition.label else transition.id == number)
