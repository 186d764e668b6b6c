r"""The reference of each sample, made of a sequence of messages.

Streams (MoveIt Servo, policies, teleoperation) and single trajectories are one thing here: each
message is a motion that replaces the one before it, from the instant on at which it begins. What
is left of the one before fades. With the motion :math:`m(t)` of the newest message, the reference
is

.. math::
    c(t) = m(t) + \delta(t), \qquad r(t) = (1 - w(t))\,c(t) + w(t)\,r_0

- A **glide** leads from rest at :math:`r_0` onto the motion: its weight w falls from 1 to 0 with
  zero rate at both ends. The reference stays between :math:`r_0` and the motion, whatever the
  motion does meanwhile, and messages that come during a glide do not change its end.
- An **offset** :math:`\delta` takes what a message moves the motion by at the instant at which it
  begins, its position alone, and fades. Where it is to fade much longer than it was, the rate that
  it has ends when it would have ended, as an offset of its own: else it would swing. c stays
  within the positions of the motion, and those where it stood.

A motion whose first point is yet to come needs neither: its spline begins where the reference is
(``Column.start``). If the reference moves faster than that spline may begin, the offset takes the
excess of velocity.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from hpid_ros.base.units import NANOSECONDS, SECONDS_PER_NANOSECOND
from hpid_ros.control.limits import MotionLimits
from hpid_ros.control.reference import (
    Motion,
    Pace,
    Reference,
    Setpoint,
    shifted,
    whole_turns,
)

_PEAK = 1.875  # largest rate of a smooth step, of its height in its duration
_GENTLE = 0.2  # of the motion's own speed, by which an offset fades at most where it has the time
_SLOW = 0.25  # of a motion's largest velocity: with no more it has hardly begun
_SWING = 0.1755  # largest way of an offset that begins with a velocity, of velocity times duration
_STREAM_NS = NANOSECONDS  # a message so long after the end of the last one belongs to its stream
_LONGEST = 3600.0  # [s] of a glide
_MOST_WAITING = 64  # motions that begin later
_MOST_FADING = 8  # offsets: the newest, and rates of those before it


class Glide(NamedTuple):
    """From rest at a position onto whatever the motion is."""

    position: float  # [rad] where it begins
    begin_ns: int
    end_ns: int
    duration: float  # [s]

    def weight(self, stamp_ns: int) -> tuple[float, float, float]:
        """Return the weight of its position at an instant, and the weight's derivatives."""
        T = self.duration
        s = (stamp_ns - self.begin_ns) * SECONDS_PER_NANOSECOND / T
        squared = s * s
        return (
            1.0 - squared * s * (10.0 - 15.0 * s + 6.0 * squared),
            -30.0 * squared * (1.0 - 2.0 * s + squared) / T,
            -60.0 * s * (1.0 - 3.0 * s + 2.0 * squared) / (T * T),
        )

    def sample(self, stamp_ns: int, onto: Sequence[float]) -> tuple[float, float, float]:
        """Return the reference between its beginning and where the motion is."""
        position, velocity, acceleration = onto
        if not self.begin_ns <= stamp_ns < self.end_ns:
            return position, velocity, acceleration
        w, dw, ddw = self.weight(stamp_ns)
        away = self.position - position
        return (
            position + w * away,
            (1.0 - w) * velocity + dw * away,
            (1.0 - w) * acceleration - 2.0 * dw * velocity + ddw * away,
        )


