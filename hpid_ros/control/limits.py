"""Limits of position, velocity and effort rate, the last word on an effort; anti-windup."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

from hpid_ros.base.errors import SettingError
from hpid_ros.control.homogeneous_pid import Gains

AntiWindupStrategy = Literal["none", "conditional_integration", "back_calculation"]
"""What the integral does while the effort is limited, as in control_toolbox."""


class MotionBounds(NamedTuple):
    """The numbers of a joint's limits; "per rad" reads "per m" where it is prismatic."""

    lower: float  # [rad] lowest position; -inf for none
    upper: float  # [rad] highest position; inf for none
    velocity: float  # [rad/s] largest absolute velocity; inf for none
    margin: float  # [rad] distance before a stop within which effort towards it fades
    k_position: float  # [1/s] velocity allowed towards a stop for each rad of distance
    k_velocity: float  # [N m s/rad] braking effort for each rad/s beyond what is allowed
    rate: float  # [N m/s] largest change of the effort; inf for none
    effort_min: float  # [N m] least effort
    effort_max: float  # [N m] largest effort


class MotionLimits:
    r"""Keeps a joint within its positions and velocities, whatever effort is wanted.

    But no faster than ``effort_rate_max`` lets the effort change, which acts after it.

    A stop at :math:`q_{max}` is a velocity limit that shrinks with the distance: upwards at most
    :math:`v_{up} = \min(k_s (q_{max} - q), v_{max})` is allowed, which is negative beyond it.
    With the headroom :math:`x = v_{up} - v` and the width
    :math:`w = \min(k_s \cdot margin, v_{max}/10)` an effort upwards is

    - left alone where :math:`x \ge w`,
    - scaled by :math:`x / w` where :math:`0 < x < w`: scaled out near the stop or the limit,
    - held to :math:`k_v x \le 0`, a braking or returning effort, where :math:`x \le 0`;

    and likewise downwards. An effort away from a stop is never reduced. For a joint of inertia
    m that a load of at most :math:`\tau_L` pushes towards the stop it is not passed by more than
    :math:`\tau_L / (k_s k_v)`, plus what the joint moves in two samples, if
    :math:`k_v \ge 4 m k_s` and the effort limit can brake it:
    :math:`m k_s |v| + \tau_L \le u_{max}`.

    A joint that begins beyond a stop is not pushed back: the stop is taken where the joint is,
    and follows it inwards.

    Source: the velocity that shrinks with the distance and the two gains are those of the URDF's
    safety_controller and of ``ros2_control``, ``joint_limits/src/joint_soft_limiter.cpp``. There
    the effort at rest is limited everywhere, also far from any stop; here it is not.
    """

    __slots__ = ("_bounds", "_high", "_low", "_width", "braked")

    def __init__(self, bounds: MotionBounds) -> None:
        self._bounds = bounds
        self._width = min(bounds.k_position * bounds.margin, 0.1 * bounds.velocity)
        self._low, self._high = bounds.lower, bounds.upper
        self.braked = 0
        """Samples in which a stop or a velocity limit braked the joint."""

    @property
    def fastest(self) -> float:
        """The velocity limit in [rad/s]; inf for none."""
        return self._bounds.velocity

    def open(self, position: float) -> None:
        """Take the stops where the joint is, if it is beyond them."""
        self._low = min(self._bounds.lower, position)
        self._high = max(self._bounds.upper, position)

    def replace(self, before: MotionLimits | None, position: float) -> None:
        """Take the place of other limits, or of none, while the joint moves."""
        if before is not None:
            self.braked = before.braked
            if before._bounds[:2] == self._bounds[:2]:
                self._low, self._high = before._low, before._high
                return
        self.open(position)

    def reference(self, position: float, velocity: float) -> tuple[float, float]:
        """Return a reference that stays within the stops: beyond one it waits there."""
        if position > self._high:
            return self._high, 0.0
        if position < self._low:
            return self._low, 0.0
        return position, velocity

    def limit(
        self, wanted: float, position: float, velocity: float, before: float, dt: float
    ) -> float:
        """Return the effort that may be given."""
        bounds, width = self._bounds, self._width
        _, _, fastest, _, k, damping, rate, least, most = bounds
        effort = min(max(wanted, least), most)
        self._follow_inwards(position)
        up = min(max(k * (self._high - position), -fastest), fastest) - velocity
        down = velocity - max(min(k * (self._low - position), fastest), -fastest)
        if up < width:
            if up <= 0.0:
                self.braked += 1
                effort = min(effort, damping * up)
            elif effort > 0.0:
                effort *= up / width
        if down < width:
            if down <= 0.0:
                self.braked += up > 0.0  # a sample counts once
                effort = max(effort, -damping * down)
            elif effort < 0.0:
                effort *= down / width
        change = rate * dt if dt > 0.0 or rate < math.inf else math.inf
        effort = min(max(effort, before - change), before + change)
        return min(max(effort, least), most)

    def _follow_inwards(self, position: float) -> None:
        """Bring a stop that was taken further out back to where it belongs."""
        bounds = self._bounds
        if self._high > bounds.upper and position < self._high:
            self._high = max(position, bounds.upper)
        if self._low < bounds.lower and position > self._low:
            self._low = min(position, bounds.lower)


@dataclass(slots=True)
class LimitedSample:
    """What the limits made of a sample, in the law's own units: [N m] without a model."""

    before: float  # the integral in this sample's effort
    after: float  # the integral with this sample's increment
    wanted: float  # the effort before the limits
    limited: float  # the effort after them
    error: float  # [rad]
    dt: float  # [s]


AntiWindup = Callable[[LimitedSample], float]
"""Returns the integral for the next sample, in the law's own units."""


def anti_windup(
    strategy: AntiWindupStrategy, gains: Gains, tracking_time_constant: float
) -> AntiWindup:
    """Return the strategy of this name."""
    if not math.isfinite(tracking_time_constant) or tracking_time_constant < 0.0:
        raise SettingError(
            f"tracking_time_constant must be finite and not negative, "
            f"not {tracking_time_constant} s"
        )
    if strategy == "none" or (strategy == "back_calculation" and gains.i == 0.0):
        return _keep  # without an integral gain nothing winds up, and nothing would wind back
    if strategy == "conditional_integration":
        return _stop_while_pushing
    return _back_calculation(tracking_time_constant or _default_time_constant(gains))


def _keep(sample: LimitedSample) -> float:
    return sample.after


def _stop_while_pushing(sample: LimitedSample) -> float:
    """Do not integrate while the effort is limited and the error pushes further into it."""
    is_pushing = sample.error * (sample.wanted - sample.limited) > 0.0
    return sample.before if is_pushing else sample.after


def _back_calculation(time_constant: float) -> AntiWindup:
    """Draw the integral back with the time constant by what the limits took away."""

    def strategy(sample: LimitedSample) -> float:
        excess, dt = sample.limited - sample.wanted, sample.dt
        return sample.after + (dt * excess / time_constant if dt < time_constant else excess)

    return strategy


def _default_time_constant(gains: Gains) -> float:
    return math.sqrt(gains.d / gains.i) if gains.d > 0.0 else gains.p / gains.i or math.inf
