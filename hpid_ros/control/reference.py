"""The reference of a loop, from motion to motion without a jump, and its feedforward."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Protocol

from hpid_ros.base.errors import SettingError
from hpid_ros.base.units import SECONDS_PER_NANOSECOND
from hpid_ros.control.limits import MotionLimits


class FeedforwardGains(NamedTuple):
    r"""What is fed forward.

    .. math:: \tau = J \ddot r + b \dot r + c\,\mathrm{sat}(\dot r / v) + \tau_r

    with the reference r and the effort :math:`\tau_r` that was planned for it.
    """

    inertia: float  # [kg m^2] J
    viscous_friction: float  # [N m s/rad] b
    coulomb_friction: float  # [N m] c
    friction_velocity: float  # [rad/s] v, positive
    uses_planned_effort: bool  # whether planned efforts are added

    @property
    def is_model_based(self) -> bool:
        """Whether anything follows from the reference's velocity and acceleration."""
        return bool(self.inertia or self.viscous_friction or self.coulomb_friction)

    def effort(self, velocity: float, acceleration: float) -> float:
        """Return the effort of inertia and friction, in [N m]."""
        direction = min(max(velocity / self.friction_velocity, -1.0), 1.0)
        return (
            self.inertia * acceleration
            + self.viscous_friction * velocity
            + self.coulomb_friction * direction
        )


class Feedforward:
    """Feeds the effort of a reference forward, and keeps its changes from becoming jumps.

    Where another motion, or a parameter, changes the effort although the reference does not, the
    loop's integral takes the difference, and at a takeover the active effort; what it cannot take
    is kept here, and fades.
    """

    __slots__ = (
        "_fade_begin_ns",
        "_fade_end_ns",
        "_fading",
        "_gains",
        "_last",
        "effort",
        "is_active",
    )

    def __init__(self, gains: FeedforwardGains) -> None:
        self._gains = gains
        self.reset()

    def reset(self) -> None:
        """Forget the past."""
        self.effort = self._fading = 0.0
        self._fade_begin_ns = self._fade_end_ns = 0
        self._last = 0.0, 0.0, 0.0  # velocity, acceleration and planned effort
        self._settle()

    def _settle(self) -> None:
        self.is_active = bool(self._gains.is_model_based or self._last[2] or self._fading)

    def update(self, stamp_ns: int, velocity: float, acceleration: float, planned: float) -> float:
        """Take a sample of the reference and return its effort in [N m]."""
        self._last = velocity, acceleration, planned
        effort = self._effort_by(self._gains)
        if self._fading:
            effort += self._fading_effort(stamp_ns)
        self.effort = effort
        self._settle()
        return effort

    def _effort_by(self, gains: FeedforwardGains) -> float:
        """Return what gains make of the last sample, in [N m]."""
        velocity, acceleration, planned = self._last
        effort = gains.effort(velocity, acceleration)
        return effort + planned if gains.uses_planned_effort else effort

    def _fading_effort(self, stamp_ns: int) -> float:
        """Return what is left of what was kept."""
        left = self._fade_end_ns - stamp_ns
        if left <= 0:
            self._fading = 0.0
            return 0.0
        return self._fading * min(left / (self._fade_end_ns - self._fade_begin_ns), 1.0)

    def change_by(self, planned: float) -> float:
        """Return by how much another motion changes the effort at the same reference, in [N m]."""
        return planned - self._last[2] if self._gains.uses_planned_effort else 0.0

    def retune(self, gains: FeedforwardGains, velocity: float, acceleration: float) -> float:
        """Go by other gains, and return by how much that changes the effort, in [N m]."""
        self._last = velocity, acceleration, self._last[2]
        change = self._effort_by(gains) - self._effort_by(self._gains)
        self._gains = gains
        self.effort += change
        self._settle()
        return change

    def keep(self, effort: float, stamp_ns: int, duration: float) -> None:
        """Add an effort that fades from now on."""
        self.effort += effort
        self._fading = effort + (self._fading_effort(stamp_ns) if self._fading else 0.0)
        self._fade_begin_ns = stamp_ns
        self._fade_end_ns = stamp_ns + max(round(duration / SECONDS_PER_NANOSECOND), 1)
        self._settle()


LARGEST_POSITION = 1e9
"""Positions, velocities and references beyond this [rad, rad/s] are no joint's."""

_HALF = 1e-9  # of a turn: by so little more than half of one it is half of one


class Reference(Protocol):
    """Where the joint should be, on the control clock."""

    def sample(self, stamp_ns: int) -> Sequence[float]:
        """Return position [rad], velocity [rad/s], acceleration [rad/s^2] at an instant [ns]."""

    def effort(self, stamp_ns: int) -> float:
        """Return the effort that was planned for an instant [ns], in [N m]; 0 if none was."""


