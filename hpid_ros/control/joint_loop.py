"""One joint's loop: which states count, takeover, and the effort that answers a state."""

from __future__ import annotations

import math
from copy import copy
from typing import NamedTuple

from hpid_ros.base.errors import SettingError
from hpid_ros.base.units import SECONDS_PER_NANOSECOND
from hpid_ros.control.assembly import (
    feedforward_figures,
    largest_step,
    make_unwrapper,
    turn_of_references,
)
from hpid_ros.control.estimation import Estimation
from hpid_ros.control.homogeneous_pid import Terms
from hpid_ros.control.limited_law import LimitedLaw, LoopClock, LoopCounts, LoopState, ModelTerm
from hpid_ros.control.overrides import DampingStop, Relay, RelayRequest, reason_against
from hpid_ros.control.reference import LARGEST_POSITION, Feedforward, Following, Motion
from hpid_ros.control.settings import LoopSettings
from hpid_ros.control.velocity import VelocitySource


class Tracked(NamedTuple):
    """What tracking was at some time; see :meth:`Tracking.kept`."""

    settings: LoopSettings
    following: Following
    feedforward: Feedforward
    velocity: VelocitySource
    integral: float


class Tracking:
    """A joint's reference, its estimated motion, and what feedforward and law make of both.

    It is told of states that count alone, and how much time there was between two of them; which
    these are is for :class:`~hpid_ros.control.joint_loop.JointLoop`.
    """

    __slots__ = (
        *("_settings", "_takeover_time"),
        *("error", "estimation", "feedforward", "following", "law", "relay"),
    )

    def __init__(self, settings: LoopSettings, counts: LoopCounts) -> None:
        self.relay: Relay | None = None
        self.following = Following()
        self.law = LimitedLaw(settings, counts)
        self.estimation = Estimation(settings, self.law)
        self.feedforward = Feedforward(feedforward_figures(settings))
        self.error = 0.0
        self._adopt(settings)

    def _adopt(self, settings: LoopSettings) -> None:
        """Take from settings what is looked at in each sample."""
        self._settings, self._takeover_time = settings, settings.timing.takeover_time
        self.following.turn = turn_of_references(settings)
        self.following.lost_turn = max(settings.encoder.wrap, 0.0)

    def reset(self) -> None:
        """Forget integral and velocity; start the motion anew with the next state."""
        self.law.reset()
        self.estimation.reset()
        self.feedforward.reset()
        self.following.restart()
        self.error = 0.0

    def follow(self, motion: Motion) -> None:
        """Follow a motion from the next sample on."""
        self.end_relay("a reference came")
        self.following.follow(motion)

    def retune(self, settings: LoopSettings, position: float | None, stamp_ns: int) -> None:
        """Go by other settings; the integral term stays, and what is estimated is carried over."""
        self.end_relay("parameters were set")
        self.estimation.retune(settings, position)
        self.law.retune(
            settings, None if position is None else (position, self.estimation.velocity)
        )
        self.estimation.feed_anew()
        change = self.feedforward.retune(
            feedforward_figures(settings), self.following.velocity, self.following.acceleration
        )
        self._adopt(settings)
        if change:
            self._hand_over(change, stamp_ns)

    def begin(self, stamp_ns: int, position: float, *, is_takeover: bool) -> None:
        """Start from where the joint is, before its sample."""
        if self.law.limits is not None:
            self.law.limits.open(position)
        if not is_takeover:
            self.following.stand(position)
            return
        if self.law.relay is not None:
            self.drop_relay("the joint was taken over anew")
            self.law.give(self.law.effort)  # what the relay gave is in no term
        self.estimation.restart()
        self.following.take_over(stamp_ns, position, self._takeover_time)

    def update(
        self,
        stamp_ns: int,
        position: float,
        velocity: float | None,
        dt: float,
        elapsed: float,
        model: ModelTerm | None,
        is_takeover: bool,
    ) -> float:
        """Take one sample and return its effort in [N m], within the limits."""
        law, following, estimation = self.law, self.following, self.estimation
        model = estimation.update(position, velocity, dt, model)
        speed = estimation.velocity
        wanted, rate, acceleration = following.sample(stamp_ns, self._takeover_time, law.limits)
        if rate and law.relay is not None:
            law.relay.end("the reference moves")
        ahead = 0.0
        if self.feedforward.is_active or following.gives_effort:
            ahead = self._feed_forward(stamp_ns, is_takeover=is_takeover)
        if is_takeover:
            law.take_over(model, acceleration, ahead, is_still_damped=dt > 0.0)
        self.error = error = wanted - estimation.position
        try:
            return law.update(
                error, rate - speed, position, speed, elapsed, model, acceleration, ahead
            )
        except ArithmeticError:
            estimation.restart()
            raise

    def _feed_forward(self, stamp_ns: int, *, is_takeover: bool) -> float:
        """Return the effort that the reference of this sample needs, in [N m]."""
        forward, following = self.feedforward, self.following
        planned = following.effort(stamp_ns)
        if is_takeover:
            forward.reset()
        elif following.has_turned:
            self._hand_over(forward.change_by(planned), stamp_ns)
        following.has_turned = False
        return forward.update(stamp_ns, following.velocity, following.acceleration, planned)

    def _hand_over(self, change: float, stamp_ns: int) -> None:
        """Let the effort stay what it is although what is fed forward changes, in [N m]."""
        left = self.law.give_up(change)
        if left:
            self.feedforward.keep(-left, stamp_ns, self._takeover_time)

    def begin_relay(self, request: RelayRequest, against: str) -> None:
        """Let a relay drive the joint for some cycles, around where it is held."""
        law, gains = self.law, self._settings.gains
        if law.relay is not None:
            against = "there is one already"
        elif not against and (self.following.velocity or self.following.acceleration):
            against = "the reference moves"
        against = against or reason_against(
            request, gains, self._settings.effort, law.integral + law.model_effort, self.error
        )
        if against:
            raise SettingError(f"no relay now: {against}")
        self.relay = law.relay = Relay(request, gains.d / gains.p)

    def end_relay(self, reason: str) -> None:
        """Let a relay give back, if there is one."""
        if self.law.relay is not None:
            self.law.relay.end(reason)

    def drop_relay(self, reason: str) -> None:
        """End a relay at once, without another effort: who calls decides about that."""
        self.end_relay(reason)
        self.law.relay = None

    def kept(self) -> Tracked:
        """Return what :meth:`go_back_to` needs."""
        return Tracked(
            self._settings,
            copy(self.following),
            copy(self.feedforward),
            self.estimation.copy_of_source(),
            self.law.own_integral,
        )

    def go_back_to(self, before: Tracked) -> None:
        """Be what it was, but for what it was told since."""
        told = self.following.motion
        self.following = before.following
        if told is not before.following.motion:
            self.following.follow(told)
        if self._settings is before.settings:  # else the source is another, or of other figures
            self.estimation.put_back(before.velocity)
            self.feedforward = before.feedforward
        self.law.restore_integral(before.integral)


