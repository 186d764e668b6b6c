r"""Motions that identify a joint, within shares of its limits: excitations and relays.

Of a relay the size follows from the harmonic balance of a double integrator under a relay of
amplitude a with hysteresis h on :math:`e + T \dot e`, without delay: a cycle of the rate
:math:`\omega` has the amplitude :math:`A = 4 a / (\pi m \omega^2)` and needs
:math:`h = A\,T\,\omega`. Delay, and an inertia that is not the one that was taken, make it
larger; ``deviation`` ends it then.

Sources: M. R. Schroeder, "Synthesis of low-peak-factor signals and binary sequences with low
autocorrelation", IEEE Transactions on Information Theory 16, 1970 (the first phases that are
tried); J. Swevers et al., "Optimal robot excitation and identification", IEEE Transactions on
Robotics and Automation 13, 1997 (sums of sines within the joint's limits); T. Flash and N. Hogan,
"The coordination of arm movements", Journal of Neuroscience 5, 1985 (minimum jerk).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.interpolate import BPoly

from hpid_ros.base.errors import SettingError
from hpid_ros.base.units import NANOSECONDS, Numbers
from hpid_ros.control.overrides import LONGEST_RELAY, RAMP, RelayRequest

_DRAWS = 48  # of phases, besides Schroeder's
_LINES = 8  # sines in a sum
_SHORTEST_MOVE = 0.1  # [s]
_MOVE_KNOTS = 12  # in each step
_LEVELS = (1.0, -1.0, 0.5, -0.5, 0.0)
_PEAK_VELOCITY, _PEAK_ACCELERATION = 1.875, 10.0 / math.sqrt(3.0)  # of a minimum jerk step of 1

DWELL = 0.5
"""After each step in [s]."""

KNOTS_A_PERIOD = 20
"""Of the fastest sine; a quintic between them is off by 1e-5 of it."""


class Peaks(NamedTuple):
    """Largest absolute values; "rad" reads "m" where the joint slides."""

    position: float  # [rad] away from where the joint stood
    velocity: float  # [rad/s]
    acceleration: float  # [rad/s^2]


class Course(NamedTuple):
    """Reference of a joint, from where it stood; knots of a quintic spline."""

    times: Numbers  # [s] since its start, shape (knots,)
    position: Numbers  # [rad]
    velocity: Numbers  # [rad/s]
    acceleration: Numbers  # [rad/s^2]

    @property
    def peaks(self) -> Peaks:
        """Largest absolute values."""
        return Peaks(*(float(np.max(np.abs(each))) for each in self[1:]))

    @property
    def crest_factor(self) -> float:
        """Largest velocity over its root mean square; of one sine it is 1.41, at rest 0."""
        mean = float(np.sqrt(np.mean(self.velocity**2)))
        return self.peaks.velocity / mean if mean else 0.0

    def scaled(self, factor: float) -> Course:
        """Return it so many times as large."""
        return Course(self.times, *(factor * each for each in self[1:]))

    def factor_within(self, limits: Peaks) -> float:
        """Return how many times as large it may be."""
        return min(limit / peak for limit, peak in zip(limits, self.peaks, strict=True))


def multisine(
    duration: float, band: tuple[float, float], fade: float, limits: Peaks, seed: int = 0
) -> Course:
    """Return the largest sum of sines within limits, of the phases that are tried.

    Its sines are harmonics of the whole, spread evenly over the logarithm of the frequency, each
    with the same velocity: friction shows at the slow ones, inertia at the fast ones.
    """
    low, high = band
    if not 0.0 < low < high < math.inf:
        raise SettingError(
            f"frequencies must be two positive numbers, the lower first, not {low:g} and {high:g}"
        )
    if not (math.isfinite(duration) and duration >= max(2.5 * fade, 1.0 / low)):
        least = max(2.5 * fade, 1.0 / low)
        raise SettingError(
            f"a sum of sines from {low:g} Hz on must last {least:g} s at least, not {duration:g}"
        )
    base = 1.0 / duration
    turns = np.unique(np.rint(np.geomspace(low / base, high / base, _LINES)).clip(1))
    knots = math.ceil(duration * turns[-1] * base * KNOTS_A_PERIOD) + 1
    times = np.linspace(0.0, duration, knots)
    window = faded(times, fade)
    count = len(turns)
    draw = np.random.default_rng(seed)
    schroeder = -np.pi * np.arange(count) * (np.arange(count) + 1) / count
    tried = [schroeder, *draw.uniform(0.0, 2.0 * np.pi, (_DRAWS, count))]
    courses = [_sum(times, 2.0 * np.pi * base * turns, phases, window) for phases in tried]
    # The largest by its root mean square velocity within the limits.
    sizes = [each.factor_within(limits) * np.sqrt(np.mean(each.velocity**2)) for each in courses]
    course = courses[int(np.argmax(sizes))]
    return course.scaled(course.factor_within(limits))


def _sum(times: Numbers, rates: Numbers, phases: Numbers, window: Course) -> Course:
    """Return sines of one velocity each, in a window; product rule for the derivatives."""
    angles = np.outer(times, rates) + phases
    wave = np.sum(np.sin(angles) / rates, axis=1)
    rate = np.sum(np.cos(angles), axis=1)
    bend = -np.sum(np.sin(angles) * rates, axis=1)
    w, dw, ddw = window[1:]
    return Course(times, w * wave, dw * wave + w * rate, ddw * wave + 2.0 * dw * rate + w * bend)


def faded(times: Numbers, fade: float) -> Course:
    """Return a window that rises from 0 to 1 in the time of a fade, and falls at the end."""
    end = float(times[-1])
    up = _minimum_jerk(times / fade, fade)
    down = _minimum_jerk((end - times) / fade, fade)
    return Course(
        times,
        up.position * down.position,
        up.velocity - down.velocity,  # nowhere do both move: the course is longer than two fades
        up.acceleration + down.acceleration,
    )


def _minimum_jerk(s: Numbers, duration: float) -> Course:
    """Return a step from 0 to 1 over s in [0, 1], with derivatives by time."""
    s = np.clip(s, 0.0, 1.0)
    return Course(
        s * duration,
        s**3 * (10.0 - 15.0 * s + 6.0 * s * s),
        30.0 * s**2 * (1.0 - s) ** 2 / duration,
        60.0 * s * (1.0 - s) * (1.0 - 2.0 * s) / duration**2,
    )


def steps(duration: float, limits: Peaks) -> Course:
    """Return steps up and down, each of minimum jerk and as fast as limits allow, with rests."""
    pattern = [move_time(abs(b - a), limits) for a, b in pairwise((0.0, *_LEVELS))]
    whole = sum(pattern) + DWELL * len(pattern)
    if not (math.isfinite(duration) and duration >= whole):
        raise SettingError(f"these steps must last {whole:.3g} s at least, not {duration:g}")
    parts = [Course(*(np.zeros(1) for _ in range(4)))]
    level, begin = 0.0, 0.0
    for wanted in _LEVELS * int(duration / whole):
        move = move_time(abs(wanted - level), limits)
        parts += moved(begin, move, level * limits.position, wanted * limits.position)
        level, begin = wanted, begin + move + DWELL
    return Course(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def move_time(levels: float, limits: Peaks) -> float:
    """Return the least time of a step over so many amplitudes, in [s]."""
    distance = levels * limits.position
    return max(
        _PEAK_VELOCITY * distance / limits.velocity,
        math.sqrt(_PEAK_ACCELERATION * distance / limits.acceleration),
        _SHORTEST_MOVE,
    )


def longest_move(duration: float, limits: Peaks) -> float:
    """Return how far a step of so many seconds may go, in [rad]."""
    return min(
        limits.position,
        limits.velocity * duration / _PEAK_VELOCITY,
        limits.acceleration * duration**2 / _PEAK_ACCELERATION,
    )


def moved(
    begin: float, move: float, start: float, end: float, dwell: float = DWELL
) -> list[Course]:
    """Return the knots after the first one of a step, and the one at the end of its rest."""
    rise = _minimum_jerk(np.linspace(0.0, 1.0, _MOVE_KNOTS + 1)[1:], move)
    way = end - start
    moving = Course(begin + rise.times, start + way * rise[1], way * rise[2], way * rise[3])
    rest = np.zeros(1)
    return [moving, Course(rest + begin + move + dwell, rest + end, rest, rest)]


_DAMPING_RATIO = 1.0  # of the loop that gains are taken to be tuned for
_UNSEEN_VELOCITY, _UNSEEN_ACCELERATION = 1.0, 5.0  # [rad/s, rad/s^2] where nothing is known


@dataclass(frozen=True)
class JointBounds:
    """Limits of a joint and where it is; "rad" reads "m" where it slides."""

    joint: str  # its name
    controller: str  # full name of its controller's node
    position: float  # [rad] where it is
    load: float  # [N m] effort that holds it there
    lower: float  # [rad] lowest position; -inf for none
    upper: float  # [rad] highest position; inf for none
    velocity: float  # [rad/s] largest velocity; inf if unknown
    efforts: tuple[float, float]  # [N m] least and largest effort; infinite if unknown
    inertia: float  # [kg m^2] what one unit of effort accelerates
    is_inertia_guessed: bool = False  # whether that was taken from the gains
    is_slide: bool = False  # whether it slides
    is_endless: bool = False  # whether it turns without end

    @property
    def unit(self) -> str:
        """Of its position."""
        return "m" if self.is_slide else "rad"


class Wish(NamedTuple):
    """What an excitation shall not exceed, besides shares of the limits."""

    # of each limit, of what is left of it where the joint is and how it is loaded
    share: float = 0.5
    amplitude: float = 0.5  # [rad]
    velocity: float = math.inf  # [rad/s] inf for no wish
    acceleration: float = math.inf  # [rad/s^2] inf for no wish

    def require(self) -> None:
        if not 0.0 < self.share <= 0.9:
            raise SettingError(f"a share of the limits must be in (0, 0.9], not {self.share:g}")
        for name, value in self._asdict().items():
            if name != "share" and not value > 0.0:
                raise SettingError(f"the largest {name} must be positive, not {value:g}")


def inertia_from_gains(p: float, d: float) -> float:
    """Return the inertia at which gains make a loop of damping ratio 1: d^2 / (4 p).

    Whoever tuned a PD loop gave it a damping ratio of about 1, so this is the inertia to an order
    of magnitude; it decides about nothing but the size of an excitation.
    """
    if not (p > 0.0 and d > 0.0):
        raise SettingError("the inertia is unknown, and gains.p and gains.d are not both positive")
    return d * d / (4.0 * _DAMPING_RATIO**2 * p)


def allowed(bounds: JointBounds, wish: Wish) -> tuple[Peaks, tuple[str, ...]]:
    """Return what an excitation of a joint may reach, and what was assumed."""
    notes = []
    room = min(bounds.upper - bounds.position, bounds.position - bounds.lower)
    if not room > 0.0:
        raise SettingError(
            f"{bounds.joint} is at {bounds.position:.4g} {bounds.unit}, beyond its limits of "
            f"{bounds.lower:.4g} and {bounds.upper:.4g} {bounds.unit}"
        )
    velocity, acceleration = min(wish.share * bounds.velocity, wish.velocity), wish.acceleration
    if math.isinf(velocity):
        velocity = _UNSEEN_VELOCITY
        notes.append(f"no velocity limit is known: {velocity:g} {bounds.unit}/s is taken")
    least, largest = bounds.efforts
    spare = wish.share * min(largest - bounds.load, bounds.load - least)
    if not spare > 0.0:
        raise SettingError(
            f"{bounds.joint} is held by {bounds.load:.4g}, its effort limits are {least:.4g} and "
            f"{largest:.4g}: there is nothing left to move it"
        )
    acceleration = min(acceleration, spare / bounds.inertia)
    if math.isinf(acceleration):
        acceleration = _UNSEEN_ACCELERATION
        notes.append(f"no effort limit is known: {acceleration:g} {bounds.unit}/s^2 is taken")
    elif bounds.is_inertia_guessed and not math.isinf(spare):
        unit = "kg" if bounds.is_slide else "kg m^2"
        notes.append(f"its inertia is taken from its gains, {bounds.inertia:.3g} {unit}")
    amplitude = min(wish.share * room, wish.amplitude)
    return Peaks(amplitude, velocity, acceleration), tuple(notes)


_LEAST_DWELL = 0.2  # [s]
_LONGEST_DWELL = 0.2  # of the time for one way
_FADE_SHARE = 0.4  # of the whole, at most: two fades and what is between them


def there_and_back(duration: float, limits: Peaks, *, is_fast: bool) -> Course:
    """Return a move of minimum jerk to the amplitude, a rest, the way back, and a rest."""
    fastest = move_time(1.0, limits)
    half = 0.5 * duration
    least = (fastest if is_fast else 0.0) + _LEAST_DWELL
    if not (math.isfinite(duration) and half >= 1.01 * least):
        raise SettingError(f"this must last {2.02 * least:.3g} s at least, not {duration:g}")
    move = fastest if is_fast else half - min(DWELL, max(_LEAST_DWELL, _LONGEST_DWELL * half))
    dwell = half - move
    size = longest_move(move, limits)
    start = [Course(*(np.zeros(1) for _ in range(4)))]
    parts = start + moved(0.0, move, 0.0, size, dwell) + moved(half, move, size, 0.0, dwell)
    return Course(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def sine_excitation(duration: float, frequency: float, fade: float, limits: Peaks) -> Course:
    """Return whole periods, at least one, of a sine with a soft start and a soft end."""
    for name, value in (("duration", duration), ("frequency", frequency), ("fade", fade)):
        if not 0.0 < value < math.inf:
            raise SettingError(f"the {name} of a sine must be positive, not {value:g}")
    periods = max(1, round(duration * frequency))
    whole = periods / frequency
    fade = min(fade, _FADE_SHARE * whole)
    knots = math.ceil(KNOTS_A_PERIOD * max(periods, whole / fade)) + 1
    times = np.linspace(0.0, whole, knots)
    rate = 2.0 * math.pi * frequency
    wave, slope = np.sin(rate * times), rate * np.cos(rate * times)
    w, dw, ddw = faded(times, fade)[1:]
    course = Course(
        times, w * wave, dw * wave + w * slope, ddw * wave + 2.0 * dw * slope - w * rate**2 * wave
    )
    return course.scaled(course.factor_within(limits))


_LEAD = 0.5  # [s] at rest, until every controller has taken the trajectory up
_BETWEEN = 1.0  # [s] between joints that are excited one after the other
_MOST_KNOTS = 45_000  # controllers take 50 000 points
_TOLERANCE_SHARE, _LEAST_TOLERANCE = 0.5, 0.02  # of the amplitude; [rad]
_STANDS_WITHIN = 1e-9  # [rad]
_RUNAWAY, _VELOCITY_NOISE = 2.0, 0.2  # of the planned velocity; [rad/s]


Kind = Literal["multisine", "steps", "step", "minimum_jerk", "sine"]


class Design(NamedTuple):
    """What kind of excitation it shall be."""

    kind: Kind = "multisine"  # sums of sines, or steps, as large as they may be
    duration: float = 20.0  # [s] of each joint, or of all that move together
    band: tuple[float, float] = (0.1, 2.5)  # [Hz] of the sines
    fade: float = 2.0  # [s] of their soft start and soft end
    are_together: bool = False  # whether all joints move at once
    tolerance: float = 0.0  # [rad] how far a joint may be from its reference
    seed: int = 0  # of the phases; the joints have different ones
    frequency: float = 0.5  # [Hz] of the one sine


@dataclass(frozen=True)
class PlannedJoint:
    """Excitation of one joint; "rad" reads "m" where it slides."""

    bounds: JointBounds  # its limits
    begin: float  # [s] when it begins to move
    end: float  # [s] when it has stopped
    peaks: Peaks  # what its reference reaches
    effort: float  # [N m] what that needs besides the load, by its inertia
    crest_factor: float  # of its velocity
    tolerance: float  # [rad] how far it may be from its reference
    velocity_stop: float  # [rad/s] above which it is stopped
    notes: tuple[str, ...] = ()  # what was assumed


@dataclass(frozen=True, eq=False)
class ExcitationPlan:
    """A plan; the reference begins and ends where the references stand."""

    joints: tuple[PlannedJoint, ...]  # in the order of the columns
    times: Numbers  # [s] of the knots since the start, shape (knots,)
    positions: Numbers  # [rad] away from where each joint stands, shape (knots, joints)
    velocities: Numbers  # [rad/s] likewise
    accelerations: Numbers  # [rad/s^2] likewise

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(each.bounds.joint for each in self.joints)

    @property
    def duration(self) -> float:
        """In [s]."""
        return float(self.times[-1])

    @property
    def begin(self) -> float:
        """When the first joint begins to move, in [s]."""
        return min(each.begin for each in self.joints)

    @property
    def end(self) -> float:
        """When the last joint's motion ends, with its rest, in [s]."""
        return max(each.end for each in self.joints)

    @property
    def rests_at(self) -> float:
        """When the last joint's reference comes to its rest, in [s]."""
        moves = np.any(np.abs(self.positions - self.positions[-1]) > _STANDS_WITHIN, axis=1)
        return float(self.times[min(int(np.flatnonzero(moves)[-1]) + 1, len(self.times) - 1)])

    def as_mapping(self) -> dict[str, Any]:
        """Return it as what JSON can hold."""
        arrays = ("times", "positions", "velocities", "accelerations")
        return {
            "joints": [asdict(each) for each in self.joints],
            **{name: getattr(self, name).tolist() for name in arrays},
        }

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> ExcitationPlan:
        try:
            joints = tuple(_planned(each) for each in values["joints"])
            names = ("times", "positions", "velocities", "accelerations")
            return cls(joints, *(np.array(values[name], dtype=float) for name in names))
        except (KeyError, TypeError, ValueError) as error:
            raise SettingError(f"this is no plan of an excitation: {error!r}") from None


