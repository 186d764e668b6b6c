"""The quantities that are reported, and signals drawn of them.

Every one of them is a cost: lower is better. Definitions: docs/indices.md.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.errors import unknown_name
from hpid_ros.base.units import Numbers, unit_over
from hpid_ros.control.assembly import make_law, make_norm
from hpid_ros.control.homogeneous_pid import HomogeneousPid
from hpid_ros.control.settings import LoopSettings
from hpid_ros.messages.series import JointSeries, RunSeries, SeriesError, seconds_since

DEGREES_PER_RADIAN = 180.0 / math.pi
ANGLE_UNITS = ("rad", "deg")  # units in which angles can be given


class Data(Enum):
    """What a number is computed from beside the positions."""

    REFERENCE = "reference"
    EFFORT = "effort"


class Fold(Enum):
    """How the numbers of the joints become the one for all of them."""

    SUM = "sum"
    EUCLIDEAN = "root of the sum of squares"
    ROOT_MEAN_SQUARE = "root of the mean of squares"
    MEAN = "mean"
    WORST = "largest"


@dataclass(frozen=True)
class Quantity:
    """What a number of this package is called."""

    key: str  # name of its attribute and of its entry in files
    symbol: str  # short name in tables
    unit: str  # its unit of a joint that turns, without brackets, angles in rad
    meaning: str  # plain words
    fold: Fold = Fold.SUM  # how the joints' numbers become the one for all
    angle_power: int = 0  # power of the angle's unit in the unit
    needs: Data = Data.REFERENCE  # what it is computed from
    # why it is not defined although that is there
    else_undefined: str = "not defined for this run"

    def unit_in(self, angle_unit: str, are_slides: Iterable[bool] = ()) -> str:
        """Return the unit with angles in rad or deg, as ``deg s^2`` or ``deg s^2, m s^2``."""
        if angle_unit not in ANGLE_UNITS:
            raise SeriesError(unknown_name("unit of angles", angle_unit, ANGLE_UNITS))
        return re.sub(r"\brad\b", angle_unit, unit_over(self.unit, are_slides))


NO_STEP = "the reference does not step"
NO_SPECTRUM = "too few commands, or too rare ones"

_of_effort = partial(Quantity, needs=Data.EFFORT)
_of_step = partial(Quantity, fold=Fold.WORST, else_undefined=NO_STEP)

IVC = _of_effort("ivc", "IVC", "N m", "variation of the effort")
IAVC = _of_effort("iavc", "IAVC", "N m s", "effort spent")
ITAE = Quantity("itae", "ITAE", "rad s^2", "time-weighted error", angle_power=1)
EFFORT_L2 = _of_effort("effort_l2", "||u||", "N m s^0.5", "L2 norm of the effort", Fold.EUCLIDEAN)
ERROR_L2 = Quantity("error_l2", "||e||", "rad s^0.5", "L2 norm of the error", Fold.EUCLIDEAN, 1)
INDICES = (IVC, IAVC, ITAE)  # the paper's indices of each joint
NORMS = (EFFORT_L2, ERROR_L2)  # the paper's norms, over all joints
PAPER = (*INDICES, *NORMS)  # what the paper's comparison shows of a run

IAE = Quantity("iae", "IAE", "rad s", "absolute error", angle_power=1)
ISE = Quantity("ise", "ISE", "rad^2 s", "squared error", angle_power=2)
RMSE = Quantity("rmse", "RMSE", "rad", "root mean square error", Fold.ROOT_MEAN_SQUARE, 1)
ERROR_MAX = Quantity("error_max", "max|e|", "rad", "largest error", Fold.WORST, 1)
RISE_TIME = _of_step("rise_time", "rise", "s", "10 % to 90 % of a step")
SETTLING_TIME = _of_step("settling_time", "settling", "s", "until within 2 % of a step")
OVERSHOOT = _of_step("overshoot", "overshoot", "%", "beyond a step, of its height")
STEADY_STATE_ERROR = _of_step(
    "steady_state_error", "e_ss", "rad", "mean error at the end of a step", angle_power=1
)
SATURATION = _of_effort(
    "saturation", "saturated", "%", "time with the effort at a limit", Fold.MEAN
)
CHATTER = _of_effort(
    *("chatter", "chatter", "N m", "effort above the cut-off frequency, rms", Fold.EUCLIDEAN),
    else_undefined=NO_SPECTRUM,
)
ENERGY = _of_effort("energy", "energy", "J", "mechanical work exchanged")

# Defined for joints whose reference steps.
STEP_QUANTITIES = (RISE_TIME, SETTLING_TIME, OVERSHOOT, STEADY_STATE_ERROR)
QUANTITIES: Mapping[str, Quantity] = {
    quantity.key: quantity
    for quantity in (
        *(IVC, IAVC, ITAE, IAE, ISE, RMSE, ERROR_MAX, EFFORT_L2, ERROR_L2),
        *STEP_QUANTITIES,
        *(SATURATION, CHATTER, ENERGY),
    )
}
"""All quantities by key, in the order in which they are shown."""


def find_quantities(names: Iterable[str]) -> tuple[Quantity, ...]:
    """Return quantities by name; ``paper`` and ``step`` stand for several, ``all`` for all."""
    several = {"all": tuple(QUANTITIES.values()), "paper": PAPER, "step": STEP_QUANTITIES}
    by_name = {key: (quantity,) for key, quantity in QUANTITIES.items()}
    by_symbol = {quantity.symbol.lower(): (quantity,) for quantity in QUANTITIES.values()}
    found: list[Quantity] = []
    for name in names:
        key = name.strip().lower()
        choice = {**by_symbol, **by_name, **several}.get(key)
        if choice is None:
            raise SeriesError(unknown_name("index", name, (*several, *QUANTITIES)))
        found += [quantity for quantity in choice if quantity not in found]
    return tuple(found)


def folded(fold: Fold, numbers: Sequence[float]) -> float:
    """Return the number for all joints, of at least one."""
    if fold is Fold.WORST:
        return max(numbers)
    if fold is Fold.SUM:
        return math.fsum(numbers)
    if fold is Fold.MEAN:
        return math.fsum(numbers) / len(numbers)
    squares = math.fsum(number * number for number in numbers)
    return math.sqrt(squares if fold is Fold.EUCLIDEAN else squares / len(numbers))


class Signal(NamedTuple):
    """One signal: integer stamps in [ns], (N,), and its values at them, (N,)."""

    stamps_ns: NDArray[np.int64]
    values: Numbers


NO_SIGNAL = Signal(np.empty(0, dtype=np.int64), np.empty(0))


def position_of(series: JointSeries) -> Signal:
    """Return a joint's measured position, in [rad]."""
    return Signal(series.state_stamps_ns, series.position)


