"""The damping stop: a joint is let go of gently, its motion damped, and the damping fades."""

from __future__ import annotations

from hpid_ros.base.units import SECONDS_PER_NANOSECOND
from hpid_ros.control.estimation.velocity import VelocitySource
from hpid_ros.control.limits import MotionLimits
from hpid_ros.control.reference import LARGEST_POSITION


class DampingStop:
    """Answers states with ``-damping velocity``, fading to nothing over a duration."""

    def __init__(
        self,
        damping: float,
        velocity: VelocitySource,
        hears_velocity: bool,
        limits: MotionLimits | None,
        clamp: tuple[float, float],
        effort: float,
        stamp_ns: int,
        duration: float,
    ) -> None:
        self._damping, self._velocity, self._limits = damping, velocity, limits
        self._hears_velocity = hears_velocity
        self._clamp = clamp
        self._effort = effort
        self._begin_ns = self._stamp_ns = stamp_ns
        self._duration = duration

    def step(self, stamp_ns: int, position: float, velocity: float | None = None) -> float:
        """Take one state and return the effort that answers it in [N m]; see ``JointLoop.step``.

        A state that cannot be used, or that is not later than the last one, gets none.
        """
        if not self._hears_velocity:
            velocity = None
        dt = (stamp_ns - self._stamp_ns) * SECONDS_PER_NANOSECOND
        numbers = (position, 0.0 if velocity is None else velocity)
        if dt <= 0.0 or not all(-LARGEST_POSITION <= each <= LARGEST_POSITION for each in numbers):
            self._effort = 0.0
            return 0.0
        self._stamp_ns = stamp_ns
        rate = self._velocity.update(position, velocity, dt)
        passed = (stamp_ns - self._begin_ns) * SECONDS_PER_NANOSECOND / self._duration
        wanted = -self._damping * rate * max(0.0, 1.0 - passed)
        if self._limits is None:
            effort = min(max(wanted, self._clamp[0]), self._clamp[1])
        else:
            effort = self._limits.limit(wanted, position, rate, self._effort, dt)
        self._effort = effort if passed < 1.0 else 0.0
        return self._effort
