"""One joint's loop: which states count, takeover, and the effort that answers a state."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

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
from hpid_ros.control.homogeneous_pid import Terms
from hpid_ros.control.limited_law import LimitedLaw
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


class LoopState(Enum):
    """What a loop is doing.

    =====================  ====================================================================
    event                  next state
    =====================  ====================================================================
    usable state           HOLDING, or FOLLOWING where there is a motion
    state refused          FAULT, SILENT stays SILENT; the first jump of a position changes none
    ``note_timeout``       SILENT
    two sources of states  CONFLICT, until one of them has ended: then a takeover
    ``reset``              WAITING: the next usable state is the first; so after a simulated clock
                           went back
    =====================  ====================================================================

    Beside it one flag, ``JointLoop._is_takeover_due``: the next usable state is a takeover. Set by
    ``supersede``, both timeouts (of a wall clock), a gap between stamps, a wall clock that was set
    back and a jump that was confirmed; cleared by the usable state and by ``reset``.
    """

    WAITING = "waiting for the first state"
    HOLDING = "holding its position"
    FOLLOWING = "following a reference"
    FAULT = "the last state could not be used"
    SILENT = "no new state within state_timeout"
    CONFLICT = "its states come from two sources"


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


class JointLoop:
    """The control of one joint, without ROS, files or clocks.

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
        self._following = Following()
        self._estimation = Estimation(settings)
        self._law = LimitedLaw(settings)
        self._feedforward = Feedforward(feedforward_gains(settings))
        self._unwrapper = make_unwrapper(settings.encoder)
        self._sources = SourceWatch(bounds_of_source(settings))
        self._adopt(settings)
        self.reset()

    def _adopt(self, settings: LoopSettings) -> None:
        """Take from settings what is looked at in each sample."""
        self.settings, self._timing = settings, settings.timing
        self._takeover_time = settings.timing.takeover_time
        self._uses_velocity = settings.velocity.is_measured
        self._step_max, self._speed_max = largest_step(settings)
        self._sources.adopt(bounds_of_source(settings))
        self._following.turn = turn_of_references(settings)
        self._following.encoder_turn = max(settings.encoder.wrap, 0.0)

    def begin_with(self, integral: float) -> None:
        """Begin with an integral term, as of a loop that ran before.

        Args:
            integral: In [N m]; held to its limits.
        """
        self._law.restore_integral(integral)

    def follow(self, motion: Motion) -> None:
        """Follow a motion from the next sample on; a reset starts it again.

        Args:
            motion: A trajectory's column, or a :class:`Setpoint`.
        """
        self.end_relay("a reference came")
        self._following.follow(motion)

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
        self._following.has_waited = self.stamp_ns is None and isinstance(motion, Setpoint)

    def _require_timely(self, motion: Motion) -> None:
        """Refuse a motion of another time; a stamp that is not believed yet may tell it, too."""
        window_ns = motion.window_ns
        if window_ns is None or self.stamp_ns is None:
            return
        try:
            require_timely("the trajectory", window_ns, self.stamp_ns, GRACE_NS)
        except TrajectoryError:
            if self._refused_ns is None:
                raise
            require_timely("the trajectory", window_ns, self._refused_ns, GRACE_NS)

    @property
    def _window_ns(self) -> tuple[int, int] | None:
        motion = self._following.motion
        return None if motion is None else motion.window_ns

    def _drop_earlier_motion(self, stamp_ns: int) -> None:
        """Forget a motion that a clock which has gone back has yet to reach.

        It would begin when nobody expects it any more. One that begins with the next state, or by
        the new clock has begun, starts again.
        """
        window_ns, timeout = self._window_ns, self._timing.state_timeout
        if window_ns is not None and window_ns[0] > stamp_ns + timeout * NANOSECONDS:
            begin, start = (each * SECONDS_PER_NANOSECOND for each in (stamp_ns, window_ns[0]))
            self._following.follow(None)
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
            self._following.follow(None)
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
        law, gains, against = self._law, self.settings.gains, ""
        speed = abs(self._estimation.velocity)
        if law.relay is not None:
            against = "there is one already"
        elif self.state not in (LoopState.HOLDING, LoopState.FOLLOWING):
            against = self.state.value
        elif self._is_takeover_due:
            against = "the joint is to be taken over first"
        elif self._following.velocity or self._following.acceleration:
            against = "the reference moves"
        elif law.model_gain * gains.d * speed > request.amplitude:
            against = f"the joint moves at {speed:.3g} rad/s"
        load = law.integral + law.model_effort + self._feedforward.effort
        against = against or relay_obstacle(request, gains, self.settings.effort, load, self.error)
        if against:
            raise SettingError(f"no relay now: {against}")
        self.relay = law.relay = Relay(request, gains.d / gains.p)

    def end_relay(self, reason: str) -> None:
        """Let a relay give back, if there is one.

        Args:
            reason: Why.
        """
        if self._law.relay is not None:
            self._law.relay.end(reason)

    def _drop_relay(self, reason: str) -> None:
        """End a relay at once, without another effort: the caller decides about that."""
        if self._law.relay is not None:
            self._law.relay.drop(reason)
            self._law.relay = None

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
        law, estimation, following = self._law, self._estimation, self._following
        effort = law.effort
        # The observer first: it goes on under what was sent by the law until now.
        position = None if self.stamp_ns is None else self._position
        estimation.retune(settings, position, law.driving_effort, law.model_gain)
        kept = law.retune(settings, None if position is None else (position, estimation.velocity))
        less = estimation.recompute_opposing(law.model_gain)
        law.reduce_model_effort(less)
        change = self._feedforward.retune(
            feedforward_gains(settings), following.velocity, following.acceleration
        )
        if settings.encoder.wrap != before.encoder.wrap:
            if self._unwrapper is None:
                self._unwrapper = make_unwrapper(settings.encoder)
            else:
                self._unwrapper.set_turn(max(settings.encoder.wrap, 0.0) or math.inf)
        self._adopt(settings)
        if change != less:
            kept -= law.absorb_added_effort(change - less)
        if kept:
            self._feedforward.keep(kept, self.stamp_ns or 0, self._takeover_time)
        if self.is_on_fallback and effort == before.effort.fallback:
            law.override_effort(settings.effort.fallback)

    def reset(self) -> None:
        """Forget integral, velocity and time; start the motion again with the next state."""
        self._sources.reset()
        self._restart()

    def _restart(self) -> None:
        """Reset, but for what is known of the sources of the states: the next may be another's."""
        self._drop_relay("the loop began again")
        self._law.reset()
        self._estimation.reset()
        self._feedforward.reset()
        self._following.restart()
        self.error = 0.0
        if self._unwrapper is not None:
            self._unwrapper.reset()
        self.stamp_ns: int | None = None
        """Stamp of the last usable state in [ns]; None before the first one."""
        self._refused_ns: int | None = None  # stamp of the last state, where it was not usable
        self._refused_count = 0  # states since the last usable one
        self._position = 0.0
        self.state = LoopState.WAITING
        self._is_takeover_due = False
        self._outlier: tuple[int, float] | None = None

    def release(self) -> None:
        """Forget everything, the motion too: the next state is the first, and is held."""
        self._following.follow(None)
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
        self.state = LoopState.SILENT
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
            self.supersede(self._law.effort)

    def supersede(self, effort: float) -> None:
        """Note that the joint was given another effort: the next state is a takeover from it.

        Args:
            effort: In [N m]; ``fallback_effort`` is taken for one that is not finite.
        """
        self._drop_relay("the joint was given another effort")
        self._is_takeover_due = True
        fallback = self.settings.effort.fallback
        self._law.override_effort(effort if math.isfinite(effort) else fallback)

    @property
    def is_on_fallback(self) -> bool:
        """Whether the active effort is ``fallback_effort``, for want of a usable state."""
        if self.state is LoopState.SILENT:
            return not self._timing.is_simulated
        return self.state in (LoopState.FAULT, LoopState.CONFLICT)

    @property
    def conflict(self) -> str:
        """Where the joint is by two sources of states; empty while there is one source."""
        if not self._sources.is_split:
            return ""
        one, other = self._sources.positions
        return f"one says {one:.4g} rad, one {other:.4g} rad"

    @property
    def velocity_origin(self) -> str:
        """Where the velocity of the last sample came from."""
        return self._estimation.origin

    @property
    def velocity_warning(self) -> str:
        """What speaks against the velocities of the states; empty if nothing does."""
        return self._estimation.warning

    @property
    def estimate(self) -> tuple[float, float, float] | None:
        """Position [rad], velocity [rad/s] and disturbing effort [N m] by the observer, if any."""
        return self._estimation.observer_state(self._law.model_gain)

    def damping_stop(self, duration: float) -> DampingStop:
        """Return what damps the joint from now on in this loop's place.

        Args:
            duration: In [s], positive.
        """
        law, settings = self._law, self.settings
        return DampingStop(
            damping=law.model_gain * settings.gains.d,
            velocity=self._estimation.velocity_source_for_stop(self._position),
            uses_velocity=self._uses_velocity,
            limits=law.limits,
            clamp=settings.effort,
            effort=law.effort,
            stamp_ns=self.stamp_ns or 0,
            position=self._position,
            unwrapper=self._unwrapper,
            step_max=self._step_max,
            speed_max=self._speed_max,
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
        law, timing = self._law, self._timing
        before_ns = self.stamp_ns
        is_place = -LARGEST_POSITION <= position <= LARGEST_POSITION
        if is_place and self._sources.take(stamp_ns, position):
            return self._refuse_both(stamp_ns)
        if stamp_ns == before_ns or stamp_ns == self._refused_ns:
            self.counts.repeats += 1
            return law.effort
        if not self._uses_velocity:
            velocity = None
        if not (
            is_place and (velocity is None or -LARGEST_POSITION <= velocity <= LARGEST_POSITION)
        ):
            reason = f"position {position} rad, velocity {velocity} rad/s"
            if is_place:
                reason += "; velocity_source filtered does without velocities"
            return self.reject(stamp_ns, reason)
        dt = 0.0 if before_ns is None else (stamp_ns - before_ns) * SECONDS_PER_NANOSECOND
        is_next = 0.0 < dt <= timing.state_timeout
        is_odd = dt > timing.state_timeout or (dt < 0.0 and not timing.is_simulated)
        if is_odd and not self._has_come_before(stamp_ns):
            return self._pass_over(stamp_ns, dt)
        if not is_next:
            self._interrupt(stamp_ns, dt)
        if self._unwrapper is not None:
            position = self._unwrapper.update(position)
            if not -LARGEST_POSITION <= position <= LARGEST_POSITION:
                return self.reject(stamp_ns, f"position {position} rad with its turns")
        allowed = self._step_max + self._speed_max * dt
        has_jumped = is_next and abs(position - self._position) > allowed
        if has_jumped and not self._is_takeover_due:
            if not self._is_where_it_jumped(stamp_ns, position):
                return self._reject_jump(stamp_ns, position, dt)
            self._is_takeover_due = True
        self._outlier = None
        self._position = position
        is_takeover = False
        if self._is_takeover_due or not self._following.has_reference:
            is_takeover = self._begin(stamp_ns, position)
        try:
            effort = self._answer(
                stamp_ns, position, velocity, dt if is_next else 0.0, model, is_takeover
            )
        except ArithmeticError as fault:
            self.last_fault = str(fault)
            self._skip(stamp_ns)
            return self._fault()
        self.state = LoopState.FOLLOWING if self.has_motion else LoopState.HOLDING
        self._count(dt)
        self.stamp_ns, self._refused_ns, self._refused_count = stamp_ns, None, 0
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
        law, following, estimation = self._law, self._following, self._estimation
        if estimation.has_observer:
            estimation.note_applied(law.driving_effort, law.model_gain)
        estimation.update(position, velocity, dt)
        if estimation.opposes_disturbance:
            alone = model or _NO_MODEL
            model = alone._replace(effort=alone.effort + estimation.oppose(alone.gain))
        wanted, rate, acceleration = following.sample(stamp_ns, self._takeover_time, law.limits)
        if rate and law.relay is not None:
            law.relay.end("the reference moves")
        feedforward = 0.0
        if self._feedforward.is_active or following.gives_effort:
            feedforward = self._reference_effort(stamp_ns, is_takeover=is_takeover)
        if is_takeover:
            left = law.take_over(
                model=model,
                feedforward=self._feedforward.steady_effort,
                is_next=dt > 0.0,
            )
            if left:
                self._feedforward.keep(left, stamp_ns, self._takeover_time)
                feedforward += left
        self.error = error = wanted - estimation.position
        if self._refused_ns is not None:
            # The errors between were not seen: they are not integrated.
            dt = min(dt, self._timing.control_period)
        try:
            return law.update(
                error,
                rate - estimation.velocity,
                dt,
                position=position,
                velocity=estimation.velocity,
                model=model,
                acceleration=acceleration,
                feedforward=feedforward,
            )
        except ArithmeticError:
            estimation.forget_velocity()
            raise

    def _count(self, dt: float) -> None:
        """Count a usable state, so long after the one before, and those lost between them."""
        counts, timing = self.counts, self._timing
        counts.samples += 1
        counts.saturated += self._law.is_saturated
        if dt > _LATE * timing.control_period:
            counts.missed += max(round(dt / timing.control_period) - 1 - self._refused_count, 0)

    def _reference_effort(self, stamp_ns: int, *, is_takeover: bool) -> float:
        """Return the effort that the reference of this sample needs, in [N m]."""
        forward, following = self._feedforward, self._following
        planned = following.effort(stamp_ns)
        if is_takeover:
            forward.reset()
        elif following.has_new_motion:
            left = self._law.absorb_added_effort(forward.change_by(planned))
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
        if stamp_ns in (self.stamp_ns, self._refused_ns):
            self.counts.repeats += 1
            return self._law.effort
        self.last_fault = reason
        self._skip(stamp_ns)
        return self._fault()

    def _skip(self, stamp_ns: int) -> None:
        """Pass over a state that cannot be used; the observer goes on under the effort sent."""
        if self.stamp_ns is not None:
            last_ns = self.stamp_ns if self._refused_ns is None else self._refused_ns
            dt = (stamp_ns - last_ns) * SECONDS_PER_NANOSECOND
            if 0.0 < dt <= self._timing.state_timeout:
                self._estimation.note_applied(self._law.driving_effort, self._law.model_gain)
                self._estimation.coast(dt)
        self._refused_ns = stamp_ns
        self._refused_count += 1

    def _fault(self) -> float:
        self._drop_relay("a state could not be used")
        self.counts.rejected += 1
        if self.state is not LoopState.SILENT:
            self.state = LoopState.FAULT
        self._law.override_effort(self.settings.effort.fallback)
        return self._law.effort

    def _refuse_both(self, stamp_ns: int) -> float:
        """Answer a state of one of two sources: which of them is true cannot be told."""
        if self.state is not LoopState.CONFLICT:
            self.counts.conflicts += 1
            self.state = LoopState.CONFLICT
            self.supersede(self.settings.effort.fallback)
        self.last_fault = f"two sources: {self.conflict}"
        self.counts.rejected += 1
        self._skip(stamp_ns)
        return self._law.effort

    def _interrupt(self, stamp_ns: int, dt: float) -> None:
        """Reset after a simulated clock that went back; else be due for a takeover."""
        if dt < 0.0:
            self.last_fault = f"the stamp went back by {-dt:g} s"
            self.counts.resets += 1
            if self._timing.is_simulated:
                self._drop_earlier_motion(stamp_ns)
                self._restart()
                return
            self._following.end_timed_motion()
        if dt:
            self._is_takeover_due = True
            if self._unwrapper is not None:
                self._unwrapper.interrupt()

    def _has_come_before(self, stamp_ns: int) -> bool:
        """Tell whether a second state confirms an odd stamp.

        Both lie before the last usable one, or beyond it by more than ``state_timeout``, or it
        follows the first within that.
        """
        if self._refused_ns is None or stamp_ns < self._refused_ns:
            return False
        assert self.stamp_ns is not None
        timeout = self._timing.state_timeout
        if stamp_ns < self.stamp_ns:  # and so was the one before
            return True
        return (stamp_ns - self._refused_ns) * SECONDS_PER_NANOSECOND <= timeout or (
            self._refused_ns - self.stamp_ns
        ) * SECONDS_PER_NANOSECOND > timeout

    def _pass_over(self, stamp_ns: int, dt: float) -> float:
        """Answer the first state with an odd stamp with the active effort: it may be wrong."""
        self.last_fault = f"no usable state for {dt:g} s by the stamps"
        if dt < 0.0:
            self.last_fault = f"one stamp was {-dt:g} s before the last"
        self.counts.gaps += dt > 0.0
        self.counts.rejected += 1
        if self.state is LoopState.SILENT:
            self._law.override_effort(self.settings.effort.fallback)
        self._skip(stamp_ns)
        return self._law.effort

    def _is_where_it_jumped(self, stamp_ns: int, position: float) -> bool:
        """Tell whether a position is where the one before it jumped to."""
        if self._outlier is None:
            return False
        first_ns, first = self._outlier
        apart = (stamp_ns - first_ns) * SECONDS_PER_NANOSECOND
        distance = abs(position - first)
        if self._unwrapper is not None:
            distance = self._unwrapper.distance(position, first)
        return apart > 0.0 and distance <= self._step_max + self._speed_max * apart

    def _reject_jump(self, stamp_ns: int, position: float, dt: float) -> float:
        """Pass over the first position that jumped, with the active effort; refuse others."""
        is_first, self._outlier = self._outlier is None, (stamp_ns, position)
        if self._unwrapper is not None:
            self._unwrapper.undo()
        self.counts.jumps += 1
        jump = f"the position jumped by {abs(position - self._position):g} rad in {dt:g} s"
        if not is_first:
            return self.reject(stamp_ns, jump)
        self.last_fault = jump
        self.counts.rejected += 1
        self._skip(stamp_ns)
        return self._law.effort

    def _begin(self, stamp_ns: int, position: float) -> bool:
        """Start from where the joint is, and tell whether that is a takeover."""
        law, following = self._law, self._following
        is_takeover = self._is_takeover_due and following.has_reference
        self._is_takeover_due = False
        self.counts.takeovers += is_takeover
        if law.limits is not None:
            law.limits.open(position)
        if not is_takeover:
            self._drop_distant_motion(stamp_ns)
            following.stand(position)
            return False
        if law.relay is not None:
            self._drop_relay("the joint was taken over again")
            law.override_effort(law.effort)  # the relay's share is in none of the law's terms
        self._estimation.forget_velocity()
        following.take_over(stamp_ns, position, self._takeover_time, law.limits)
        return True

    @property
    def effort(self) -> float:
        """The active effort: what was given last, in [N m]."""
        return self._law.effort

    @property
    def terms(self) -> Terms:
        """The law's terms of the last sample in [N m], before the limits."""
        return self._law.terms

    @property
    def model_effort(self) -> float:
        """What a model, or an observer's disturbance, added in the last sample, in [N m]."""
        return self._law.model_effort

    @property
    def feedforward_effort(self) -> float:
        """What was fed forward for the reference in the last sample, in [N m]."""
        return self._feedforward.effort

    @property
    def integral(self) -> float:
        """The integral term that the next sample uses, in [N m]."""
        return self._law.integral

    @property
    def reference(self) -> tuple[float, float]:
        """Reference position [rad] and velocity [rad/s] of the last sample."""
        return self._following.position, self._following.velocity

    @property
    def has_motion(self) -> bool:
        """Whether the loop was told to follow anything."""
        return self._following.motion is not None

    @property
    def velocity(self) -> float:
        """The velocity that the last sample used, in [rad/s]."""
        return self._estimation.velocity

    @property
    def braked(self) -> int:
        """Samples in which a soft stop or the velocity limit braked the joint."""
        limits = self._law.limits
        return limits.braked if limits else 0