def _planned(values: Mapping[str, Any]) -> PlannedJoint:
    bounds = JointBounds(**{**values["bounds"], "efforts": tuple(values["bounds"]["efforts"])})
    kept = {**values, "bounds": bounds, "peaks": Peaks(*values["peaks"])}
    return PlannedJoint(**{**kept, "notes": tuple(values["notes"])})


def plan(bounds: Sequence[JointBounds], wish: Wish, design: Design) -> ExcitationPlan:
    """Return the largest excitation of joints within shares of their limits."""
    wish.require()
    fastest = {"multisine": design.band[1], "sine": design.frequency}.get(design.kind, 0.0)
    turns = 1 if design.are_together else len(bounds)
    _require_few(KNOTS_A_PERIOD * design.duration * fastest * turns)
    limits, notes = zip(*(allowed(each, wish) for each in bounds), strict=True)
    courses = [_course(each, design, number) for number, each in enumerate(limits)]
    begins, begin = [], _LEAD
    for course in courses:
        begins.append(begin)
        if not design.are_together:
            begin += float(course.times[-1]) + _BETWEEN
    joints = [
        _planned_joint(*each, design.tolerance)
        for each in zip(bounds, notes, courses, begins, strict=True)
    ]
    return _laid_out(joints, courses, begins)


