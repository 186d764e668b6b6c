"""A managed node (REP 2007, the lifecycle of ROS 2) that starts by itself if it may."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from hpid_ros.base.errors import ClaimError
from hpid_ros.nodes.ros import executor
from hpid_ros.nodes.ros.parameters import read_only
from hpid_ros.nodes.ros.rclpy_internals import destroy_lifecycle, lifecycle_state


class ManagedNode(LifecycleNode, executor.ClosingNode):
    """What a transition does is a method without arguments that may raise.

    A transition that raises leaves the node unconfigured, after :meth:`leave`; it never ends the
    process. One whose joint is another's fails, and the node stays as it was. Requests that the
    present state does not have are refused.
    """

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        self.is_active = False
        self._failure: Exception | None = None
        self._autostart = bool(
            read_only(self, "autostart", True, "Configure and activate when the node starts")
        )
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
        """Configure."""
        return self._do(self.prepare)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Activate."""
        self.is_active = True
        return self._do(self.begin)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Deactivate."""
        return self._do(self._leave)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Clean up."""
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