class Offset(NamedTuple):
    """A difference of positions that fades: a quintic that has nothing left at its end.

    Begun again at any instant, from where it is then, it is the same curve.
    """

    position: float  # [rad] at its beginning
    velocity: float  # [rad/s]
    acceleration: float  # [rad/s^2]
    begin_ns: int
    end_ns: int

    def sample(self, stamp_ns: int) -> tuple[float, float, float]:
        """Return it and its derivatives at an instant."""
        if not self.begin_ns <= stamp_ns < self.end_ns:
            return 0.0, 0.0, 0.0
        T = (self.end_ns - self.begin_ns) * SECONDS_PER_NANOSECOND
        a, b, c = self.position, self.velocity * T, self.acceleration * T * T
        s = (stamp_ns - self.begin_ns) * SECONDS_PER_NANOSECOND / T
        squared = s * s
        cubed = squared * s
        return (
            a * (1.0 - cubed * (10.0 - 15.0 * s + 6.0 * squared))
            + b * (s - cubed * (6.0 - 8.0 * s + 3.0 * squared))
            + c * squared * (0.5 - 1.5 * s + 1.5 * squared - 0.5 * cubed),
            (
                -30.0 * a * squared * (1.0 - 2.0 * s + squared)
                + b * (1.0 - squared * (18.0 - 32.0 * s + 15.0 * squared))
                + c * s * (1.0 - 4.5 * s + 6.0 * squared - 2.5 * cubed)
            )
            / T,
            (
                -60.0 * a * s * (1.0 - 3.0 * s + 2.0 * squared)
                - b * s * (36.0 - 96.0 * s + 60.0 * squared)
                + c * (1.0 - 9.0 * s + 18.0 * squared - 10.0 * cubed)
            )
            / (T * T),
        )


_NOWHERE = Pace()


def glide_time(distance: float, duration: float, fastest: float) -> float:
    """Return how long a glide lasts: longer than wished where it would else be too fast, in [s].

    Args:
        distance: How far it leads, in [rad].
        duration: How long it shall last in [s]; with 0 there is none.
        fastest: The largest velocity of a smooth step, in [rad/s]; inf where none is known.
    """
    if not duration:
        return 0.0
    return min(max(duration, _PEAK * abs(distance) / fastest), _LONGEST)


def _nanoseconds(duration: float) -> int:
    return round(duration / SECONDS_PER_NANOSECOND)


class _Here(NamedTuple):
    """Where a reference stands when another motion begins."""

    position: float  # [rad]
    velocity: float  # [rad/s]
    motion: Sequence[float]  # where the motion itself is, and its derivatives
    joined: float  # [rad] where it is with its offsets
    is_held: bool  # whether those are held back
    offset_end_ns: int  # [ns] when all have faded; now if there is none
    glide_end_ns: int  # [ns] likewise
    is_running: bool  # whether it moves by a glide, or by a stream of messages
    has_ended: bool  # whether the motion itself rests
    pace: Pace  # the motion's
    turns: float  # [rad] by which the motion is shifted
    fastest: float  # [rad/s] the joint's velocity limit; inf for none


