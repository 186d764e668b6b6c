"""What may be looked into while a joint loop runs."""

from __future__ import annotations

from hpid_ros.control.following import Following
from hpid_ros.control.limited_law import LimitedLaw
from hpid_ros.control.loop_clock import LoopClock
from hpid_ros.control.loop_state import LoopState
from hpid_ros.control.pid import Terms


class LoopView:
    """The readings of a joint loop."""

    _law: LimitedLaw
    _following: Following
    _clock: LoopClock
    _state: LoopState
    _rate: float
    _error: float

    @property
    def state(self) -> LoopState:
        """What the loop is doing."""
        return LoopState.SILENT if self._clock.has_lapsed else self._state

    @property
    def effort(self) -> float:
        """The effort of the last sample in [N m]."""
        return self._law.effort

    @property
    def terms(self) -> Terms:
        """The law's terms of the last sample in [N m], before the limits."""
        return self._law.terms

    @property
    def model_effort(self) -> float:
        """What a model added in the last sample, in [N m], before the limits; 0 without one."""
        return self._law.model_effort

    @property
    def integral(self) -> float:
        """The integral term that the next sample uses, in [N m]."""
        return self._law.integral

    @property
    def reference(self) -> tuple[float, float]:
        """Reference position [rad] and velocity [rad/s] of the last sample."""
        return self._following.position, self._following.velocity

    @property
    def error(self) -> float:
        """Reference minus measured position of the last sample in [rad]."""
        return self._error

    @property
    def stamp_ns(self) -> int | None:
        """Stamp of the last state in [ns]; None before the first one."""
        return self._clock.stamp_ns

    @property
    def has_motion(self) -> bool:
        """Whether the loop was told to follow anything."""
        return self._following.motion is not None

    @property
    def velocity(self) -> float:
        """The velocity that the last sample used, in [rad/s]."""
        return self._rate

    @property
    def braked(self) -> int:
        """Samples in which a soft stop or the velocity limit braked the joint."""
        limits = self._law.limits
        return limits.braked if limits else 0
