"""One joint's whole sample: state in, effort out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from hpid_ros.control.pid import Terms
from hpid_ros.control.settings import LoopSettings
from hpid_ros.errors import SettingError

_SECONDS_PER_NANOSECOND = 1e-9
_LATE = 1.5  # control periods between two states: there was none in between
_OF_THE_VELOCITY = ("velocity_source", "velocity_filter_time_constant", "acceleration_bound")


class Reference(Protocol):
    """Where the joint should be, on the control clock."""

    def sample(self, stamp_ns: int) -> Sequence[float]:
        """Return position [rad], velocity [rad/s], acceleration [rad/s^2] at an instant [ns]."""


class Motion(Protocol):
    """What a loop can be told to do: it becomes a reference when the loop takes it over."""

    def start(self, now_ns: int, position: float, velocity: float) -> Reference:
        """Take over from where the reference stands, see ``trajectory.Column.start``."""


@dataclass(frozen=True)
class Setpoint:
    """Hold one position.

    Attributes:
        position: In [rad].
    """

    position: float

    def start(self, now_ns: int, position: float, velocity: float) -> Setpoint:
        """Return itself: a setpoint is the same at all times."""
        return self

    def sample(self, stamp_ns: int) -> tuple[float, float, float]:
        """Return the position at rest."""
        return self.position, 0.0, 0.0


class LoopState(Enum):
    """What a loop is doing."""

    WAITING = "waiting for the first state"
    HOLDING = "holding its position"
    FOLLOWING = "following a reference"
    FAULT = "the last state could not be used"


@dataclass
class LoopCounts:
    """What a loop has seen since it was made.

    Attributes:
        samples: States that were answered with a new effort.
        repeats: States with the stamp of the one before.
        resets: States older than the one before: the clock went back.
        gaps: States later than ``state_timeout`` after the one before.
        missed: States that must have been lost, by the stamps and ``control_period``.
        saturated: Samples whose effort was limited.
        rejected: States that were not finite, or made the law's effort so.
    """

    samples: int = 0
    repeats: int = 0
    resets: int = 0
    gaps: int = 0
    missed: int = 0
    saturated: int = 0
    rejected: int = 0


class JointLoop:
    """The control of one joint, without ROS, files or clocks.

    Time enters with the stamps of the states alone: equal stamps are a repeat, which gets the
    last effort again; a stamp that goes back resets the loop; a time above ``state_timeout``
    is a gap, over which the derivative restarts and the integral is kept. Until it is told
    otherwise, a loop holds the position of its first state.

    Args:
        settings: Checked settings.
    """

    def __init__(self, settings: LoopSettings) -> None:
        self.settings = settings
        self.counts = LoopCounts()
        self._motion: Motion | None = None
        self._pending: Motion | None = None
        self._reference: Reference | None = None
        self._stamp_ns: int | None = None
        self._law = settings.make_law()
        self._anti_windup = settings.make_anti_windup()
        self._velocity = settings.make_velocity_source()
        self.reset()

    @property
    def state(self) -> LoopState:
        """What the loop is doing."""
        return self._state

    @property
    def effort(self) -> float:
        """The effort of the last sample in [N m]."""
        return self._effort

    @property
    def terms(self) -> Terms:
        """The law's terms of the last sample in [N m], before the limits."""
        return self._law.terms

    @property
    def integral(self) -> float:
        """The integral term that the next sample uses, in [N m]."""
        return self._law.integral

    @property
    def reference(self) -> tuple[float, float]:
        """Reference position [rad] and velocity [rad/s] of the last sample."""
        return self._reference_position, self._reference_velocity

    @property
    def error(self) -> float:
        """Reference minus measured position of the last sample in [rad]."""
        return self._error

    @property
    def stamp_ns(self) -> int | None:
        """Stamp of the last state in [ns]; None before the first one."""
        return self._stamp_ns

    @property
    def has_motion(self) -> bool:
        """Whether the loop was told to follow anything."""
        return self._motion is not None

    @property
    def velocity(self) -> float:
        """The velocity that the last sample used, in [rad/s]."""
        return self._rate

    def follow(self, motion: Motion) -> None:
        """Follow a motion from the next sample on; a reset starts it anew.

        Args:
            motion: A trajectory's column, or a :class:`Setpoint`.
        """
        self._motion = self._pending = motion

    def retune(self, settings: LoopSettings) -> None:
        """Put other settings in force from the next sample on, as a whole.

        The integral term stays, so that the effort changes by no more than the laws differ at
        the same error.

        Args:
            settings: Checked settings of the same joint.

        Raises:
            SettingError: The settings are of another joint.
        """
        if settings.joint != self.settings.joint:
            raise SettingError(
                f"joint cannot change from {self.settings.joint!r} to {settings.joint!r} "
                f"while the loop runs"
            )
        law = settings.make_law()
        law.restore_integral(self._law.integral)
        before = self.settings
        if any(getattr(settings, name) != getattr(before, name) for name in _OF_THE_VELOCITY):
            self._velocity = settings.make_velocity_source()
        self._anti_windup = settings.make_anti_windup()
        self._law, self.settings = law, settings

    def reset(self) -> None:
        """Forget integral, velocity and time; start the motion anew with the next state."""
        self._law.reset()
        self._velocity.reset()
        self._pending = self._motion
        self._reference = None
        self._reference_position = self._reference_velocity = 0.0
        self._rate = self._error = 0.0
        self._stamp_ns = None
        self._effort = 0.0
        self._state = LoopState.WAITING

    def step(self, stamp_ns: int, position: float, velocity: float | None = None) -> float:
        """Take one state and return the effort that answers it.

        Args:
            stamp_ns: Stamp of the state on the control clock in [ns].
            position: Measured position in [rad].
            velocity: Measured velocity in [rad/s]; None when the robot reports none.

        Returns:
            The effort in [N m]: finite, within the limits, and zero when the state is not
            finite.
        """
        if stamp_ns == self._stamp_ns:
            self.counts.repeats += 1
            return self._effort
        if not math.isfinite(position) or not (velocity is None or math.isfinite(velocity)):
            return self._reject(stamp_ns)
        dt = self._elapsed(stamp_ns)
        self._stamp_ns = stamp_ns
        self._sample_reference(stamp_ns, position)
        self._rate = rate = self._velocity.update(position, velocity, dt)
        self._error = error = self._reference_position - position
        return self._control(error, self._reference_velocity - rate, dt)

    def _elapsed(self, stamp_ns: int) -> float:
        """Return the time since the last state in [s]; 0 when there is none to count from."""
        if self._stamp_ns is None:
            return 0.0
        dt = (stamp_ns - self._stamp_ns) * _SECONDS_PER_NANOSECOND
        if dt < 0.0:
            self.counts.resets += 1
            self.reset()
            return 0.0
        period = self.settings.control_period
        if dt > _LATE * period:
            self.counts.missed += round(dt / period) - 1
        if dt > self.settings.state_timeout:
            self.counts.gaps += 1
            self._velocity.reset()
            return 0.0
        return dt

    def _sample_reference(self, stamp_ns: int, position: float) -> None:
        if self._reference is None:
            self._reference = Setpoint(position)
            self._reference_position = position
            self._state = LoopState.HOLDING
        if self._pending is not None:
            self._reference = self._pending.start(
                stamp_ns, self._reference_position, self._reference_velocity
            )
            self._pending = None
        if self._motion is not None:
            self._state = LoopState.FOLLOWING
        elif self._state is LoopState.FAULT:
            self._state = LoopState.HOLDING
        sample = self._reference.sample(stamp_ns)
        self._reference_position = sample[0]
        self._reference_velocity = sample[1]

    def _control(self, error: float, error_rate: float, dt: float) -> float:
        """Apply law, limits and anti-windup."""
        law, settings = self._law, self.settings
        before = law.integral
        try:
            wanted = law.update(error, error_rate, dt)
        except OverflowError:  # a power of an absurd but finite error
            wanted = math.inf
        after = law.integral
        if not (math.isfinite(wanted) and math.isfinite(after)):
            law.restore_integral(before)
            return self._fault()
        effort = min(max(wanted, settings.u_clamp_min), settings.u_clamp_max)
        if effort != wanted:
            self.counts.saturated += 1
        integral = self._anti_windup(before, after, error, wanted, effort, dt)
        law.restore_integral(min(max(integral, settings.i_clamp_min), settings.i_clamp_max))
        self.counts.samples += 1
        self._effort = effort
        return effort

    def _reject(self, stamp_ns: int) -> float:
        """Answer a state that is not finite: no effort, and the derivative starts anew."""
        if self._stamp_ns is not None and stamp_ns > self._stamp_ns:
            self._stamp_ns = stamp_ns
        self._velocity.reset()
        return self._fault()

    def _fault(self) -> float:
        self.counts.rejected += 1
        self._state = LoopState.FAULT
        self._effort = min(max(0.0, self.settings.u_clamp_min), self.settings.u_clamp_max)
        return self._effort
