"""The goal that is followed: how far its joints are from it, and whether that may be so."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from hpid_ros.base.units import NANOSECONDS
from hpid_ros.goals.settings import GroupSettings
from hpid_ros.goals.tolerances import Tolerance, Tolerances
from hpid_ros.goals.trajectories import GroupTrajectory

Error = tuple[float, float]
"""Reference minus measurement: of the position in [rad] or [m], of the velocity per second."""


class Feedback(NamedTuple):
    """How a goal is doing, at the newest state."""

    stamp_ns: int  # [ns] of that state
    since_start_ns: int  # [ns] how long the goal has been under way
    # position, velocity and acceleration of each joint's reference
    desired: tuple[Sequence[float], ...]
    actual: tuple[tuple[float, float], ...]  # measured position and velocity of each joint
    error: tuple[Error, ...]  # their differences, reference minus measured


class ActiveGoal:
    """A goal under way."""

    def __init__(
        self,
        told: GroupTrajectory,
        tolerances: Tolerances,
        settings: GroupSettings,
        desired: list[Sequence[float]],
        errors: list[Error],
    ) -> None:
        self.start_ns, self.end_ns = told.stamp_ns, told.end_ns
        self.desired, self.errors = desired, errors
        self._names = told.names
        self._units = [facts.unit for facts in settings.facts]
        self._path = [tolerances.path[name] for name in told.names]
        self._goal = [tolerances.goal[name] for name in told.names]
        late_ns = round(tolerances.goal_time * NANOSECONDS)
        self._deadline_ns = self.end_ns + late_ns if late_ns else None
        self._has_ended = [False] * len(told.names)  # by each joint's own state
        self._astray_since_ns: list[int | None] = [None] * len(told.names)

    def compare(self, joint: int, stamp_ns: int, desired: Sequence[float], error: Error) -> str:
        """Take a joint's newest state.

        Args:
            joint: Its place in the group.
            stamp_ns: Of the state in [ns].
            desired: Position, velocity and acceleration of its reference.
            error: Of the joint.

        Returns:
            What of its path tolerance is violated, in words; nothing if it is within, and after
            the last point.
        """
        self.desired[joint], self.errors[joint] = desired, error
        self._has_ended[joint] = has_ended = stamp_ns >= self.end_ns
        return "" if has_ended else self._violation(self._path[joint], joint)

    @property
    def has_ended(self) -> bool:
        """Whether every joint has a state after the last point."""
        return all(self._has_ended)

    def unmet(self) -> dict[int, str]:
        """Return what of the goal's tolerances is violated, in words, by joint."""
        lines = {joint: self._violation(each, joint) for joint, each in enumerate(self._goal)}
        return {joint: line for joint, line in lines.items() if line}

    def is_late(self, now_ns: int) -> bool:
        """Tell whether the time has passed in which the tolerances had to be met."""
        return self._deadline_ns is not None and now_ns > self._deadline_ns

    def astray(self, joint: int, stamp_ns: int, is_off: bool) -> float:
        """Note whether a controller follows something else; return for how long it has, in [s]."""
        since_ns = self._astray_since_ns[joint]
        if not is_off:
            since_ns = None
        elif since_ns is None:
            since_ns = stamp_ns
        self._astray_since_ns[joint] = since_ns
        return 0.0 if since_ns is None else (stamp_ns - since_ns) / NANOSECONDS

    def when(self, now_ns: int, lines: Iterable[str]) -> str:
        """Return lines with how far the goal has come."""
        since, whole = now_ns - self.start_ns, self.end_ns - self.start_ns
        return f"{'; '.join(lines)}; at {since / NANOSECONDS:.3g} s of {whole / NANOSECONDS:.3g} s"

    def _violation(self, tolerance: Tolerance, joint: int) -> str:
        line = tolerance.violation(*self.errors[joint], self._units[joint])
        return f"{self._names[joint]} is {line}" if line else ""
