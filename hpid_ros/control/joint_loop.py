"""One joint's loop: which states count, takeover, and the effort that answers a state."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hpid_ros.base.errors import EndedError, SettingError, TrajectoryError
from hpid_ros.base.units import NANOSECONDS, SECONDS_PER_NANOSECOND
from hpid_ros.control.assembly import (
    bounds_of_source,
    feedforward_gains,
    largest_step,
    make_unwrapper,
    turn_of_references,
)
from hpid_ros.control.estimation import Estimation
from hpid_ros.control.following import Following
from hpid_ros.control.limited_law import LawSample, LimitedLaw
from hpid_ros.control.loop_state import (
    ANSWERED,
    NEXT,
    LoopMode,
    LoopState,
    Outlier,
    StateKind,
    StateRules,
    kind_of_state,
)
from hpid_ros.control.model import ModelTerm
from hpid_ros.control.overrides import DampingStop, Relay, RelayRequest, relay_obstacle
from hpid_ros.control.reference import (
    GRACE_NS,
    LARGEST_POSITION,
    Feedforward,
    Motion,
    Setpoint,
    require_timely,
)
from hpid_ros.control.settings import LoopSettings
from hpid_ros.control.sources import SourceWatch


@dataclass
class LoopCounts:
    """What a loop has seen since it was made."""

    samples: int = 0  # states that were answered with a new effort
    repeats: int = 0  # states with the stamp of the one before
    resets: int = 0  # states older than the one before: a reset, of a wall clock a takeover
    gaps: int = 0  # states passed over, later than state_timeout after the one before
    silences: int = 0  # times in which no state came for longer than state_timeout
    takeovers: int = 0
    jumps: int = 0  # states rejected because no joint can have moved that far
    conflicts: int = 0  # times in which the states came from two sources
    missed: int = 0  # states that must have been lost, by the stamps and control_period
    saturated: int = 0  # samples whose effort was limited
    # states that no law answered: faults, jumps, conflicts, the first after a gap
    rejected: int = 0


_NO_MODEL = ModelTerm(1.0, 0.0)
_LATE = 1.5  # control periods between two states; beyond it at least one was lost


def _unusable_numbers(position: float, velocity: float | None) -> str:
    """Say what is wrong with a state whose position or velocity cannot be used."""
    reason = f"position {position} rad, velocity {velocity} rad/s"
    if -LARGEST_POSITION <= position <= LARGEST_POSITION:
        reason += "; velocity_source filtered does without velocities"
    return reason


class JointLoop:
    """The control of one joint, without ROS, files or clocks.

    What it gave and used last is read from its parts: ``law`` (``effort``, ``integral``,
    ``terms``), ``following`` (``reference``, ``motion``), ``estimation`` (``velocity``),
    ``feedforward`` (``effort``), ``state`` (``mode``, ``stamp_ns``) and ``counts``.

    Time enters with the stamps of the states alone: equal stamps are a repeat, which gets the
    active effort again; stamps that go back reset the loop if its clock is simulated. Until it is
    told otherwise, a loop holds the position of its first state.

    Where the joint was without a command of the loop for longer than ``state_timeout`` (a gap
    between the stamps, :meth:`note_timeout`, states that cannot be used), where its position
    jumped, and where a wall clock was set back, which ends a motion that goes by it, the loop
    takes over again: it starts from where the joint is, with the active effort as its integral
    (after a jump without its derivative term), and glides onto a motion that is under way. A
    gap, and on a wall clock a stamp that goes back, is believed with its second state: the first
    gets the active effort, so that a single wrong stamp leaves nothing behind.

    While the states come from two sources (:class:`~hpid_ros.control.sources.SourceWatch`) nobody
    can tell where the joint is: each gets ``fallback_effort``. When one source has ended, the loop
    takes over again.

    Args:
        settings: Checked settings.
    """

    def __init__(self, settings: LoopSettings) -> None:
        self.counts = LoopCounts()
        self.last_fault = ""
        """What was last wrong with a state."""
        self.dropped = ""
        """Why the clock of the states ended the last motion that it has ended."""
        self.relay: Relay | None = None
        """The last relay that there was, for what became of it."""
        self.error = 0.0
        """Reference minus position of the last sample in [rad]; an observer's, if there is one."""
        self.following = Following()
        self.estimation = Estimation(settings)
        self.law = LimitedLaw(settings)
        self.feedforward = Feedforward(feedforward_gains(settings))
        self.sources = SourceWatch(bounds_of_source(settings))
        self._unwrapper = make_unwrapper(settings.encoder)
        self._adopt(settings)
        self.reset()

    def _adopt(self, settings: LoopSettings) -> None:
        """Take from settings what is looked at in each sample."""
        self.settings, self._timing = settings, settings.timing
        self._takeover_time = settings.timing.takeover_time
        self._uses_velocity = settings.velocity.is_measured
        step_max, speed_max = largest_step(settings)
        self._rules = StateRules(
            timeout=settings.timing.state_timeout,
            is_simulated=settings.timing.is_simulated,
            step_max=step_max,
            speed_max=speed_max,
            turn=settings.encoder.encoder_wrap
            if settings.encoder.encoder_wrap > 0.0
            else math.inf,
        )
        self.sources.adopt(bounds_of_source(settings))
        self.following.turn = turn_of_references(settings)
        self.following.encoder_turn = max(settings.encoder.encoder_wrap, 0.0)

    def begin_with(self, integral: float) -> None:
        """Begin with an integral term, as of a loop that ran before.

        Args:
            integral: In [N m]; held to its limits.
        """
        self.law.restore_integral(integral)

    def follow(self, motion: Motion) -> None:
        """Follow a motion from the next sample on; a reset starts it again.

        Args:
            motion: A trajectory's column, or a :class:`Setpoint`.
        """
        self.end_relay("a reference came")
        self.following.follow(motion)

    def receive(self, motion: Motion, *, carries_on: bool = False) -> None:
        """Follow a motion that was received from outside.

        A setpoint that comes before the first state is glided onto, it is no step.

        Args:
            motion: As of :meth:`follow`.
            carries_on: Whether it may have ended: the latched one of a controller that begins.

        Raises:
            TrajectoryError: By the stamps of the states it has ended, or it starts too far ahead.
        """
        try:
            self._require_timely(motion)
        except EndedError:
            if not carries_on:
                raise
        self.follow(motion)
        has_begun = self.state.stamp_ns is not None
        self.following.has_waited = isinstance(motion, Setpoint) and not has_begun

    def _require_timely(self, motion: Motion) -> None:
        """Refuse a motion of another time; a stamp that is not believed yet may tell it, too."""
        window_ns, state = motion.window_ns, self.state
        if window_ns is None or state.stamp_ns is None:
            return
        try:
            require_timely("the trajectory", window_ns, state.stamp_ns, GRACE_NS)
        except TrajectoryError:
            if state.refused_ns is None:
                raise
            require_timely("the trajectory", window_ns, state.refused_ns, GRACE_NS)

    @property
    def _window_ns(self) -> tuple[int, int] | None:
        motion = self.following.motion
        return None if motion is None else motion.window_ns

    def _drop_earlier_motion(self, stamp_ns: int) -> None:
        """Forget a motion that a clock which has gone back has yet to reach.

        It would begin when nobody expects it any more. One that begins with the next state, or by
        the new clock has begun, starts again.
        """
        window_ns, timeout = self._window_ns, self._timing.state_timeout
        if window_ns is not None and window_ns[0] > stamp_ns + timeout * NANOSECONDS:
            begin, start = (each * SECONDS_PER_NANOSECOND for each in (stamp_ns, window_ns[0]))
            self.following.follow(None)
            self.dropped = (
                f"the clock of the states went back to {begin:.3f} s: the trajectory that starts "
                f"at {start:.3f} s is from before that"
            )

    def _drop_distant_motion(self, stamp_ns: int) -> None:
        """Forget a motion that came before the first state, and starts too far ahead of it."""
        window_ns = self._window_ns
        if window_ns is None:
            return
        try:
            require_timely("the trajectory", window_ns, stamp_ns)
        except EndedError:
            pass  # a controller that was started again carries on
        except TrajectoryError as error:
            self.following.follow(None)
            self.dropped = str(error)

    def begin_relay(self, request: RelayRequest) -> None:
        """Let a relay drive the joint for some cycles, around where it is held.

        It gives back by itself; also when a reference or parameters come, and at once when the
        joint is taken over again, or a state cannot be used.

        Args:
            request: What it shall do.

        Raises:
            SettingError: The joint is not held at rest, is too near to its effort limits, or the
                law has nothing to hold it by.
        """
        law, gains, against = self.law, self.settings.gains, ""
        state, speed = self.state, abs(self.estimation.velocity)
        if law.relay is not None:
            against = "there is one already"
        elif state.mode not in (LoopMode.HOLDING, LoopMode.FOLLOWING):
            against = state.mode.value
        elif state.is_takeover_due:
            against = "the joint is to be taken over first"
        elif self.following.velocity or self.following.acceleration:
            against = "the reference moves"
        elif law.model_gain * gains.d * speed > request.amplitude:
            against = f"the joint moves at {speed:.3g} rad/s"
        load = law.integral + law.model_effort + self.feedforward.effort
        against = against or relay_obstacle(request, gains, self.settings.effort, load, self.error)
        if against:
            raise SettingError(f"no relay now: {against}")
        self.relay = law.relay = Relay(request, gains.d / gains.p)

    def end_relay(self, reason: str) -> None:
        """Let a relay give back, if there is one.

        Args:
            reason: Why.
        """
        if self.law.relay is not None:
            self.law.relay.end(reason)

    def _drop_relay(self, reason: str) -> None:
        """End a relay at once, without another effort: the caller decides about that."""
        if self.law.relay is not None:
            self.law.relay.drop(reason)
            self.law.relay = None

    def retune(self, settings: LoopSettings) -> None:
        """Apply other settings from the next sample on, as a whole.

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
        settings.norm_family(settings.degree)  # raises before anything has changed
        self.end_relay("parameters were set")
        law, estimation, following = self.law, self.estimation, self.following
        state, effort = self.state, law.effort
        # The observer first: it goes on under what was sent by the law until now.
        position = None if state.stamp_ns is None else state.position
        estimation.retune(settings, position, law.driving_effort, law.model_gain)
        kept = law.retune(settings, None if position is None else (position, estimation.velocity))
        less = estimation.recompute_opposing(law.model_gain)
        law.reduce_model_effort(less)
        change = self.feedforward.retune(
            feedforward_gains(settings), following.velocity, following.acceleration
        )
        if settings.encoder.encoder_wrap != before.encoder.encoder_wrap:
            if self._unwrapper is None:
                self._unwrapper = make_unwrapper(settings.encoder)
            else:
                self._unwrapper.set_turn(max(settings.encoder.encoder_wrap, 0.0) or math.inf)
        self._adopt(settings)
        if change != less:
            kept -= law.absorb_added_effort(change - less)
        if kept:
            self.feedforward.keep(kept, state.stamp_ns or 0, self._takeover_time)
        if self.is_on_fallback and effort == before.effort.fallback:
            law.override_effort(settings.effort.fallback)

    def reset(self) -> None:
        """Forget integral, velocity and time; start the motion again with the next state."""
        self.sources.reset()
        self._restart()

    def _restart(self) -> None:
        """Reset, but for what is known of the sources of the states: the next may be another's."""
        self._drop_relay("the loop began again")
        self.law.reset()
        self.estimation.reset()
        self.feedforward.reset()
        self.following.restart()
        self.error = 0.0
        if self._unwrapper is not None:
            self._unwrapper.reset()
        self.state = LoopState()

    def release(self) -> None:
        """Forget everything, the motion too: the next state is the first, and is held."""
        self.following.follow(None)
        self.reset()

    def note_timeout(self) -> float:
        """Note that no state has come for too long, and return the effort to give until one does.

        The next state is a takeover. Only where ``state_clock`` is ``simulated`` do the stamps
        alone tell whether time has passed for the joint, too: if that state comes within
        ``state_timeout`` of the last one by its stamp, the simulation was paused, and the loop
        goes on as if nothing had been, but without a relay.

        Returns:
            ``fallback_effort``, within the effort limits, in [N m].
        """
        self.state.mode = LoopMode.SILENT
        self._drop_relay("no state came")
        self.counts.silences += 1
        if not self._timing.is_simulated:
            self.supersede(self.settings.effort.fallback)
        return self.settings.effort.fallback

    def note_unanswered(self) -> None:
        """Note that states have stayed away for too long, and nobody has given another effort.

        As after :meth:`note_timeout` the next state is a takeover, but from the active effort.
        """
        self.counts.silences += 1
        self._drop_relay("no state came")
        if not self._timing.is_simulated:
            self.state.is_takeover_due = True
            self.law.disown_effort()

    def supersede(self, effort: float) -> None:
        """Note that the joint was given another effort: the next state is a takeover from it.

        Args:
            effort: In [N m]; ``fallback_effort`` is taken for one that is not finite.
        """
        self._drop_relay("the joint was given another effort")
        self.state.is_takeover_due = True
        fallback = self.settings.effort.fallback
        self.law.override_effort(effort if math.isfinite(effort) else fallback)

    @property
    def is_on_fallback(self) -> bool:
        """Whether the active effort is ``fallback_effort``, for want of a usable state."""
        mode = self.state.mode
        if mode is LoopMode.SILENT:
            return not self._timing.is_simulated
        return mode in (LoopMode.FAULT, LoopMode.CONFLICT)

    def damping_stop(self, duration: float) -> DampingStop:
        """Return what damps the joint from now on in this loop's place.

        Args:
            duration: In [s], positive.
        """
        law, settings, state = self.law, self.settings, self.state
        return DampingStop(
            damping=law.model_gain * settings.gains.d,
            velocity=self.estimation.velocity_source_for_stop(state.position),
            uses_velocity=self._uses_velocity,
            limits=law.limits,
            clamp=settings.effort,
            effort=law.effort,
            stamp_ns=state.stamp_ns or 0,
            position=state.position,
            unwrapper=self._unwrapper,
            step_max=self._rules.step_max,
            speed_max=self._rules.speed_max,
            duration=duration,
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
        is_place = -LARGEST_POSITION <= position <= LARGEST_POSITION
        is_split = is_place and self.sources.take(stamp_ns, position)
        if not self._uses_velocity:
            velocity = None
        continuous = None  # the position with the encoder's turns, of a state that can be used
        if is_place and (velocity is None or -LARGEST_POSITION <= velocity <= LARGEST_POSITION):
            unwrapper = self._unwrapper
            continuous = position if unwrapper is None else unwrapper.continuous(position)
        last_ns = self.state.stamp_ns
        kind = kind_of_state(stamp_ns, continuous, is_split, self.state, self._rules)
        if kind is not NEXT:
            if kind not in ANSWERED:
                return self._leave(kind, stamp_ns, position, velocity, continuous)
            self._interrupt(kind, stamp_ns)
        if self._unwrapper is not None:
            position = self._unwrapper.update(position)
        state = self.state  # another one after a reset
        state.position, state.outlier = position, None
        is_takeover = False
        if state.is_takeover_due or not self.following.has_reference:
            is_takeover = self._begin(stamp_ns, position)
        since = 0.0 if last_ns is None else (stamp_ns - last_ns) * SECONDS_PER_NANOSECOND
        dt = since if kind is NEXT or kind is StateKind.MOVED else 0.0
        try:
            effort = self._answer(stamp_ns, position, velocity, dt, model, is_takeover)
        except ArithmeticError as fault:
            self.last_fault = str(fault)
            self._skip(stamp_ns)
            return self._fault()
        self._count(since)
        has_motion = self.following.motion is not None
        state.answer(stamp_ns, LoopMode.FOLLOWING if has_motion else LoopMode.HOLDING)
        return effort

    def _answer(
        self,
        stamp_ns: int,
        position: float,
        velocity: float | None,
        dt: float,
        model: ModelTerm | None,
        is_takeover: bool,
    ) -> float:
        """Answer a usable state: estimation, reference, feedforward, law.

        After a gap, as for the first state, ``dt`` is 0.
        """
        law, following, estimation = self.law, self.following, self.estimation
        has_observer = estimation.has_observer
        if has_observer:
            estimation.note_applied(law.driving_effort, law.model_gain)
        estimation.update(position, velocity, dt)
        if has_observer and estimation.opposes_disturbance:
            alone = model or _NO_MODEL
            model = alone._replace(effort=alone.effort + estimation.oppose(alone.gain))
        wanted, rate, acceleration = following.sample(stamp_ns, self._takeover_time, law.limits)
        if rate and law.relay is not None:
            law.relay.end("the reference moves")
        feedforward = 0.0
        if self.feedforward.is_active or following.gives_effort:
            feedforward = self._reference_effort(stamp_ns, is_takeover=is_takeover)
        if is_takeover:
            left = law.take_over(
                model=model,
                feedforward=self.feedforward.steady_effort,
                is_next=dt > 0.0,
            )
            if left:
                self.feedforward.keep(left, stamp_ns, self._takeover_time)
                feedforward += left
        self.error = error = wanted - estimation.position
        if self.state.refused_ns is not None:
            # The errors between were not seen: they are not integrated.
            dt = min(dt, self._timing.control_period)
        try:
            return law.update(
                LawSample(
                    error,
                    rate - estimation.velocity,
                    dt,
                    position,
                    estimation.velocity,
                    acceleration,
                    feedforward,
                    model,
                )
            )
        except ArithmeticError:
            estimation.forget_velocity()
            raise

    def _count(self, dt: float) -> None:
        """Count a usable state, so long after the one before, and those lost between them."""
        counts, timing = self.counts, self._timing
        counts.samples += 1
        counts.saturated += self.law.is_saturated
        if dt > _LATE * timing.control_period:
            counts.missed += max(
                round(dt / timing.control_period) - 1 - self.state.refused_count, 0
            )

    def _reference_effort(self, stamp_ns: int, *, is_takeover: bool) -> float:
        """Return the effort that the reference of this sample needs, in [N m]."""
        forward, following = self.feedforward, self.following
        planned = following.effort(stamp_ns)
        if is_takeover:
            forward.reset()
        elif following.has_new_motion:
            left = self.law.absorb_added_effort(forward.change_by(planned))
            if left:
                forward.keep(-left, stamp_ns, self._takeover_time)
        following.has_new_motion = False
        return forward.update(stamp_ns, following.velocity, following.acceleration, planned)

    def reject(self, stamp_ns: int, reason: str) -> float:
        """Answer a state that cannot be used.

        Args:
            stamp_ns: Its stamp in [ns].
            reason: What is wrong with it.

        Returns:
            ``fallback_effort``, within the effort limits, in [N m]; for a repeat the active
            effort.
        """
        if self.state.is_repeat(stamp_ns):
            self.counts.repeats += 1
            return self.law.effort
        self.last_fault = reason
        self._skip(stamp_ns)
        return self._fault()

    def _skip(self, stamp_ns: int) -> None:
        """Pass over a state that the law does not answer; the observer goes on without it."""
        state = self.state
        if state.stamp_ns is not None:
            last_ns = state.stamp_ns if state.refused_ns is None else state.refused_ns
            dt = (stamp_ns - last_ns) * SECONDS_PER_NANOSECOND
            if 0.0 < dt <= self._timing.state_timeout:
                self.estimation.note_applied(self.law.driving_effort, self.law.model_gain)
                self.estimation.coast(dt)
        state.refuse(stamp_ns)

    def _fault(self) -> float:
        self._drop_relay("a state could not be used")
        self.counts.rejected += 1
        if self.state.mode is not LoopMode.SILENT:
            self.state.mode = LoopMode.FAULT
        self.law.override_effort(self.settings.effort.fallback)
        return self.law.effort

    def _leave(
        self,
        kind: StateKind,
        stamp_ns: int,
        position: float,
        velocity: float | None,
        continuous: float | None,
    ) -> float:
        """Return the effort for a state that the law does not answer."""
        if kind is StateKind.REPEAT:
            self.counts.repeats += 1
            return self.law.effort
        if kind is StateKind.CONFLICT:
            return self._refuse_both(stamp_ns)
        if continuous is None:
            return self.reject(stamp_ns, _unusable_numbers(position, velocity))
        if kind is StateKind.UNUSABLE:
            assert self._unwrapper is not None
            self._unwrapper.update(position)  # the encoder was there
            return self.reject(stamp_ns, f"position {continuous} rad with its turns")
        if kind is StateKind.LATE or kind is StateKind.EARLIER:
            return self._pass_over_stamp(kind, stamp_ns)
        return self._refuse_jump(kind, stamp_ns, continuous)

    def _refuse_both(self, stamp_ns: int) -> float:
        """Answer a state of one of two sources: which of them is true cannot be told."""
        if self.state.mode is not LoopMode.CONFLICT:
            self.counts.conflicts += 1
            self.state.mode = LoopMode.CONFLICT
            self.supersede(self.settings.effort.fallback)
        self.last_fault = f"two sources: {self.sources.conflict}"
        return self._keep_effort(stamp_ns)

    def _pass_over_stamp(self, kind: StateKind, stamp_ns: int) -> float:
        """Answer the first state whose stamp is no next one with the active effort."""
        apart = abs(self._seconds_since_last(stamp_ns))
        if kind is StateKind.LATE:
            self.counts.gaps += 1
            self.last_fault = f"no usable state for {apart:g} s by the stamps"
        else:
            self.last_fault = f"one stamp was {apart:g} s before the last"
        if self.state.mode is LoopMode.SILENT:
            self.law.override_effort(self.settings.effort.fallback)
        return self._keep_effort(stamp_ns)

    def _refuse_jump(self, kind: StateKind, stamp_ns: int, position: float) -> float:
        """Pass over the first position that jumped, with the active effort; refuse others."""
        state = self.state
        apart, dt = abs(position - state.position), self._seconds_since_last(stamp_ns)
        state.outlier = Outlier(stamp_ns, position)
        self.counts.jumps += 1
        jump = f"the position jumped by {apart:g} rad in {dt:g} s"
        if kind is StateKind.STRAY:
            return self.reject(stamp_ns, jump)
        self.last_fault = jump
        return self._keep_effort(stamp_ns)

    def _keep_effort(self, stamp_ns: int) -> float:
        """Pass over a state, and return the active effort."""
        self.counts.rejected += 1
        self._skip(stamp_ns)
        return self.law.effort

    def _seconds_since_last(self, stamp_ns: int) -> float:
        """Return the time since the last state that the law answered, in [s]; 0 for the first."""
        last_ns = self.state.stamp_ns
        return 0.0 if last_ns is None else (stamp_ns - last_ns) * SECONDS_PER_NANOSECOND

    def _interrupt(self, kind: StateKind, stamp_ns: int) -> None:
        """Prepare for a state that does not just follow the last one: a takeover, or a reset."""
        if kind is StateKind.FIRST:
            return
        if kind is StateKind.RESET or kind is StateKind.SET_BACK:
            self.counts.resets += 1
            back = -self._seconds_since_last(stamp_ns)
            self.last_fault = f"the stamp went back by {back:g} s"
        if kind is StateKind.RESET:
            self._drop_earlier_motion(stamp_ns)
            self._restart()
            return
        if kind is StateKind.SET_BACK:
            self.following.end_timed_motion()
        self.state.is_takeover_due = True
        if kind is not StateKind.MOVED and self._unwrapper is not None:
            self._unwrapper.interrupt()

    def _begin(self, stamp_ns: int, position: float) -> bool:
        """Start from where the joint is, and tell whether that is a takeover."""
        law, following = self.law, self.following
        is_takeover = self.state.is_takeover_due and following.has_reference
        self.state.is_takeover_due = False
        self.counts.takeovers += is_takeover
        if law.limits is not None:
            law.limits.open(position)
        if not is_takeover:
            self._drop_distant_motion(stamp_ns)
            following.stand(position)
            return False
        if law.relay is not None:
            self._drop_relay("the joint was taken over again")
            law.disown_effort()  # the relay's share is in none of the law's terms
        self.estimation.forget_velocity()
        following.take_over(stamp_ns, position, self._takeover_time, law.limits)
        return True