class _BeforeJump(NamedTuple):
    """What a loop was before a stamp that may be wrong."""

    stamp_ns: int
    takeovers: int
    tracked: Tracked


class JointLoop:
    """The control of one joint, without ROS, files or clocks.

    Time enters with the stamps of the states alone: equal stamps are a repeat, which gets the
    effort in force again; a stamp that goes back resets the loop. Until it is told otherwise, a
    loop holds the position of its first state.

    Where the joint was without a command of the loop for longer than ``state_timeout`` (a gap
    between the stamps, :meth:`lapse`, states that cannot be used), and where its position
    jumped, the loop takes over anew: it starts from where the joint is, with the effort in force
    as its integral (after a jump without its derivative term), and glides onto a motion that is
    under way. A single stamp from the future, with one after it that continues those before,
    leaves nothing behind.

    Args:
        settings: Checked settings.
    """

    def __init__(self, settings: LoopSettings) -> None:
        self.settings = settings
        self.counts = LoopCounts()
        self.last_fault = ""
        """What was last wrong with a state, in words."""
        self._tracking = Tracking(settings, self.counts)
        self._unwrapper = make_unwrapper(settings.encoder)
        self._clock = LoopClock(self.counts)
        self._adopt(settings)
        self.reset()

    def _adopt(self, settings: LoopSettings) -> None:
        """Take from settings what is looked at in each sample."""
        self._timing = settings.timing
        self._hears_velocity = settings.velocity.is_measured
        self._step_max, self._speed_max = largest_step(settings)

    def follow(self, motion: Motion) -> None:
        """Follow a motion from the next sample on; a reset starts it anew.

        Args:
            motion: A trajectory's column, or a :class:`Setpoint`.
        """
        self._tracking.follow(motion)

    def begin_relay(self, request: RelayRequest) -> None:
        """Let a relay drive the joint for some cycles, around where it is held.

        It gives back by itself; also when a reference or parameters come, and at once when the
        joint is taken over anew, or a state cannot be used.

        Args:
            request: What it shall do.

        Raises:
            SettingError: The joint is not held at rest, is too near to its effort limits, or the
                law has nothing to hold it by.
        """
        is_held = self.state in (LoopState.HOLDING, LoopState.FOLLOWING)
        is_driven = is_held and not self._is_takeover_due
        self._tracking.begin_relay(request, "" if is_driven else str(self.state.value))

    def end_relay(self, reason: str) -> None:
        """Let a relay give back, if there is one.

        Args:
            reason: Why, in words.
        """
        self._tracking.end_relay(reason)

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
        is_new = self._clock.stamp_ns is None
        position = None if is_new else self._position
        self._tracking.retune(settings, position, self._clock.stamp_ns or 0)
        if settings.encoder.wrap != before.encoder.wrap:
            if self._unwrapper is None:
                self._unwrapper = make_unwrapper(settings.encoder)
            else:
                self._unwrapper.begin_anew_after(max(settings.encoder.wrap, 0.0) or math.inf)
        self.settings = settings
        self._adopt(settings)
        if self.is_on_fallback:
            self._tracking.law.give(settings.effort.fallback)

    def reset(self) -> None:
        """Forget integral, velocity and time; start the motion anew with the next state."""
        self._tracking.drop_relay("the loop began anew")
        self._tracking.reset()
        if self._unwrapper is not None:
            self._unwrapper.reset()
        self._clock.restart()
        self._position = 0.0
        self._state = LoopState.WAITING
        self._is_takeover_due = False
        self._before_jump: _BeforeJump | None = None
        self._astray: tuple[int, float] | None = None

    def release(self) -> None:
        """Forget everything, the motion too: the next state is the first, and is held."""
        self._tracking.following.follow(None)
        self.reset()

    def lapse(self) -> float:
        """Note that no state has come for too long, and return the effort to give until one does.

        The next state is a takeover. Only where ``state_clock`` is ``simulated`` do the stamps
        alone tell whether time has passed for the joint, too: if that state comes within
        ``state_timeout`` of the last one by its stamp, the simulation was paused, and the loop
        goes on as if nothing had been.

        Returns:
            ``fallback_effort``, within the effort limits, in [N m].
        """
        self._clock.lapse()
        self._tracking.drop_relay("no state came")
        self.counts.silences += 1
        if not self._timing.is_simulated:
            self.supersede(self.settings.effort.fallback)
        return self.settings.effort.fallback

    def wake(self) -> None:
        """Note that states have stayed away for too long, and nobody has given another effort.

        As after :meth:`lapse` the next state is a takeover, but from the effort in force.
        """
        self.counts.silences += 1
        self._tracking.drop_relay("no state came")
        if not self._timing.is_simulated:
            self.supersede(self._tracking.law.effort)

    def supersede(self, effort: float) -> None:
        """Note that the joint was given another effort: the next state is a takeover from it.

        Args:
            effort: In [N m].
        """
        self._tracking.drop_relay("the joint was given another effort")
        self._is_takeover_due = True
        self._tracking.law.give(effort)

    @property
    def relay(self) -> Relay | None:
        """The last relay that there was, for what became of it."""
        return self._tracking.relay

    @property
    def is_on_fallback(self) -> bool:
        """Whether the effort in force is ``fallback_effort``, for want of a usable state."""
        if self._clock.has_lapsed:
            return not self._timing.is_simulated
        return self._state is LoopState.FAULT

    @property
    def velocity_origin(self) -> str:
        """Where the velocity of the last sample came from, in words."""
        return self._tracking.estimation.origin

    @property
    def velocity_doubt(self) -> str:
        """What speaks against the velocities of the states, in words; empty if nothing does."""
        return self._tracking.estimation.doubt

    @property
    def estimate(self) -> tuple[float, float, float] | None:
        """Position [rad], velocity [rad/s] and disturbing effort [N m] by the observer, if any."""
        return self._tracking.estimation.disturbed

    def damping_stop(self, duration: float) -> DampingStop:
        """Return what damps the joint from now on in this loop's place.

        Args:
            duration: In [s], positive.
        """
        velocity = self._tracking.estimation.source_of_stop(self._position)
        return self._tracking.law.damping_stop(
            velocity, self._hears_velocity, self.stamp_ns, duration
        )

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
        clock, tracking, timing = self._clock, self._tracking, self._timing
        before_ns = clock.stamp_ns
        if stamp_ns == before_ns or stamp_ns == clock.unusable_ns:
            self.counts.repeats += 1
            return tracking.law.effort
        if not self._hears_velocity:
            velocity = None
        if not (
            -LARGEST_POSITION <= position <= LARGEST_POSITION
            and (velocity is None or -LARGEST_POSITION <= velocity <= LARGEST_POSITION)
        ):
            reason = f"position {position} rad, velocity {velocity} rad/s"
            if -LARGEST_POSITION <= position <= LARGEST_POSITION:
                reason += "; velocity_source filtered does without velocities"
            return self.reject(stamp_ns, reason)
        if self._before_jump is not None:
            before_ns = self._settle_jump(stamp_ns)
        since = 0.0 if before_ns is None else (stamp_ns - before_ns) * SECONDS_PER_NANOSECOND
        is_next = 0.0 < since <= timing.state_timeout
        if not is_next:
            self._interrupt(since)
        if self._unwrapper is not None:
            position = self._unwrapper.update(position)
            if not -LARGEST_POSITION <= position <= LARGEST_POSITION:
                return self.reject(stamp_ns, f"position {position} rad with its turns")
        allowed = self._step_max + self._speed_max * since
        if is_next and abs(position - self._position) > allowed:
            held = self._doubt(stamp_ns, position, since)
            if held is not None:
                return held
        elapsed = dt = since if is_next else 0.0
        if clock.unusable_ns is not None:
            self._astray = None
            elapsed = min(dt, timing.control_period)  # what was not seen is not integrated
        self._position = position
        is_takeover = False
        if self._is_takeover_due or not tracking.following.is_standing:
            is_takeover = self._begin(stamp_ns, position)
        try:
            effort = tracking.update(stamp_ns, position, velocity, dt, elapsed, model, is_takeover)
        except ArithmeticError as fault:
            self.last_fault = str(fault)
            self._skip(stamp_ns)
            return self._fault()
        is_holding = tracking.following.motion is None
        self._state = LoopState.HOLDING if is_holding else LoopState.FOLLOWING
        clock.take(stamp_ns, since, timing)
        self.counts.samples += 1
        return effort

    def reject(self, stamp_ns: int, reason: str) -> float:
        """Answer a state that cannot be used.

        Args:
            stamp_ns: Its stamp in [ns].
            reason: What is wrong with it, in words.

        Returns:
            ``fallback_effort``, within the effort limits, in [N m]; for a repeat the effort in
            force.
        """
        clock = self._clock
        if stamp_ns in (clock.stamp_ns, clock.unusable_ns):
            self.counts.repeats += 1
            return self._tracking.law.effort
        self.last_fault = reason
        self._skip(stamp_ns)
        return self._fault()

    def _skip(self, stamp_ns: int) -> None:
        """Pass over a state that cannot be used; the observer goes on under the effort sent."""
        clock = self._clock
        if clock.stamp_ns is not None:
            last_ns = clock.stamp_ns if clock.unusable_ns is None else clock.unusable_ns
            since = (stamp_ns - last_ns) * SECONDS_PER_NANOSECOND
            if 0.0 < since <= self._timing.state_timeout:
                self._tracking.estimation.coast(since)
        clock.skip(stamp_ns)

    def _fault(self) -> float:
        self._tracking.drop_relay("a state could not be used")
        self.counts.rejected += 1
        self._state = LoopState.FAULT
        self._tracking.law.give(self.settings.effort.fallback)
        return self._tracking.law.effort

    def _interrupt(self, dt: float) -> None:
        """Begin, begin anew after a clock that went back, or be without time after a gap."""
        if dt < 0.0:
            self.last_fault = f"the stamp went back by {-dt:g} s"
            self.counts.resets += 1
            self.reset()
        elif dt > 0.0:
            self.last_fault = f"no usable state for {dt:g} s by the stamps"
            last_ns = self._clock.stamp_ns
            assert last_ns is not None
            self._before_jump = _BeforeJump(last_ns, self.counts.takeovers, self._tracking.kept())
            self._is_takeover_due = True
            if self._clock.has_lapsed:
                self._tracking.law.give(self.settings.effort.fallback)
            if self._unwrapper is not None:
                self._unwrapper.interrupt()

    def _settle_jump(self, stamp_ns: int) -> int | None:
        """Undo a gap whose stamp was wrong, and return the stamp of the last usable state."""
        before, self._before_jump = self._before_jump, None
        last_ns = self._clock.stamp_ns
        assert before is not None
        assert last_ns is not None
        since = (stamp_ns - before.stamp_ns) * SECONDS_PER_NANOSECOND
        if stamp_ns > last_ns or not 0.0 <= since <= self._timing.state_timeout:
            return last_ns
        self._tracking.go_back_to(before.tracked)
        self.counts.takeovers = before.takeovers
        return before.stamp_ns

    def _doubt(self, stamp_ns: int, position: float, dt: float) -> float | None:
        """Answer a state whose position is where no joint can have come to, or believe it.

        The first one is passed over: the effort in force stays. The second is believed, as a
        takeover, if it is where the first one was. Others are no positions at all.
        """
        if self._is_takeover_due:
            return None
        first, self._astray = self._astray, (stamp_ns, position)
        if first is not None:
            since = (stamp_ns - first[0]) * SECONDS_PER_NANOSECOND
            allowed = self._step_max + self._speed_max * since
            if since > 0.0 and abs(position - first[1]) <= allowed:
                self._is_takeover_due = True
                return None
        self.counts.jumps += 1
        step = f"the position jumped by {abs(position - self._position):g} rad in {dt:g} s"
        if first is not None:
            return self.reject(stamp_ns, step)
        self.last_fault = step
        self.counts.rejected += 1
        self._skip(stamp_ns)
        return self._tracking.law.effort

    def _begin(self, stamp_ns: int, position: float) -> bool:
        """Start from where the joint is, and tell whether that is a takeover."""
        is_takeover = self._is_takeover_due and self._tracking.following.is_standing
        self._is_takeover_due = False
        self.counts.takeovers += is_takeover
        self._tracking.begin(stamp_ns, position, is_takeover=is_takeover)
        return is_takeover

    @property
    def state(self) -> LoopState:
        """What the loop is doing."""
        return LoopState.SILENT if self._clock.has_lapsed else self._state

    @property
    def effort(self) -> float:
        """The effort of the last sample in [N m]."""
        return self._tracking.law.effort

    @property
    def terms(self) -> Terms:
        """The law's terms of the last sample in [N m], before the limits."""
        return self._tracking.law.terms

    @property
    def model_effort(self) -> float:
        """What a model added in the last sample, in [N m], before the limits; 0 without one."""
        return self._tracking.law.model_effort

    @property
    def feedforward_effort(self) -> float:
        """What was fed forward for the reference in the last sample, in [N m]."""
        return self._tracking.feedforward.effort

    @property
    def integral(self) -> float:
        """The integral term that the next sample uses, in [N m]."""
        return self._tracking.law.integral

    @property
    def reference(self) -> tuple[float, float]:
        """Reference position [rad] and velocity [rad/s] of the last sample."""
        return self._tracking.following.position, self._tracking.following.velocity

    @property
    def error(self) -> float:
        """Reference minus position of the last sample in [rad]; an observer's, if there is one."""
        return self._tracking.error

    @property
    def stamp_ns(self) -> int | None:
        """Stamp of the last state in [ns]; None before the first one."""
        return self._clock.stamp_ns

    @property
    def has_motion(self) -> bool:
        """Whether the loop was told to follow anything."""
        return self._tracking.following.motion is not None

    @property
    def velocity(self) -> float:
        """The velocity that the last sample used, in [rad/s]."""
        return self._tracking.estimation.velocity

    @property
    def braked(self) -> int:
        """Samples in which a soft stop or the velocity limit braked the joint."""
        limits = self._tracking.law.limits
        return limits.braked if limits else 0
