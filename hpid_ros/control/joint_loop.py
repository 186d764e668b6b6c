"""One joint's whole sample: state in, effort out."""

from __future__ import annotations

from hpid_ros.control.damping_stop import DampingStop
from hpid_ros.control.following import Following
from hpid_ros.control.limited_law import LimitedLaw
from hpid_ros.control.loop_clock import LoopClock
from hpid_ros.control.loop_state import LoopCounts, LoopState
from hpid_ros.control.loop_view import LoopView
from hpid_ros.control.model_term import ModelTerm
from hpid_ros.control.motions import LARGEST_POSITION, Motion, Reference, Setpoint
from hpid_ros.control.settings import LoopSettings
from hpid_ros.errors import SettingError

__all__ = ["JointLoop", "LoopCounts", "LoopState", "Motion", "Reference", "Setpoint"]


class JointLoop(LoopView):
    """The control of one joint, without ROS, files or clocks.

    Time enters with the stamps of the states alone: equal stamps are a repeat, which gets the
    last effort again; a stamp that goes back resets the loop; a time above ``state_timeout``
    is a gap, over which the derivative restarts and the integral is kept. A single stamp from
    the future, with one after it that continues those before, is such a gap and no more. Until
    it is told otherwise, a loop holds the position of its first state.

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
        self._law = LimitedLaw(settings, self.counts)
        self._velocity = settings.make_velocity_source()
        self._hears_velocity = settings.hears_velocity
        self._clock = LoopClock(self.counts)
        self.reset()

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
            settings: Checked settings of the same joint and the same compensation.

        Raises:
            SettingError: The settings are of another joint, or of another model.
        """
        before = self.settings
        if settings.joint != before.joint:
            raise SettingError(
                f"joint cannot change from {before.joint!r} to {settings.joint!r} "
                f"while the loop runs"
            )
        if settings.model != before.model:
            raise SettingError("compensation and its model cannot change while the loop runs")
        if settings.differs_in_velocity(before):
            self._velocity = settings.make_velocity_source()
            self._hears_velocity = settings.hears_velocity
        self._law.retune(settings, None if self.stamp_ns is None else self._position)
        self.settings = settings

    def reset(self) -> None:
        """Forget integral, velocity and time; start the motion anew with the next state."""
        self._law.reset()
        self._velocity.reset()
        self._following.restart()
        self._clock.restart()
        self._position = self._rate = self._error = 0.0
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
        self._clock.has_lapsed = True
        self.counts.silences += 1
        return self.settings.fallback

    def damping_stop(self, duration: float) -> DampingStop:
        """Return what damps the joint from now on in this loop's place.

        Args:
            duration: In [s], positive.
        """
        return self._law.damping_stop(self._velocity, self.stamp_ns, duration)

    def step(
        self,
        stamp_ns: int,
        position: float,
        velocity: float | None = None,
        model: ModelTerm | None = None,
    ) -> float:
        """Take one state and return the effort that answers it.

        Args:
            stamp_ns: Stamp of the state on the control clock in [ns].
            position: Measured position in [rad].
            velocity: Measured velocity in [rad/s]; None when the robot reports none. Not looked
                at where the velocity source is not ``measured``.
            model: What a model of the robot says of this state; None without a model.

        Returns:
            The effort in [N m]: finite, within the limits, and the fallback when the state is
            not finite.
        """
        clock, law = self._clock, self._law
        if stamp_ns == clock.stamp_ns:
            self.counts.repeats += 1
            return law.effort
        if not self._hears_velocity:
            velocity = None
        if not (
            -LARGEST_POSITION <= position <= LARGEST_POSITION
            and (velocity is None or -LARGEST_POSITION <= velocity <= LARGEST_POSITION)
        ):
            return self.reject(stamp_ns, f"position {position} rad, velocity {velocity} rad/s")
        dt = clock.elapse(stamp_ns, self.settings)
        if not 0.0 <= dt <= self.settings.state_timeout:
            dt = self._interrupt(stamp_ns, dt)
        self._position = position
        following = self._following
        is_takeover = False
        if clock.is_takeover_due or not following.is_standing:
            is_takeover = self._begin(stamp_ns, position)
        wanted, rate, acceleration = following.sample(stamp_ns, self.settings.takeover_time)
        if law.limits is not None:
            inside, rate = law.limits.reference(wanted, rate)
            if inside != wanted:
                wanted, acceleration = inside, 0.0  # at a stop the reference rests
        following.position, following.velocity = wanted, rate
        if is_takeover:
            law.take_over(self.settings.fallback, model, acceleration)
        self._state = LoopState.HOLDING if following.motion is None else LoopState.FOLLOWING
        self._rate = speed = self._velocity.update(position, velocity, dt)
        self._error = error = wanted - position
        try:
            effort = law.update(error, rate - speed, position, speed, dt, model, acceleration)
        except ArithmeticError as fault:
            self.last_fault = str(fault)
            self._velocity.reset()
            return self._fault()
        self.counts.samples += 1
        clock.unusable_since_ns = None
        return effort

    def reject(self, stamp_ns: int, reason: str) -> float:
        """Answer a state that cannot be used: no effort, and the derivative starts anew.

        Args:
            stamp_ns: Its stamp in [ns].
            reason: What is wrong with it, in words.

        Returns:
            ``fallback_effort``, within the effort limits, in [N m]; for a repeat the last effort.
        """
        if stamp_ns == self._clock.stamp_ns:
            self.counts.repeats += 1
            return self._law.effort
        self.last_fault = reason
        self._clock.skip(stamp_ns, self.settings)
        self._velocity.reset()
        return self._fault()

    def _interrupt(self, stamp_ns: int, dt: float) -> float:
        """Go on after a clock that went back, or after a gap: as if no time had passed."""
        if dt < 0.0:
            self.last_fault = f"the stamp went back by {-dt:g} s"
            self.reset()
            self._clock.stamp_ns = stamp_ns
        else:
            self.last_fault = f"no state for {dt:g} s by the stamps"
            self._velocity.reset()
        return 0.0

    def _begin(self, stamp_ns: int, position: float) -> bool:
        """Start from where the joint is, and tell whether that is a takeover."""
        if self._law.limits is not None:
            self._law.limits.open(position)
        is_takeover = self._clock.is_takeover_due and self._following.is_standing
        self._clock.is_takeover_due = False
        if is_takeover:
            self.counts.takeovers += 1
            self._velocity.reset()
            self._following.take_over(stamp_ns, position, self.settings.takeover_time)
        else:
            self._following.stand(position)
        return is_takeover

    def _fault(self) -> float:
        self.counts.rejected += 1
        self._state = LoopState.FAULT
        self._law.effort = self.settings.fallback
        return self._law.effort
