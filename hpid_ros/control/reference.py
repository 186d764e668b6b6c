"""What a loop can be told to follow, and the feedforward of a reference."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Protocol

from hpid_ros.base.errors import EndedError, SettingError, TrajectoryError
from hpid_ros.base.units import NANOSECONDS, SECONDS_PER_NANOSECOND


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

    @property
    def steady_effort(self) -> float:
        """What the last sample would need without its acceleration, in [N m]."""
        return self.effort - self._gains.inertia * self._last[1]

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

    @property
    def end_ns(self) -> int:
        """The instant from which on it rests, in [ns]."""

    def sample(self, stamp_ns: int) -> Sequence[float]:
        """Return position [rad], velocity [rad/s], acceleration [rad/s^2] at an instant [ns]."""

    def effort(self, stamp_ns: int) -> float:
        """Return the effort that was planned for an instant [ns], in [N m]; 0 if none was."""


class Pace(NamedTuple):
    """How fast a motion is, and where it leads: what a glide onto it goes by."""

    fastest: float = 0.0  # [rad/s] its largest velocity; 0 where it has none
    given: float = 0.0  # [rad/s] the largest velocity that its points were given
    lowest: float = -math.inf  # [rad] no position of it is lower
    highest: float = math.inf  # [rad] no position of it is higher
    lead: float = 0.0  # [s] planned for the way to a motion's only point

    @property
    def is_bounded(self) -> bool:
        """Whether it is known where it leads."""
        return self.lowest > -math.inf


LONGEST_WAIT = 3600
"""A trajectory may start so much later than the newest state, in [s]."""

GRACE_NS = NANOSECONDS
"""A trajectory on a topic may have ended so long ago: in a stream some come late, in [ns]."""

LATCHED_WITHIN = 3.0
"""So soon after a controller's first state it receives what is latched, if anything is, in [s]."""


def require_timely(what: str, window_ns: tuple[int, int], now_ns: int, late_ns: int = 0) -> None:
    """Refuse what has ended by the clock of the states, or starts too far ahead of it.

    Source: ``ros2_controllers``, ``joint_trajectory_controller``, function
    ``validate_trajectory_msg``, for what ends in the past.
    """
    start_ns, end_ns = window_ns
    if end_ns + late_ns < now_ns:
        raise EndedError(
            f"{what} ended at {_seconds(end_ns)} s, in the past: the stamps of joint_states "
            f"say {_seconds(now_ns)} s"
        )
    if start_ns > now_ns + LONGEST_WAIT * NANOSECONDS:
        raise TrajectoryError(
            f"{what} must start within {LONGEST_WAIT} s, not at {_seconds(start_ns)} s: the "
            f"stamps of joint_states say {_seconds(now_ns)} s"
        )


def _seconds(instant_ns: int) -> str:
    return f"{instant_ns / NANOSECONDS:.3f}"


class Motion(Protocol):
    """What a loop can be told to do: it becomes a reference when the loop takes it over."""

    @property
    def window_ns(self) -> tuple[int, int] | None:
        """Start and end on the control clock in [ns]; None if it begins with the next state."""

    @property
    def gives_effort(self) -> bool:
        """Whether it says which effort it needs."""

    @property
    def goes_by_time(self) -> bool:
        """Whether it moves by itself, with the clock."""

    @property
    def begin_ns(self) -> int:
        """The instant until which it leaves alone what runs, in [ns]; 0 for at once."""

    @property
    def pace(self) -> Pace:
        """How fast it is, and where it leads."""

    def start(self, now_ns: int, position: float | None, velocity: float) -> Reference:
        """Take over from where the reference stands; see ``Column.start``."""

    def is_under_way(self, now_ns: int) -> bool:
        """Return whether it began before an instant, so that taking it over would jump."""

    def target(self, now_ns: int) -> float:
        """Return the position that it leads to first, or has now if it is under way, in [rad]."""

    def first_ns(self, now_ns: int) -> int:
        """Return the instant of its first point if it starts now, in [ns]."""


@dataclass(frozen=True)
class Setpoint:
    """Hold one position."""

    position: float  # [rad]
    goes_by_time: ClassVar[bool] = False
    begin_ns: ClassVar[int] = 0
    end_ns: ClassVar[int] = 0
    window_ns: ClassVar[None] = None

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

    @property
    def pace(self) -> Pace:
        """Return that of a motion that rests."""
        return Pace(lowest=self.position, highest=self.position)

    def start(self, now_ns: int, position: float | None, velocity: float) -> Setpoint:
        """Return itself: a setpoint is the same at all times."""
        return self

    def is_under_way(self, now_ns: int) -> bool:
        """Return False: whoever sends a setpoint means a step."""
        return False

    def target(self, now_ns: int) -> float:
        """Return the position."""
        return self.position

    def first_ns(self, now_ns: int) -> int:
        """Return now."""
        return now_ns

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

    @property
    def end_ns(self) -> int:
        """That of the other reference."""
        return self.onto.end_ns

    def sample(self, stamp_ns: int) -> tuple[float, float, float]:
        """Return the reference at an instant."""
        position, velocity, acceleration = self.onto.sample(stamp_ns)
        return position + self.offset, velocity, acceleration

    def effort(self, stamp_ns: int) -> float:
        """Return that of the other reference."""
        return self.onto.effort(stamp_ns)


def whole_turns(away: float, turn: float) -> float:
    """Return the whole turns that are in a distance, so that what is left is half of one at most.

    Where just half a turn is left it leads the way that was told, as ``wraparound_joint`` of
    joint_trajectory_controller has it.
    """
    if not turn:
        return 0.0
    turns = away / turn
    return math.copysign(turn * max(math.ceil(abs(turns) - 0.5 - _HALF), 0), turns)


def shifted(onto: Reference, offset: float) -> Reference:
    """Return a reference so many rad further."""
    if offset == 0.0:
        return onto
    if isinstance(onto, ShiftedReference):
        return ShiftedReference(onto.onto, onto.offset + offset)
    return ShiftedReference(onto, offset)
