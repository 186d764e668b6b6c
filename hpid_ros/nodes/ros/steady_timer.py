"""Timers that no change of the system's clock, and no simulated one, stops or hurries."""

from __future__ import annotations

from collections.abc import Callable
from weakref import WeakKeyDictionary

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.timer import Timer

_CLOCKS: WeakKeyDictionary[Node, Clock] = WeakKeyDictionary()


def steady_timer(node: Node, period: float, callback: Callable[[], object]) -> Timer:
    """Return a running timer on the steady clock.

    A node's own timers follow its ROS clock: they wait when somebody sets the time back, and
    with ``use_sim_time`` while the simulation stands still.
    """
    # The executor has a thread for each clock, and warns from eight timers of one clock on, which
    # the controllers of a few joints have together: so there is one for each node.
    clock = _CLOCKS.setdefault(node, Clock(clock_type=ClockType.STEADY_TIME))
    return node.create_timer(period, callback, clock=clock)