def reference_of(series: JointSeries) -> Signal:
    """Return a joint's reference, in [rad]; nothing if it has none."""
    return _known(series, series.reference) if series.has_reference else NO_SIGNAL


def error_of(series: JointSeries) -> Signal:
    """Return a joint's error, in [rad]; nothing without a reference."""
    return _known(series, series.error) if series.has_reference else NO_SIGNAL


def _known(series: JointSeries, values: Numbers) -> Signal:
    """Return values at the states at which there is a reference."""
    if series.known is None:
        return Signal(series.state_stamps_ns, values)
    return Signal(series.state_stamps_ns[series.known], values[series.known])


def effort_of(series: JointSeries) -> Signal:
    """Return a joint's effort, in [N m]."""
    return Signal(series.command_stamps_ns, series.effort)


def has_any(runs: Sequence[RunSeries], data: Data) -> bool:
    """Return whether any joint of some runs has a reference, or an effort."""
    joints = (each for run in runs for each in run.outlines)
    return any(each.has_reference if data is Data.REFERENCE else each.commands for each in joints)


class GainSignals(NamedTuple):
    """What a joint's homogeneous law did to its gains."""

    norm: Signal  # homogeneous norm of error and error rate at each state, before floor and cap
    # factor of the loop's bandwidth: the norm, within floor and cap, to the power of the degree
    multiplier: Signal


Gains = Mapping[str, Mapping[str, GainSignals]]  # what the laws did, by label and joint


def gains_of_runs(
    runs: Sequence[RunSeries], settings: Mapping[str, Mapping[str, LoopSettings]]
) -> dict[str, dict[str, GainSignals]]:
    """Return :func:`gain_signals` by label, of the runs whose loops are known."""
    found = {run.label: gain_signals(run, settings.get(run.label, {})) for run in runs}
    return {label: signals for label, signals in found.items() if signals is not None}


def gain_signals(
    run: RunSeries, settings: Mapping[str, LoopSettings]
) -> dict[str, GainSignals] | None:
    """Return norm and multiplier of each joint over time.

    The error's rate is computed as the loop does it: the reference's own rate minus the filtered
    difference of the positions.
    """
    if any(each.joint not in settings or not each.has_reference for each in run.joints):
        return None
    return {series.joint: _signals(series, settings[series.joint]) for series in run.joints}


