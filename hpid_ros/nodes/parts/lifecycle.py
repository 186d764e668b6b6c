"""Managed nodes: their transitions, and how a controller leaves its joint."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.task import Future
from rclpy.timer import Timer

from hpid_ros.base.errors import ClaimError
from hpid_ros.base.records import Record, quantity
from hpid_ros.control.supervision import SupervisedLoop
from hpid_ros.nodes.core import executor
from hpid_ros.nodes.core.middleware import steady_timer, wait_until_acknowledged
from hpid_ros.nodes.core.parameters import read
from hpid_ros.nodes.core.rclpy_internals import destroy_lifecycle, lifecycle_state
from hpid_ros.nodes.parts.joint_topics import Commands


@dataclass(frozen=True)
class ManagedParameters(Record):
    """How a managed node starts."""

    autostart: bool = quantity("Configure and activate when the node starts", default=True)


class ManagedNode(LifecycleNode, executor.ClosingNode):
    """What a transition does is a method without arguments that may raise.

    A transition that raises leaves the node unconfigured, after :meth:`leave`; it never ends the
    process. One whose joint is another's fails, and the node stays as it was. Requests that the
    present state does not have are refused.
    """

    def __init__(self, name: str, **options: Any) -> None:
        executor.note_made(self)  # rclpy's LifecycleNode does not call the next constructor
        super().__init__(name, **options)
        self.is_active = False
        self._failure: Exception | None = None
        self._autostart = read(self, ManagedParameters).autostart
        self.is_starting = self._autostart
        self.guard(self.refuse)

    def start(self) -> None:
        """Configure and activate, unless ``autostart`` is false."""
        if not self._autostart:
            return
        for trigger in (self.trigger_configure, self.trigger_activate):
            trigger()
            if self._failure is not None:
                raise self._failure

    def prepare(self) -> None:
        """Configure: make what is needed to become active."""

    def begin(self) -> None:
        """Activate."""

    def leave(self) -> None:
        """Deactivate; also what is done first when an active node is shut down."""

    def dispose(self) -> None:
        """Undo :meth:`prepare`."""

    def refuse(self, line: str) -> None:
        """Take note of something that was refused, in one line."""

    @property
    def lifecycle(self) -> str:
        """The state's name: ``unconfigured``, ``inactive``, ``active`` or ``finalized``."""
        return lifecycle_state(self)

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._do(self.prepare)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.is_active = True
        return self._do(self.begin)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._do(self._leave)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._do(self.dispose)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Leave if the node is active; the process goes on, its node finalized."""
        return self._do(self._leave, self.dispose)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Become unconfigured after a transition that raised."""
        return self._do(self._leave, self.dispose)

    def destroy_node(self) -> None:
        """Destroy the node and its state machine, which would keep it on the graph."""
        super().destroy_node()
        destroy_lifecycle(self)

    def _leave(self) -> None:
        if self.is_active:
            self.is_active = False
            self.leave()

    def _do(self, *steps: Callable[[], None]) -> TransitionCallbackReturn:
        try:
            for step in steps:
                step()
        except ClaimError as error:
            self._failure = error
            self.is_active = False
            if not self.is_starting:
                self.refuse(f"transition failed: {error}")
            return TransitionCallbackReturn.FAILURE
        except Exception as error:  # rclpy would drop it without a word
            self._failure = error
            self.refuse(f"transition failed: {type(error).__name__}: {error}")
            return TransitionCallbackReturn.ERROR
        self._failure = None
        return TransitionCallbackReturn.SUCCESS


_LONGEST = 4.0  # [s]; launch kills what has not ended 5 s after it was asked to


@dataclass(frozen=True)
class StopParameters(Record):
    """How a joint is left."""

    stop: Literal["zero", "damping"] = quantity(
        "How the joint is left: zero, damping for stop_duration", default="zero"
    )
    stop_duration: float = quantity(
        "Duration of the damping stop",
        "s",
        default=0.5,
        least=0.0,
        most=_LONGEST,
    )


class ControllerStop:
    """Gives a last command of zero effort, after a damping ramp if one is wished."""

    def __init__(
        self, node: Node, joint: SupervisedLoop, commands: Commands, finish: Callable[[], None]
    ) -> None:
        given = read(node, StopParameters)
        self._duration = given.stop_duration if given.stop == "damping" else 0.0
        self._node, self._joint, self._commands, self._finish = node, joint, commands, finish
        self._timer: Timer | None = None
        self._ended: Future | None = None
        self._is_unacknowledged = False

    @property
    def is_damping(self) -> bool:
        return self._timer is not None

    def begin(self) -> None:
        """Leave the joint, at once or with a ramp."""
        if not self._joint.damp(self._duration):
            self.now()
            return
        self._ended = Future()
        self._timer = steady_timer(self._node, self._duration, self.now)

    def ended(self) -> Future | None:
        """Return what is done when the ramp is; None if there is none."""
        return self._ended if self.is_damping else None

    def end(self) -> None:
        """Cut the ramp short, if there is one: the effort is zero from here on."""
        if self.is_damping:
            self.now()

    def now(self) -> None:
        """Give zero effort; the joint has been left."""
        if self._timer is not None:
            self._timer.cancel()
            self._node.destroy_timer(self._timer)
            self._timer = None
        self._is_unacknowledged |= self._commands.leave()
        self._finish()
        if self._ended is not None and not self._ended.done():
            self._ended.set_result(None)

    def wait_until_acknowledged(self) -> None:
        """Wait until every reliable subscriber has acknowledged the last zero, for a while."""
        if self._is_unacknowledged:
            self._is_unacknowledged = False
            what = "the last command, of zero effort,"
            wait_until_acknowledged(self._node, self._commands.publisher, what)