class Motion(Protocol):
    """What a loop can be told to do: it becomes a reference when the loop takes it over."""

    @property
    def gives_effort(self) -> bool:
        """Whether it says which effort it needs."""

    @property
    def goes_by_time(self) -> bool:
        """Whether it moves by itself, with the clock."""

    def start(self, now_ns: int, position: float, velocity: float) -> Reference:
        """Take over from where the reference stands; see ``Column.start``."""

    def is_under_way(self, now_ns: int) -> bool:
        """Return whether it began before an instant, so that taking it over would jump."""

    def target(self, now_ns: int) -> float:
        """Return the position that it leads to first, or has now if it is under way, in [rad]."""


@dataclass(frozen=True)
class Setpoint:
    """Hold one position."""

    position: float  # [rad]
    goes_by_time: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if not -LARGEST_POSITION <= self.position <= LARGEST_POSITION:
            raise SettingError(
                f"a setpoint must be finite and within {LARGEST_POSITION:g} rad, "
                f"not {self.position}"
            )

    @property
    def gives_effort(self) -> bool:
        """Return False."""
        return False

    def start(self, now_ns: int, position: float, velocity: float) -> Setpoint:
        """Return itself: a setpoint is the same at all times."""
        return self

    def is_under_way(self, now_ns: int) -> bool:
        """Return False: whoever sends a setpoint means a step."""
        return False

    def target(self, now_ns: int) -> float:
        """Return the position."""
        return self.position

    def sample(self, stamp_ns: int) -> tuple[float, float, float]:
        """Return the position at rest."""
        return self.position, 0.0, 0.0

    def effort(self, stamp_ns: int) -> float:
        """Return 0."""
        return 0.0


@dataclass(frozen=True)
class ShiftedReference:
    """Another reference, whole turns away."""

    onto: Reference  # the other reference
    offset: float  # [rad] how much further this one is

    def sample(self, stamp_ns: int) -> tuple[float, float, float]:
        """Return the reference at an instant."""
        position, velocity, acceleration = self.onto.sample(stamp_ns)
        return position + self.offset, velocity, acceleration

    def effort(self, stamp_ns: int) -> float:
        """Return that of the other reference."""
        return self.onto.effort(stamp_ns)


class Glide:
    r"""A reference that begins where the joint is and ends on another one.

    The difference at the start, :math:`\delta` in position and :math:`\dot\delta` in velocity,
    fades with the quintics that have no acceleration at either end, over :math:`s \in [0, 1]`:

    .. math::
        \delta\,(1 - 10 s^3 + 15 s^4 - 6 s^5) + \dot\delta\,T\,(s - 6 s^3 + 8 s^4 - 3 s^5)
    """

    def __init__(
        self, onto: Reference, now_ns: int, position: float, velocity: float, duration: float
    ) -> None:
        target = onto.sample(now_ns)
        self.onto = onto
        self._begin_ns = now_ns
        self._duration = duration
        self.end_ns = now_ns + round(duration / SECONDS_PER_NANOSECOND)
        self._offset = position - target[0]
        self._carried = (velocity - target[1]) * duration

    def effort(self, stamp_ns: int) -> float:
        """Return that of the reference to end on."""
        return self.onto.effort(stamp_ns)

    def sample(self, stamp_ns: int) -> tuple[float, float, float]:
        """Return the reference at an instant."""
        position, velocity, acceleration = self.onto.sample(stamp_ns)
        if not self._begin_ns <= stamp_ns < self.end_ns:
            return position, velocity, acceleration
        T, a, b = self._duration, self._offset, self._carried
        s = (stamp_ns - self._begin_ns) * SECONDS_PER_NANOSECOND / T
        squared = s * s
        cubed = squared * s
        return (
            position
            + a * (1.0 - cubed * (10.0 - 15.0 * s + 6.0 * squared))
            + b * (s - cubed * (6.0 - 8.0 * s + 3.0 * squared)),
            velocity
            + a / T * (-30.0 * squared * (1.0 - 2.0 * s + squared))
            + b / T * (1.0 - squared * (18.0 - 32.0 * s + 15.0 * squared)),
            acceleration
            + a / (T * T) * (-60.0 * s * (1.0 - 3.0 * s + 2.0 * squared))
            + b / (T * T) * (-s * (36.0 - 96.0 * s + 60.0 * squared)),
        )


