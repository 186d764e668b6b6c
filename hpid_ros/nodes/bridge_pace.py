"""The bridge's parameters of time: how the states are paced, who is waited for, when it ends."""

from __future__ import annotations

from dataclasses import dataclass

from rclpy.node import Node

from hpid_ros.errors import SettingError
from hpid_ros.nodes.parameters import read_number, read_only

MODES = ("lockstep", "realtime")

_RESTART_TAKES = 0.2  # [s], at least: nobody waits for the place of one that was killed
_POSITIVE = (1e-6, 1e6)
_NANOSECONDS = 1_000_000_000


@dataclass(frozen=True)
class Pace:
    """When a state is published.

    Attributes:
        is_lockstep: Every state waits for its answers; otherwise the wall clock paces them.
        end_ns: Stamp of the last state in [ns]; None runs for ever.
        exits: Whether the process ends after the last state.
        real_time_factor: Simulated time per wall time in realtime.
        answer_timeout: Wall time that lockstep waits for one answer in [s].
        command_timeout_ns: Simulated time for which a command stands in realtime in [ns].
        subscribers: Subscribers that the states must have before the first one.
        publishers: Publishers that the commands must have before the first state.
    """

    is_lockstep: bool
    end_ns: int | None
    exits: bool
    real_time_factor: float
    answer_timeout: float
    command_timeout_ns: int
    subscribers: int
    publishers: int

    @property
    def command_patience(self) -> float:
        """Silence of a joint's publisher after which another one may command it, in [s]."""
        if self.is_lockstep:
            return min(self.answer_timeout, _RESTART_TAKES)
        return self.command_timeout_ns / _NANOSECONDS / self.real_time_factor


def read_pace(node: Node, joints: int) -> Pace:
    """Declare the parameters of time and return what they say.

    Args:
        node: The bridge.
        joints: Number of driven joints; lockstep waits for as many controllers.

    Raises:
        SettingError: A value is out of range.
    """
    mode = read_only(node, "mode", "lockstep", f"Pace of the states: {', '.join(MODES)}")
    if mode not in MODES:
        raise SettingError(f"mode must be one of {', '.join(MODES)}, not {mode!r}")
    everyone = joints if mode == "lockstep" else 0

    def positive(name: str, default: float, description: str) -> float:
        return read_number(node, name, default, description, _POSITIVE)

    duration = read_number(
        node, "duration", 0.0, "Stamp of the last state [s]; 0 runs for ever", (0.0, 1e9)
    )
    timeout = positive(
        "command_timeout", 0.1, "Simulated time for which a command stands in realtime [s]"
    )
    return Pace(
        is_lockstep=mode == "lockstep",
        end_ns=round(duration * _NANOSECONDS) if duration > 0.0 else None,
        exits=read_only(node, "exit_when_done", True, "End the process after the last state"),
        real_time_factor=positive(
            "real_time_factor", 1.0, "Simulated time per wall time in realtime"
        ),
        answer_timeout=positive(
            "answer_timeout", 2.0, "Wall time that lockstep waits for one answer [s]"
        ),
        command_timeout_ns=round(timeout * _NANOSECONDS),
        subscribers=read_only(
            node, "wait_for_subscribers", everyone, "Subscribers that states must have first"
        ),
        publishers=read_only(
            node, "wait_for_publishers", everyone, "Publishers that commands must have first"
        ),
    )