def plan_return(
    bounds: Sequence[JointBounds], ways: Sequence[float], wish: Wish
) -> ExcitationPlan:
    """Return a move of minimum jerk of all joints together by so much each, in [rad] or [m]."""
    limits, notes = zip(*(allowed(each, wish) for each in bounds), strict=True)
    move = max(
        move_time(1.0, each._replace(position=abs(way)))
        for each, way in zip(limits, ways, strict=True)
    )
    start = Course(*(np.zeros(1) for _ in range(4)))
    courses = [
        Course(*map(np.concatenate, zip(start, *moved(0.0, move, 0.0, way), strict=True)))
        for way in ways
    ]
    begins = [_LEAD] * len(courses)
    planned = zip(bounds, notes, courses, begins, strict=True)
    return _laid_out([_planned_joint(*each, 0.0) for each in planned], courses, begins)


def _require_few(knots: float) -> None:
    if knots > _MOST_KNOTS:
        raise SettingError(
            f"this excitation has {knots:.0f} knots, {_MOST_KNOTS} are allowed: shorten it, "
            f"lower its highest frequency, or take fewer joints at a time"
        )


def _course(peaks: Peaks, design: Design, number: int) -> Course:
    duration = design.duration
    match design.kind:
        case "steps":
            return steps(duration, peaks)
        case "step" | "minimum_jerk":
            return there_and_back(duration, peaks, is_fast=design.kind == "step")
        case "sine":
            return sine_excitation(duration, design.frequency, design.fade, peaks)
    return multisine(duration, design.band, design.fade, peaks, design.seed + number)