class Following:
    """Turns motions into the reference of each sample."""

    __slots__ = (
        *("_glide_end_ns", "_is_first", "_pending", "_reference"),
        *(
            "acceleration",
            "gives_effort",
            "has_new_motion",
            "has_waited",
            "encoder_turn",
            "motion",
            "position",
            "turn",
            "velocity",
        ),
    )

    def __init__(self) -> None:
        self.motion: Motion | None = None
        self.has_waited = False  # a setpoint, for the first state or a takeover
        self.turn = self.encoder_turn = 0.0
        self.restart()

    @property
    def has_reference(self) -> bool:
        """Whether there is a reference; the first state makes one."""
        return self._reference is not None

    def follow(self, motion: Motion | None) -> None:
        """Follow a motion from the next sample on; None forgets what was followed."""
        self.motion = self._pending = motion
        self.has_waited = False

    def restart(self) -> None:
        """Forget where the reference stands, and start the motion again."""
        self._pending = self.motion
        self.has_waited = isinstance(self.motion, Setpoint)
        self._reference: Reference | None = None
        self._glide_end_ns: int | None = None
        self._is_first = True
        self.gives_effort = self.has_new_motion = False
        self.position = self.velocity = self.acceleration = 0.0

    def stand(self, position: float) -> None:
        """Hold a position until there is a motion."""
        self._reference, self._glide_end_ns = Setpoint(position), None
        self.position, self.velocity, self.acceleration = position, 0.0, 0.0

    def end_timed_motion(self) -> None:
        """Stay where the reference stands if a motion that has begun goes by time."""
        if self.motion is not None and self._pending is None and self.motion.goes_by_time:
            self.motion = self._reference = Setpoint(self.position)
            self._glide_end_ns = None

    def take_over(self, stamp_ns: int, position: float, duration: float) -> None:
        """Start from a position again, and glide onto what is followed."""
        onto = self._onto()
        self.stand(position)
        self.has_waited = isinstance(self._pending, Setpoint)
        if self.motion is not None and self._pending is None:
            away = self.position - onto.sample(stamp_ns)[0]
            onto = _shifted(onto, whole_turns(away, self.turn))
            self._glide(onto, stamp_ns, position, 0.0, duration)

    def sample(
        self, stamp_ns: int, duration: float, limits: MotionLimits | None
    ) -> Sequence[float]:
        """Return the reference of a sample: position, velocity and acceleration.

        There must be a reference, see :attr:`has_reference`.
        """
        if self._pending is not None:
            self._begin(self._pending, stamp_ns, duration, limits)
        elif self._glide_end_ns is not None and stamp_ns >= self._glide_end_ns:
            self._reference, self._glide_end_ns = self._onto(), None
        wanted = self._reference.sample(stamp_ns)  # type: ignore[union-attr]
        position, velocity, acceleration = wanted
        if limits is not None:
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

    def _begin(
        self, motion: Motion, stamp_ns: int, duration: float, limits: MotionLimits | None
    ) -> None:
        """Turn to a motion: from where the reference stands, or onto it if it is under way."""
        before = self._reference
        assert before is not None
        self._pending = None
        self.gives_effort, self.has_new_motion = motion.gives_effort, True
        is_under_way, turn = motion.is_under_way(stamp_ns), self.turn
        if self._is_first and is_under_way:
            turn = turn or self.encoder_turn
        self._is_first = False
        position, velocity, _ = before.sample(stamp_ns)
        if limits is not None:  # or a glide from beyond a stop would leave it at full speed
            position, velocity = limits.reference(position, velocity)
        offset = whole_turns(position - motion.target(stamp_ns), turn) if turn else 0.0
        onto = _shifted(motion.start(stamp_ns, position - offset, velocity), offset)
        self._reference, self._glide_end_ns = onto, None
        if is_under_way or self.has_waited:
            self._glide(onto, stamp_ns, position, velocity, duration)

    def _onto(self) -> Reference:
        """Return the reference that is followed in the end."""
        reference = self._reference
        assert reference is not None
        return reference.onto if isinstance(reference, Glide) else reference

    def _glide(
        self, onto: Reference, stamp_ns: int, position: float, velocity: float, duration: float
    ) -> None:
        """Follow a reference, gliding onto it if it is elsewhere."""
        self._reference, self._glide_end_ns = onto, None
        if duration > 0.0 and tuple(onto.sample(stamp_ns)[:2]) != (position, velocity):
            glide = Glide(onto, stamp_ns, position, velocity, duration)
            self._reference, self._glide_end_ns = glide, glide.end_ns


def whole_turns(away: float, turn: float) -> float:
    """Return the whole turns that are in a distance, so that what is left is half of one at most.

    Where just half a turn is left it leads the way that was told, as ``wraparound_joint`` of
    joint_trajectory_controller has it.
    """
    if not turn:
        return 0.0
    turns = away / turn
    return math.copysign(turn * max(math.ceil(abs(turns) - 0.5 - _HALF), 0), turns)


def _shifted(onto: Reference, offset: float) -> Reference:
    """Return a reference so many rad further."""
    if offset == 0.0:
        return onto
    if isinstance(onto, ShiftedReference):
        return ShiftedReference(onto.onto, onto.offset + offset)
    return ShiftedReference(onto, offset)
