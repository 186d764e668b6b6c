"""The quantities that are reported.

Every one of them is a cost: lower is better. Definitions: docs/indices.md.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import partial

from hpid_ros.base.errors import unknown_name
from hpid_ros.base.units import unit_over
from hpid_ros.messages.series import SeriesError

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
L2_NORMS = (EFFORT_L2, ERROR_L2)  # the paper's norms, over all joints
PAPER = (*INDICES, *L2_NORMS)  # what the paper's comparison shows of a run

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
    "chatter",
    "chatter",
    "N m",
    "effort above the cut-off frequency, rms",
    Fold.EUCLIDEAN,
    else_undefined=NO_SPECTRUM,
)
ENERGY = _of_effort("energy", "energy", "J", "mechanical work exchanged")

# Defined for joints whose reference steps.
STEP_QUANTITIES = (RISE_TIME, SETTLING_TIME, OVERSHOOT, STEADY_STATE_ERROR)
QUANTITIES: Mapping[str, Quantity] = {
    quantity.key: quantity
    for quantity in (
        IVC,
        IAVC,
        ITAE,
        IAE,
        ISE,
        RMSE,
        ERROR_MAX,
        EFFORT_L2,
        ERROR_L2,
        *STEP_QUANTITIES,
        SATURATION,
        CHATTER,
        ENERGY,
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
