"""One joint's whole sample: state in, effort out."""

from __future__ import annotations

import math

from hpid_ros.control.damping_stop import DampingStop
from hpid_ros.control.following import Following
from hpid_ros.control.loop_state import LoopCounts, LoopState
from hpid_ros.control.motions import LARGEST_POSITION, Motion, Reference, Setpoint
from hpid_ros.control.pid import Terms
from hpid_ros.control.settings import LoopSettings
from hpid_ros.errors import SettingError

__all__ = ["JointLoop", "LoopCounts", "LoopState", "Motion", "Reference", "Setpoint"]

_SECONDS_PER_NANOSECOND = 1e-9
_LATE = 1.5  # control periods between two states: there was none in between
_OF_THE_VELOCITY = ("velocity_source", "velocity_filter_time_constant", "acceleration_bound")


class JointLoop:
    """The control of one joint, without ROS, files or clocks.

    Time enters with the stamps of the states alone: equal stamps are a repeat, which gets the
    last effort again; a stamp that goes back resets the loop; a time above ``state_timeout``
    is a gap, over which the derivative restarts and the integral is kept. Until it is told
    otherwise, a loop holds the position of its first state.

    Where the joint had no command of the loop for longer than ``state_timeout`` (:meth:`lapse`,
    states that cannot be used), the loop takes over anew: it starts from where the joint is,
    with the effort in force as its integral, and glides onto a motion that is under way.

    Args:
        settings: Checked settings.
    """

    def __init__(self, settings: LoopSettings) -> None:
        self.settings = settings
        self.counts = LoopCounts()
        self.last_fault = ""
        """What was last wrong with a state, in words."""
        self._following = Following()
        self._law = settings.make_law()
        self._anti_windup = settings.make_anti_windup()
        self._velocity = settings.make_velocity_source()
        self._limits = settings.make_motion_limits()
        self.reset()

    @property
    def state(self) -> LoopState:
        """What the loop is doing."""
        return LoopState.SILENT if self._has_lapsed else self._state

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
        return self._following.position, self._following.velocity

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
        return self._following.motion is not None

    @property
    def velocity(self) -> float:
        """The velocity that the last sample used, in [rad/s]."""
        return self._rate

    @property
    def braked(self) -> int:
        """Samples in which a soft stop or the velocity limit braked the joint."""
        return self._limits.braked if self._limits else 0

    def follow(self, motion: Motion) -> None:
        """Follow a motion from the next sample on; a reset starts it anew.

        Args:
            motion: A trajectory's column, or a :class:`Setpoint`.
        """
        self._following.follow(motion)

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
        limits = settings.make_motion_limits()
        if limits is not None and self._stamp_ns is not None:
            limits.take_over(self._limits, self._position)
        self._anti_windup, self._limits = settings.make_anti_windup(), limits
        self._law, self.settings = law, settings

    def reset(self) -> None:
        """Forget integral, velocity and time; start the motion anew with the next state."""
        self._law.reset()
        self._velocity.reset()
        self._following.restart()
        self._position = self._rate = self._error = 0.0
        self._stamp_ns: int | None = None
        self._usable_ns: int | None = None  # of the last state before those that were not
        self._is_takeover_due = self._has_lapsed = False
        self._effort = 0.0
        self._state = LoopState.WAITING

    def release(self) -> None:
        """Forget everything, the motion too: the next state is the first, and is held."""
        self._following.follow(None)
        self.reset()

    def lapse(self) -> float:
        """Note that no state has come for too long, and return the effort to give until one does.

        Only stamps tell whether time has passed for the joint, too: if the next state comes
        within ``state_timeout`` of the last one by its stamp, the robot's clock stood still (a
        simulation was paused) and the loop goes on as if nothing had been.

        Returns:
            ``fallback_effort``, within the effort limits, in [N m].
        """
        self._has_lapsed = True
        self.counts.silences += 1
        return self.settings.fallback

    def damping_stop(self, duration: float) -> DampingStop:
        """Return what damps the joint from now on in this loop's place.

        Args:
            duration: In [s], positive.
        """
        settings = self.settings
        return DampingStop(
            settings.gains,
            self._velocity,
            self._limits,
            (settings.u_clamp_min, settings.u_clamp_max),
            self._effort,
            self._stamp_ns or 0,
            duration,
        )

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
        if not (
            -LARGEST_POSITION <= position <= LARGEST_POSITION
            and (velocity is None or -LARGEST_POSITION <= velocity <= LARGEST_POSITION)
        ):
            self.last_fault = f"position {position} rad, velocity {velocity} rad/s"
            return self._reject(stamp_ns)
        dt = self._elapsed(stamp_ns)
        self._stamp_ns = stamp_ns
        self._position = position
        following = self._following
        if self._is_takeover_due or not following.is_standing:
            self._begin(stamp_ns, position)
        wanted = following.sample(stamp_ns, self.settings.takeover_time)
        if self._limits is not None:
            wanted = self._limits.reference(wanted[0], wanted[1])
        following.position, following.velocity = wanted[0], wanted[1]
        self._state = LoopState.HOLDING if following.motion is None else LoopState.FOLLOWING
        self._rate = rate = self._velocity.update(position, velocity, dt)
        self._error = error = wanted[0] - position
        return self._control(error, wanted[1] - rate, dt)

    def _elapsed(self, stamp_ns: int) -> float:
        """Return the time since the last state in [s]; 0 when there is none to count from."""
        if self._stamp_ns is None:
            return 0.0
        dt = (stamp_ns - self._stamp_ns) * _SECONDS_PER_NANOSECOND
        if dt < 0.0:
            self.counts.resets += 1
            self.last_fault = f"the stamp went back by {-dt:g} s"
            self.reset()
            return 0.0
        period = self.settings.control_period
        if dt > _LATE * period:
            self.counts.missed += round(dt / period) - 1
        is_gap = dt > self.settings.state_timeout
        if self._has_lapsed:
            self._is_takeover_due |= is_gap
            self._has_lapsed = False
        if is_gap:
            self.counts.gaps += 1
            self.last_fault = f"no state for {dt:g} s by the stamps"
            self._velocity.reset()
            return 0.0
        return dt

    def _begin(self, stamp_ns: int, position: float) -> None:
        """Start from where the joint is; in a takeover with the effort that is in force."""
        if self._limits is not None:
            self._limits.open(position)
        if not self._is_takeover_due or not self._following.is_standing:
            self._is_takeover_due = False
            self._following.stand(position)
            return
        self._is_takeover_due = False
        self.counts.takeovers += 1
        settings = self.settings
        self._effort = effort = settings.fallback
        self._law.reset()
        self._law.restore_integral(min(max(effort, settings.i_clamp_min), settings.i_clamp_max))
        self._velocity.reset()
        self._following.take_over(stamp_ns, position, settings.takeover_time)

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
            self.last_fault = f"the law gave {wanted} N m at an error of {error} rad"
            self._velocity.reset()
            return self._fault()
        if self._limits is None:
            effort = min(max(wanted, settings.u_clamp_min), settings.u_clamp_max)
        else:
            effort = self._limits.limit(wanted, self._position, self._rate, self._effort, dt)
        if effort != wanted:
            self.counts.saturated += 1
        integral = self._anti_windup(before, after, error, wanted, effort, dt)
        law.restore_integral(min(max(integral, settings.i_clamp_min), settings.i_clamp_max))
        self.counts.samples += 1
        self._usable_ns = None
        self._effort = effort
        return effort

    def _reject(self, stamp_ns: int) -> float:
        """Answer a state that cannot be used: no effort, and the derivative starts anew."""
        before = self._stamp_ns
        if before is not None and stamp_ns > before:
            self._stamp_ns = stamp_ns
            if self._usable_ns is None:
                self._usable_ns = before
            elapsed = (stamp_ns - self._usable_ns) * _SECONDS_PER_NANOSECOND
            self._is_takeover_due |= elapsed > self.settings.state_timeout
        self._velocity.reset()
        return self._fault()

    def _fault(self) -> float:
        self.counts.rejected += 1
        self._state = LoopState.FAULT
        self._effort = self.settings.fallback
        return self._effort