def _signals(series: JointSeries, settings: LoopSettings) -> GainSignals:
    law, norm = make_law(settings), make_norm(settings)
    values = norm.values(series.error, _error_rate(series, settings))
    if not isinstance(law, HomogeneousPid):
        multiplier = np.ones_like(values)
    else:
        limited = np.clip(values, law.norm_floor, law.norm_cap)
        at_zero = 1.0 if norm.degree == 0.0 else 0.0
        positive = np.where(limited > 0.0, limited, 1.0)
        multiplier = np.where(limited > 0.0, positive**norm.degree, at_zero)
    stamps = series.state_stamps_ns
    return GainSignals(Signal(stamps, values), Signal(stamps, multiplier))


def _error_rate(series: JointSeries, settings: LoopSettings) -> Numbers:
    t = series.time
    if t.size < 2:
        return np.zeros_like(t)
    steps = np.diff(t)
    period = float(np.median(steps))
    share = period / (settings.velocity.filter_time_constant + period)
    difference = np.append(0.0, np.diff(series.position) / steps)
    filtered = itertools.accumulate(
        share * difference, lambda last, new: (1.0 - share) * last + new
    )
    velocity: Numbers = np.fromiter(filtered, float, t.size)
    return _reference_rate(series.reference, steps) - velocity


def _reference_rate(reference: Numbers, steps: Numbers) -> Numbers:
    """Return the rate of a reference; a jump from rest to rest has none."""
    moves = np.diff(reference)
    before, after = np.append(0.0, moves[:-1]), np.append(moves[1:], 0.0)
    is_jump = (moves != 0.0) & (before == 0.0) & (after == 0.0)
    return np.append(0.0, np.where(is_jump, 0.0, moves / steps))


def norm_over_joints(signals: Iterable[Signal]) -> Signal:
    """Return the Euclidean norm over joints of their signals, at all stamps that any has.

    The signals are gone through twice, and only one of them need be in memory.

    Between its samples a joint's value lies on a straight line, as the indices see it; before
    its first and after its last sample it counts as zero.

    Source: the paper's equation of the norm over joints in the experimental section.
    """
    unlike: list[NDArray[np.int64]] = []  # stamps that others do not have
    for each in signals:
        if not any(np.array_equal(each.stamps_ns, known) for known in unlike):
            unlike.append(each.stamps_ns)
    stamps = unlike[0] if len(unlike) == 1 else np.unique(np.concatenate(unlike))
    squares = np.zeros(stamps.size)
    for stamps_ns, values in signals:
        if stamps_ns.size == stamps.size:  # as many as there are: the same ones
            squares += np.square(values)
        elif stamps_ns.size:
            origin = int(stamps[0])
            at, known = seconds_since(stamps, origin), seconds_since(stamps_ns, origin)
            squares += np.square(np.interp(at, known, values, left=0.0, right=0.0))
    return Signal(stamps, np.sqrt(squares))


class _SignalsOf:
    """The signals of a run's joints, each made when it is looked at."""

    def __init__(self, run: RunSeries, signal_of: Callable[[JointSeries], Signal]) -> None:
        self._run, self._signal_of = run, signal_of

    def __iter__(self) -> Iterator[Signal]:
        return map(self._signal_of, self._run.joints)


def norm_of_run(run: RunSeries, signal_of: Callable[[JointSeries], Signal]) -> Signal:
    """Return the norm over a run's joints; nothing where one of them has no signal."""
    signals = _SignalsOf(run, signal_of)
    return norm_over_joints(signals) if all(each.values.size for each in signals) else NO_SIGNAL


def envelope(signal: Signal, buckets: int) -> Signal:
    """Return the samples of a signal that a drawing of some width needs; no peak is lost.

    The signal is cut into buckets of equally many samples; of each, the first, the lowest, the
    highest and the last stay. Drawn with at least one bucket a pixel, the line covers the same
    pixels as the whole signal.
    """
    stamps_ns, values = signal
    if values.size <= 4 * buckets:
        return signal
    edges = np.linspace(0, values.size, buckets + 1).astype(np.intp)
    kept = [edges[:-1], edges[1:] - 1]
    for first, stop in itertools.pairwise(edges):
        bucket = values[first:stop]
        kept.append(first + np.array([bucket.argmin(), bucket.argmax()]))
    indices = np.unique(np.concatenate(kept))
    return Signal(stamps_ns[indices], values[indices])
