"""A managed node of ROS 2: others may bring it up, halt it and take it down, state by state; by itself it comes up.

docs/architecture.md says what the states mean. rclpy's part of it has three gaps that are filled here: an exception in
a transition is passed over in silence, a transition that the state does not have ends the process, and nothing that was
made for a state is destroyed with it.
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
from hmt_slam_ros.ros.diagnostics import STATE, Figures
from hmt_slam_ros.ros.parameters import ConfiguredNode

_AUTOSTART = ParameterDescriptor(
    description="Whether the node configures and activates itself; otherwise it waits for a lifecycle manager.",
    read_only=True,
)


class ManagedNode(LifecycleNodeMixin, ConfiguredNode):
    """A node with parameters, diagnostics and the services of its states; what it does in them is of subclasses.

    :ivar figures: what it counts, also while it is not configured.
    :ivar configured: whether it is inactive or active.
    :ivar active: whether it takes part.
    """

    def __init__(self, name: str, changeable: Iterable[str] = ()) -> None:
        """Declare the parameters; where one cannot be, the node is never configured.

        :param name: of the node.
        :param changeable: dotted names of the parameters that may change while the node runs.
        """
        self.configured = self.active = False
        self._fault: Exception | None = None
        self._misgiven: HmtSlamError | None = None
        try:
            ConfiguredNode.__init__(self, name, changeable)
            self.declare()
        except HmtSlamError as fault:
            self._misgiven = fault
        self._autostart = bool(self.declare_parameter("autostart", True, _AUTOSTART).value)
        self.figures = Figures(self)
        LifecycleNodeMixin.__init__(self)
        self._change_state = self._service_change_state.callback
        self._service_change_state.callback = self._answer_change
        self._own = set(self._entities())
        self._tell_state()

    def declare(self) -> None:
        """Declare the parameters that are not in the tree.

        :raises HmtSlamError: for a value that cannot be.
        """

    def set_up(self) -> None:
        """Make all that the node needs to take part.

        :raises HmtSlamError: where it cannot be; what was made by then is destroyed.
        """

    def take_part(self) -> None:
        """Begin, or go on after :meth:`stand_still`."""

    def stand_still(self) -> None:
        """Do nothing new, and lose nothing."""

    def check_clean_up(self) -> None:
        """See whether the node can be taken down and used on.

        :raises HmtSlamError: where that cannot be now.
        """

    def give_up(self) -> None:
        """Forget what :meth:`set_up` made; publishers, subscriptions, services and timers vanish by themselves."""

    def abandon(self) -> None:
        """Forget what :meth:`set_up` made before it failed."""
        self._destroy_made()

    def leave(self) -> None:
        """Do what is left to do when the node is shut down, and :meth:`take_down` at its end."""
        self.take_down()

    @property
    def first_states(self) -> tuple[bool, bool]:
        """Whether the node configures itself at its start, and activates itself."""
        return self._autostart, self._autostart

    def begin(self) -> None:
        """Enter the states in which the node starts.

        :raises HmtSlamError: where it cannot be configured.
        """
        if self._misgiven is not None and self._autostart:
            raise self._misgiven
        configure, activate = (False, False) if self._misgiven else self.first_states
        for wanted, trigger in ((configure, self.trigger_configure), (activate, self.trigger_activate)):
            if wanted:
                trigger()
                self._tell_state()
                if self._fault is not None:
                    raise self._fault

    def take_down(self) -> None:
        """Destroy all that was made since the node is there."""
        self.give_up()
        self.configured = self.active = False
        self._destroy_made()

    def on_configure(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """From unconfigured to inactive."""
        return self._outcome(self._configure)

    def on_activate(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """From inactive to active."""
        return self._outcome(self._activate)

    def on_deactivate(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """From active to inactive."""
        return self._outcome(self._deactivate)

    def on_cleanup(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """From inactive to unconfigured."""
        return self._outcome(self._clean_up)

    def on_shutdown(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """From any of them to finalized."""
        return self._outcome(self.leave if self.configured else lambda: None)

    def _configure(self) -> None:
        if self._misgiven is not None:
            raise self._misgiven
        self.figures.clear()
        try:
            self.set_up()
        except HmtSlamError:
            self.abandon()
            raise
        self.configured = True

    def _activate(self) -> None:
        self.active = True
        self.take_part()

    def _deactivate(self) -> None:
        self.active = False
        self.stand_still()

    def _clean_up(self) -> None:
        self.check_clean_up()
        self.take_down()

    def _outcome(self, change: Callable[[], None]) -> TransitionCallbackReturn:
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

    def _answer_change(self, request: ChangeState.Request, response: ChangeState.Response) -> ChangeState.Response:
        """Change the state as somebody asks; a transition that there is not is refused, and a defect ends the node."""
        self._fault = None
        try:
            self._change_state(request, response)
        except rclpy_implementation.RCLError:
            response.success = False  # rcl has told why
        self._tell_state()
        if isinstance(self._fault, HmtSlamError):
            self.figures.fail(str(self._fault))
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

    def _tell_state(self) -> None:
        self.figures.state[STATE] = self.state

    def _entities(self) -> Iterator[Any]:
        for there in (self.publishers, self.subscriptions, self.services, self.timers):
            yield from there

    def _destroy_made(self) -> None:
        for there, destroy in (
            (self.subscriptions, self.destroy_subscription),
            (self.services, self.destroy_service),
            (self.timers, self.destroy_timer),
            (self.publishers, self.destroy_publisher),
        ):
            for entity in set(there) - self._own:
                # Made by rclpy, maybe later, as use_sim_time is set.
                if getattr(entity, "topic_name", "") != CLOCK_TOPIC:
                    destroy(entity)