def _planned_joint(
    bounds: JointBounds,
    notes: tuple[str, ...],
    course: Course,
    begin: float,
    tolerance: float,
) -> PlannedJoint:
    peaks = course.peaks
    chosen = tolerance or max(_TOLERANCE_SHARE * peaks.position, _LEAST_TOLERANCE)
    return PlannedJoint(
        bounds,
        begin,
        begin + float(course.times[-1]),
        peaks,
        bounds.inertia * peaks.acceleration,
        course.crest_factor,
        chosen,
        min(bounds.velocity, _RUNAWAY * peaks.velocity + _VELOCITY_NOISE),
        notes,
    )


def _laid_out(
    joints: Sequence[PlannedJoint], courses: Sequence[Course], begins: Sequence[float]
) -> ExcitationPlan:
    """Put all courses onto one grid of whole nanoseconds, on which they are the same quintics."""
    knots = [begin + each.times for begin, each in zip(begins, courses, strict=True)]
    grid = np.unique(np.rint(np.concatenate([np.zeros(1), *knots]) * NANOSECONDS)) / NANOSECONDS
    _require_few(len(grid))
    columns = []
    for begin, each in zip(begins, courses, strict=True):
        spline = BPoly.from_derivatives(each.times, np.stack(each[1:], axis=1))
        at = np.clip(grid - begin, 0.0, each.times[-1])
        columns.append([spline(at), spline.derivative()(at), spline.derivative(2)(at)])
    arrays = (np.stack(each, axis=1) for each in zip(*columns, strict=True))
    return ExcitationPlan(tuple(joints), grid, *arrays)