class Following:
    """Turns motions into the reference of each sample."""

    __slots__ = (
        "_active",
        "_arrived",
        "_glide",
        "_hull",
        "_is_first",
        "_offsets",
        "_reference",
        "_waiting",
        "acceleration",
        "encoder_turn",
        "gives_effort",
        "has_new_motion",
        "has_waited",
        "motion",
        "position",
        "turn",
        "velocity",
    )

    def __init__(self) -> None:
        self.motion: Motion | None = None  # the newest that came
        self._arrived: tuple[Motion, ...] = ()  # since the last sample
        self._waiting: tuple[Motion, ...] = ()  # those that begin later, in that order
        self._active: Motion | None = None  # what the reference is of
        self.has_waited = False  # for the first state, or a takeover: no step is meant
        self.turn = self.encoder_turn = 0.0
        self.restart()

    @property
    def reference(self) -> tuple[float, float]:
        """Position [rad] and velocity [rad/s] of the last sample."""
        return self.position, self.velocity

    @property
    def has_reference(self) -> bool:
        """Whether there is a reference; the first state makes one."""
        return self._reference is not None

    def follow(self, motion: Motion | None) -> None:
        """Follow a motion from the next sample on; None forgets what was followed.

        One that begins later leaves until then what runs, and what begins before it.
        """
        self.motion, self.has_waited = motion, False
        if motion is None:
            self._arrived = self._waiting = ()
            self._active = None
        else:
            self._arrived = (*self._arrived, motion)[-_MOST_WAITING:]

    def restart(self) -> None:
        """Forget where the reference stands, and start the newest motion again."""
        self._arrived = () if self.motion is None else (self.motion,)
        self._waiting, self._active = (), None
        self.has_waited = isinstance(self.motion, Setpoint)
        self._reference: Reference | None = None
        self._glide: Glide | None = None
        self._offsets: tuple[Offset, ...] = ()
        self._hull = -math.inf, math.inf  # [rad] where motion and offsets may lead
        self._is_first = True
        self.gives_effort = self.has_new_motion = False
        self.position = self.velocity = self.acceleration = 0.0

    def stand(self, position: float) -> None:
        """Hold a position until there is a motion."""
        self._reference, self._active = Setpoint(position), None
        self._glide, self._offsets = None, ()
        self.position, self.velocity, self.acceleration = position, 0.0, 0.0

    def end_timed_motion(self) -> None:
        """Stay where the reference stands if a motion that has begun goes by time."""
        self._waiting = ()  # they were to begin by this clock
        if self._active is not None and self._active.goes_by_time:
            self._active = self._reference = Setpoint(self.position)
            self._glide, self._offsets = None, ()
            self.motion = self._arrived[-1] if self._arrived else self._active

    def take_over(
        self, stamp_ns: int, position: float, duration: float, limits: MotionLimits | None
    ) -> None:
        """Start from a position again, and glide onto what is followed."""
        onto, active = self._reference, self._active
        due = [each for each in self._waiting if each.begin_ns <= stamp_ns]  # too late by now
        self._arrived = (*due, *self._arrived)
        self._waiting = self._waiting[len(due) :]
        is_replaced = any(_begin_ns(each, stamp_ns) == stamp_ns for each in self._arrived)
        self.has_waited = is_replaced
        self.stand(position)
        if active is None or onto is None or is_replaced:
            return
        away = position - onto.sample(stamp_ns)[0]
        onto = shifted(onto, whole_turns(away, self.turn))
        self._reference, self._active = onto, active
        fastest = math.inf if limits is None else limits.fastest
        self._glide_from(position, stamp_ns, active.pace, duration, fastest)

    def sample(
        self, stamp_ns: int, duration: float, limits: MotionLimits | None
    ) -> Sequence[float]:
        """Return the reference of a sample: position, velocity and acceleration.

        There must be a reference, see :attr:`has_reference`.
        """
        if self._glide is not None and stamp_ns >= self._glide.end_ns:
            self._glide = None
        if self._offsets:
            self._offsets = tuple(each for each in self._offsets if stamp_ns < each.end_ns)
        if self._arrived or self._waiting:
            self._begin_due(stamp_ns, duration, limits)
        wanted = self._at(stamp_ns)
        if limits is not None:
            position, velocity, acceleration = wanted
            inside, velocity = limits.reference(position, velocity)
            if inside != position:  # at a stop the reference rests
                position, acceleration = inside, 0.0
            wanted = position, velocity, acceleration
        self.position, self.velocity, self.acceleration = wanted
        return wanted

    def effort(self, stamp_ns: int) -> float:
        """Return the effort that was planned for the instant of a sample, in [N m]."""
        if self._reference is None or not self.gives_effort:
            return 0.0
        return self._reference.effort(stamp_ns)

    def _joined(self, stamp_ns: int) -> tuple[Sequence[float], bool]:
        """Return the motion with its offsets, and whether it is held where they may lead."""
        onto = self._reference.sample(stamp_ns)  # type: ignore[union-attr]
        if not self._offsets:
            return onto, False
        position, velocity, acceleration = onto
        for offset in self._offsets:
            away, rate, change = offset.sample(stamp_ns)
            position, velocity, acceleration = (
                position + away,
                velocity + rate,
                acceleration + change,
            )
        lowest, highest = self._hull  # the motion itself may lead beyond
        inside = min(max(position, min(lowest, onto[0])), max(highest, onto[0]))
        if inside == position:
            return (position, velocity, acceleration), False
        return (onto if inside == onto[0] else (inside, 0.0, 0.0)), True

    def _at(self, stamp_ns: int) -> Sequence[float]:
        joined, _ = self._joined(stamp_ns)
        return joined if self._glide is None else self._glide.sample(stamp_ns, joined)

    def _begin_due(self, stamp_ns: int, duration: float, limits: MotionLimits | None) -> None:
        """Begin with the motions whose time has come; a newer one ends those that begin later."""
        waiting = list(self._waiting)
        for motion in self._arrived:
            begin_ns = _begin_ns(motion, stamp_ns)
            waiting = [each for each in waiting if _begin_ns(each, stamp_ns) < begin_ns]
            waiting.append(motion)
        were_in_time, self._arrived = self._waiting, ()
        while waiting and _begin_ns(waiting[0], stamp_ns) == stamp_ns:
            motion = waiting.pop(0)
            # What was there in time begins in time, whenever the states come.
            is_in_time = any(motion is each for each in were_in_time)
            self._begin(motion, stamp_ns, is_in_time, duration, limits)
        self._waiting = tuple(waiting[:_MOST_WAITING])

    def _begin(
        self,
        motion: Motion,
        stamp_ns: int,
        is_in_time: bool,
        duration: float,
        limits: MotionLimits | None,
    ) -> None:
        """Turn to a motion: from where the reference stands, or onto it if it is under way.

        One whose first point is the state that it starts with is followed from rest as it is.
        """
        stamp_ns = motion.begin_ns if is_in_time else stamp_ns
        here = self._here(stamp_ns, limits)
        self.gives_effort, self.has_new_motion = motion.gives_effort, True
        is_under_way, turn = motion.is_under_way(stamp_ns), self.turn
        if self._is_first and is_under_way:
            turn = turn or self.encoder_turn
        self._is_first = False
        is_exact = motion.goes_by_time and motion.first_ns(stamp_ns) == stamp_ns
        has_begun = is_under_way or is_exact
        goes_on = (is_exact and is_in_time) or (has_begun and here.is_running)
        nearest = here.joined if goes_on else here.position
        turns = whole_turns(nearest - motion.target(stamp_ns), turn) if turn else 0.0
        self._active = motion
        has_waited = self.has_waited and (is_exact or not motion.goes_by_time)
        if goes_on or is_under_way or has_waited:
            self._reference = shifted(motion.start(stamp_ns, None, 0.0), turns)
            if goes_on:
                self._go_on(here, motion.pace, turns, stamp_ns, duration)
            else:
                self._glide_onto(here, motion.pace, turns, stamp_ns, duration)
            return
        self._glide, self._offsets = None, ()
        way = motion.start(stamp_ns, here.position - turns, here.velocity)
        self._reference = shifted(way, turns)
        if motion.goes_by_time and duration and not is_exact:
            self._approach(here, motion, turns, stamp_ns, duration)

    def _here(self, stamp_ns: int, limits: MotionLimits | None) -> _Here:
        """Return where the reference stands before another motion is begun with."""
        position, velocity, _ = self._at(stamp_ns)
        before, active = self._reference, self._active
        assert before is not None
        if limits is not None:  # or it would leave a stop at full speed
            inside, velocity = limits.reference(position, velocity)
            if inside != position:
                self.stand(inside)
                position = inside
        is_timed = active is not None and active.goes_by_time
        is_gliding = self._glide is not None and stamp_ns < self._glide.end_ns
        joined, is_held = self._joined(stamp_ns)
        standing = self._onto
        return _Here(
            position,
            velocity,
            standing.sample(stamp_ns),
            joined[0],
            is_held,
            max((each.end_ns for each in self._offsets), default=stamp_ns),
            self._glide.end_ns if self._glide is not None else stamp_ns,
            is_gliding or (is_timed and stamp_ns - before.end_ns <= _STREAM_NS),
            stamp_ns >= standing.end_ns,
            _NOWHERE if active is None else active.pace,
            getattr(before, "offset", 0.0),
            math.inf if limits is None else limits.fastest,
        )

    def _glide_from(
        self, position: float, stamp_ns: int, pace: Pace, duration: float, fastest: float
    ) -> None:
        """Glide from rest at a position onto the motion, within a duration or slowly enough."""
        onto = self._onto.sample(stamp_ns)
        away = position - onto[0]
        length = glide_time(away, duration, min(_own_speed(pace, away) or math.inf, fastest))
        self._set_glide(position, stamp_ns, length, onto)

    def _glide_onto(
        self, here: _Here, pace: Pace, turns: float, stamp_ns: int, duration: float
    ) -> None:
        """Glide from rest onto a motion that came, and has begun."""
        onto = self._onto.sample(stamp_ns)
        away = here.position - onto[0]
        own = _own_speed(pace, away)
        length = glide_time(away, duration, min(own or math.inf, here.fastest))
        self._offsets = ()
        if own and length > 0.0 and abs(onto[1]) <= _SLOW * own:
            # It has hardly begun: no need to lag behind it for so long.
            self._hull = (
                min(pace.lowest + turns, here.position),
                max(pace.highest + turns, here.position),
            )
            end_ns = stamp_ns + _nanoseconds(length)
            self._offsets = (Offset(away, -onto[1], 0.0, stamp_ns, end_ns),)
            return
        self._set_glide(here.position, stamp_ns, length, onto)

    def _set_glide(
        self, position: float, stamp_ns: int, length: float, onto: Sequence[float]
    ) -> None:
        self._glide = None
        if length > 0.0 and (onto[0] != position or onto[1] != 0.0):
            end_ns = stamp_ns + _nanoseconds(length)
            self._glide = Glide(position, stamp_ns, end_ns, length)

    def _go_on(
        self, here: _Here, pace: Pace, turns: float, stamp_ns: int, duration: float
    ) -> None:
        """Go on with another message: what it moves the motion by, and no more, fades."""
        joined, new = here.joined, self._onto.sample(stamp_ns)
        jump = (joined if here.is_held else here.motion[0]) - new[0]
        self._hull = min(pace.lowest + turns, joined), max(pace.highest + turns, joined)
        if here.is_held or not duration:
            self._offsets = ()
        if not duration:
            return
        speed = min(max(pace.fastest, here.pace.fastest), here.fastest)
        own = _own_speed(pace, here.position - new[0]) or math.inf
        slow = speed or min(own, here.fastest)
        # As the first message of a stream may be slow, so may a glide be that is under way.
        whole = glide_time(here.position - new[0], duration, slow)
        if max(here.glide_end_ns, here.offset_end_ns) > stamp_ns + _nanoseconds(whole):
            self._glide_as_it_moves(here, new, whole, stamp_ns)
            return
        if jump == 0.0:
            return
        length = glide_time(jump, duration, slow)
        if speed:
            least = abs(jump) / speed
            remaining = max((self._onto.end_ns - stamp_ns) * SECONDS_PER_NANOSECOND, least)
            near = min(_PEAK / _GENTLE * least, remaining)
            if near <= length:
                self._fade_jump(jump, 0.0, near, stamp_ns)
                return
        if here.has_ended and self._glide is None:
            self._fade_jump(jump, 0.0, length, stamp_ns)
        elif here.is_held or self._glide is not None:
            self._glide_as_it_moves(here, new, whole, stamp_ns)
        else:
            self._fade_jump(jump, here.motion[1] - new[1], length, stamp_ns)

    def _glide_as_it_moves(
        self, here: _Here, onto: Sequence[float], length: float, stamp_ns: int
    ) -> None:
        """Turn to another motion from where the reference is, as fast as it is."""
        self._glide, position = None, here.position
        self._hull = min(self._hull[0], position), max(self._hull[1], position)
        away, rate = position - onto[0], here.velocity - onto[1]
        self._offsets = (Offset(away, rate, 0.0, stamp_ns, stamp_ns + _nanoseconds(length)),)

    def _fade_jump(self, jump: float, rate: float, length: float, stamp_ns: int) -> None:
        """Add a jump to the offset, and a rate, whose end may only become later."""
        end_ns, offsets = stamp_ns + _nanoseconds(length), list(self._offsets)
        away = under_way = change = 0.0
        if offsets:
            (away, under_way, change), least_ns = offsets[0].sample(stamp_ns), offsets[0].end_ns
            end_ns = max(end_ns, least_ns)
            is_longer = rate != 0.0 or 2 * (end_ns - stamp_ns) > 3 * (least_ns - stamp_ns)
            if is_longer and len(offsets) < _MOST_FADING:
                offsets.insert(1, Offset(0.0, under_way, change, stamp_ns, least_ns))
                under_way = change = 0.0
        if end_ns > stamp_ns:
            newest = Offset(away + jump, under_way + rate, change, stamp_ns, end_ns)
            self._offsets = (newest, *offsets[1:])

    def _approach(
        self, here: _Here, motion: Motion, turns: float, stamp_ns: int, duration: float
    ) -> None:
        """Let fade what the reference is faster than the way to a first point may begin."""
        pace, position = motion.pace, here.position
        first_ns = motion.first_ns(stamp_ns)
        length = (first_ns - stamp_ns) * SECONDS_PER_NANOSECOND
        middle = self._onto.sample((stamp_ns + first_ns) // 2)[1]
        least, most = here.pace.lowest + here.turns, here.pace.highest + here.turns
        if not here.pace.is_bounded:
            least = most = position
        least = min(pace.lowest + turns, position, least)
        most = max(pace.highest + turns, position, most)
        self._hull = least, most
        if abs(middle) > here.fastest:  # it could not follow: there in its own time
            self._reference = shifted(motion.start(stamp_ns, None, 0.0), turns)
            away = position - self._onto.sample(stamp_ns)[0]
            end_ns = stamp_ns + _nanoseconds(glide_time(away, length, here.fastest))
            self._offsets = (Offset(away, here.velocity, 0.0, stamp_ns, end_ns),)
            return
        excess = here.velocity - self._onto.sample(stamp_ns)[1]
        if excess == 0.0:
            return
        length = min(length, duration)
        if here.offset_end_ns > stamp_ns:
            length = min(length, (here.offset_end_ns - stamp_ns) * SECONDS_PER_NANOSECOND)
        explained = _SWING * here.pace.given * length
        room = (most - position if excess > 0.0 else position - least) + explained
        length = min(length, room / (_SWING * abs(excess)))
        self._hull = least - explained, most + explained
        end_ns = stamp_ns + _nanoseconds(length)
        if end_ns > stamp_ns:
            self._offsets = (Offset(0.0, excess, 0.0, stamp_ns, end_ns),)

    @property
    def _onto(self) -> Reference:
        """The motion's own reference."""
        assert self._reference is not None
        return self._reference


def _begin_ns(motion: Motion, now_ns: int) -> int:
    """Return when a motion begins that did not before now, in [ns]."""
    return max(motion.begin_ns, now_ns) if motion.begin_ns else now_ns


def _own_speed(pace: Pace, away: float) -> float:
    """Return how fast a motion was planned to be, in [rad/s]; 0 if nothing tells."""
    return pace.fastest or (abs(away) / pace.lead if pace.lead else 0.0)
