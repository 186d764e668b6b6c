"""The end of a controller at its joint: at once, or with a damping stop."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.task import Future
from rclpy.timer import Timer

from hpid_ros.control.interludes.supervision import SupervisedLoop
from hpid_ros.nodes.parts.controller.commands import Commands
from hpid_ros.nodes.ros.parameters import read_choice, read_number
from hpid_ros.nodes.ros.steady_timer import steady_timer

STOPS = ("zero", "damping")

_LAST_COMMAND_WITHIN = Duration(seconds=0.5)
_LONGEST = 4.0  # [s]; launch kills what has not ended 5 s after it was asked to


class ControllerStop:
    """Gives a last command of zero effort, after a damping ramp if one is wished."""

    def __init__(
        self, node: Node, joint: SupervisedLoop, commands: Commands, finish: Callable[[], None]
    ) -> None:
        text = f"How the joint is left: {', '.join(STOPS)} for stop_duration"
        kind = read_choice(node, "stop", "zero", text, STOPS)
        duration = read_number(
            node, "stop_duration", 0.5, "Of the damping stop [s]", (0.0, _LONGEST)
        )
        self._duration = duration if kind == "damping" else 0.0
        self._node, self._joint, self._commands, self._finish = node, joint, commands, finish
        self._timer: Timer | None = None
        self._ended: Future | None = None
        self._stamp_ns: int | None = None
        self._is_unheard = False

    @property
    def is_damping(self) -> bool:
        """Whether the ramp is on."""
        return self._timer is not None

    def begin(self) -> None:
        """Leave the joint, at once or with a ramp."""
        self._stamp_ns = self._joint.loop.stamp_ns
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
        stamp_ns = self._joint.loop.stamp_ns if self._stamp_ns is None else self._stamp_ns
        self._stamp_ns = None
        if stamp_ns is not None:
            self._commands.leave(stamp_ns)
            self._is_unheard = True
        self._finish()
        if self._ended is not None and not self._ended.done():
            self._ended.set_result(None)

    def wait_until_heard(self) -> None:
        """Wait until every reliable subscriber has acknowledged the last zero, for a while."""
        if not self._is_unheard:
            return
        self._is_unheard = False
        if not self._commands.publisher.wait_for_all_acked(_LAST_COMMAND_WITHIN):
            self._node.get_logger().warning(
                "the last command, of zero effort, was not acknowledged by every subscriber "
                f"within {_LAST_COMMAND_WITHIN.nanoseconds * 1e-9:g} s"
            )