_FOUR_OVER_PI = 4.0 / math.pi
_VELOCITY_SHARE = 0.3  # of the velocity limit
_SAMPLES = 16  # in a cycle, at least
_ROOM = 4.0  # amplitudes that the error may reach
_ROOM_SHARE = 0.8  # of the way to the nearer stop
_MORE_CYCLES, _SLOWER = 3, 4.0  # until the cycle stays; than was taken


class RelayWish(NamedTuple):
    """What a relay shall be like."""

    effort: float = 0.0  # [N m] its amplitude; 0 chooses a share
    share: float = 0.2  # of what is left of the effort limits besides the load
    amplitude: float = 0.05  # [rad] of the position
    cycles: int = 8  # whole cycles

    def require(self) -> None:
        if not 0.0 < self.share <= 0.8:
            raise SettingError(f"the share of the effort must be in (0, 0.8], not {self.share:g}")
        if not (math.isfinite(self.effort) and self.effort >= 0.0):
            raise SettingError(f"the effort must be positive, not {self.effort:g}")
        if not (math.isfinite(self.amplitude) and self.amplitude > 0.0):
            raise SettingError(f"the amplitude must be positive, not {self.amplitude:g}")
        if not 5 <= self.cycles <= 50:
            raise SettingError(f"there must be 5 to 50 cycles, not {self.cycles}")


class PlannedRelay(NamedTuple):
    """A relay, and what is expected of it."""

    request: RelayRequest  # what the controller is asked for
    period: float  # [s] of the cycle
    amplitude: float  # [rad] of the position
    velocity: float  # [rad/s] largest


def planned_relay(
    bounds: JointBounds, lead: float, sample_time: float, wish: RelayWish
) -> PlannedRelay:
    """Return a relay within shares of a joint's limits."""
    wish.require()
    least, largest = bounds.efforts
    spare = min(largest - bounds.load, bounds.load - least)
    effort = wish.effort or wish.share * spare
    if not (0.0 < effort < spare and math.isfinite(effort)):
        raise SettingError(
            f"a relay of {effort:.4g} does not fit between {bounds.joint}'s load of "
            f"{bounds.load:.4g} and its effort limits, {least:.4g} and {largest:.4g}: "
            f"give --effort"
        )
    room = _ROOM_SHARE * min(bounds.upper - bounds.position, bounds.position - bounds.lower)
    amplitude = min(wish.amplitude, room / _ROOM)
    if not amplitude > 0.0:
        raise SettingError(f"{bounds.joint} is at a limit of its position: move it away first")
    push = _FOUR_OVER_PI * effort / bounds.inertia
    rate = max(math.sqrt(push / amplitude), push / (_VELOCITY_SHARE * bounds.velocity))
    fastest = 2.0 * math.pi / (_SAMPLES * sample_time)
    if rate > fastest:
        raise SettingError(
            f"a relay of {effort:.4g} would move {bounds.joint} by {amplitude:.3g} in "
            f"{2e3 * math.pi / rate:.3g} ms, fewer than {_SAMPLES} samples: lower --effort, or "
            f"raise --amplitude"
        )
    period, size = 2.0 * math.pi / rate, push / rate**2
    longest = (wish.cycles + _MORE_CYCLES) * period * _SLOWER + 2.0 * RAMP
    request = RelayRequest(
        effort,
        size * lead * rate,
        min(_ROOM * wish.amplitude, room),
        float(wish.cycles),
        min(longest, LONGEST_RELAY),
    )
    return PlannedRelay(request, period, size, size * rate)
