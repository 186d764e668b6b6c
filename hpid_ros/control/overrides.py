"""Overrides of the law: a damping stop in its place, and a relay test around it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from hpid_ros.base.errors import SettingError
from hpid_ros.base.units import SECONDS_PER_NANOSECOND
from hpid_ros.control.homogeneous_pid import Gains
from hpid_ros.control.limits import MotionLimits
from hpid_ros.control.reference import LARGEST_POSITION
from hpid_ros.control.settings import EffortLimits
from hpid_ros.control.velocity import Unwrapper, VelocitySource


@dataclass(kw_only=True)
class DampingStop:
    """Answers states with ``-damping velocity``, fading to nothing over a duration."""

    damping: float  # [N m s/rad]
    velocity: VelocitySource
    uses_velocity: bool  # whether it looks at measured velocities
    limits: MotionLimits | None
    clamp: EffortLimits  # where there are no motion limits
    effort: float  # [N m] the active effort
    stamp_ns: int  # of the last state that could be used
    position: float  # [rad] of the last state
    unwrapper: Unwrapper | None  # of an encoder that wraps
    step_max: float  # [rad] what a position may differ from the last one at any time
    speed_max: float  # [rad/s] and for the time between
    duration: float  # [s]

    _begin_ns: int | None = None  # stamp of the first state

    def step(self, stamp_ns: int, position: float, velocity: float | None = None) -> float:
        """Take one state and return the effort that answers it in [N m]; see ``JointLoop.step``.

        A state that cannot be used, that is older than the last one, or whose position the joint
        cannot have reached, gets none, as a repeat of the loop's last state does; a repeat of one
        that the stop has answered gets the same again.
        """
        if stamp_ns == self.stamp_ns and self._begin_ns is not None:
            return self.effort
        if not self.uses_velocity:
            velocity = None
        dt = (stamp_ns - self.stamp_ns) * SECONDS_PER_NANOSECOND
        numbers = (position, 0.0 if velocity is None else velocity)
        if dt <= 0.0 or not all(-LARGEST_POSITION <= each <= LARGEST_POSITION for each in numbers):
            self.effort = 0.0
            return 0.0
        if self.unwrapper is not None:
            position = self.unwrapper.update(position)
        if abs(position - self.position) > self.step_max + self.speed_max * dt:
            if self.unwrapper is not None:
                self.unwrapper.undo()
            self.effort = 0.0
            return 0.0
        self.stamp_ns, self.position = stamp_ns, position
        rate = self.velocity.update(position, velocity, dt)
        if self._begin_ns is None:
            self._begin_ns = stamp_ns
        passed = (stamp_ns - self._begin_ns) * SECONDS_PER_NANOSECOND / self.duration
        wanted = -self.damping * rate * max(0.0, 1.0 - passed)
        if self.limits is None:
            effort = self.clamp.within(wanted)
        else:
            effort = self.limits.limit(wanted, position, rate, self.effort, dt)
        self.effort = effort if passed < 1.0 else 0.0
        return self.effort


RAMP = 0.3
"""Time in which the relay takes over, and in which it gives back, in [s]."""

LONGEST_RELAY = 30.0
"""Longest time of a relay in [s], even if whoever asked for it has gone."""

CYCLES_DONE = "all cycles are done"
"""Why a relay gives back that has done what was asked."""

_MOST_CYCLES = 100
_STALLED = 5.0  # [s] without a switch at full weight: friction or a load holds the joint


@dataclass(frozen=True)
class RelayRequest:
    """What a relay shall do."""

    amplitude: float  # [N m] of the effort, a
    hysteresis: float  # [rad] of s
    deviation: float  # [rad] largest error; beyond it the relay gives back
    cycles: float  # after so many switches upwards at full weight it gives back
    duration: float  # [s] at the latest after so long, both ramps included

    def __post_init__(self) -> None:
        bounds = {"cycles": float(_MOST_CYCLES), "duration": LONGEST_RELAY}
        for name, value in vars(self).items():
            most = bounds.get(name, math.inf)
            if not (math.isfinite(value) and 0.0 < value <= most):
                allowed = "finite and positive" if math.isinf(most) else f"in (0, {most:g}]"
                raise SettingError(f"the {name} of a relay must be {allowed}, not {value:g}")

    @classmethod
    def from_message(cls, numbers: Sequence[float]) -> RelayRequest | None:
        """Return what a message on ``~/relay`` asks for; None for the end of a relay."""
        if not numbers:
            return None
        names = list(cls.__dataclass_fields__)
        if len(numbers) != len(names):
            raise SettingError(
                f"a relay is asked for with {len(names)} numbers ({', '.join(names)}), "
                f"not {len(numbers)}"
            )
        return cls(*numbers)


def relay_obstacle(
    request: RelayRequest, gains: Gains, limits: EffortLimits, load: float, error: float
) -> str:
    """Return why a relay would not be safe; empty if it is."""
    least, most = limits.u_clamp_min, limits.u_clamp_max
    if not (gains.p > 0.0 and gains.d > 0.0):
        return "gains.p and gains.d must be positive"
    if abs(error) > 0.5 * request.deviation:
        return (
            f"the error of {error:.4g} rad is above half of the deviation, "
            f"{request.deviation:g} rad"
        )
    if not least < load - request.amplitude < load + request.amplitude < most:
        return (
            f"an amplitude of {request.amplitude:g} N m around {load:.4g} N m is not within "
            f"the effort limits, {least:g} and {most:g} N m"
        )
    return ""


class Relay:
    r"""One relay, from its start until it has given back.

    A joint with little friction is a double integrator, which no relay on the error alone makes
    oscillate as it should: the cycle grows. So the relay acts on

    .. math:: s = \epsilon + T \dot\epsilon, \qquad T = k_d / k_p

    with hysteresis: it pushes one way until s has passed the hysteresis on the other side. The
    lead T damps, and the hysteresis sets the cycle's size.

    The law stays beside it. Its integral goes on to carry the load, and stands still; its p and d
    terms make room for the relay gradually, and come back as gradually:

    .. math:: u = I + (1 - w)(P + D) + w\,a\,\sigma, \qquad \dot I = (1 - w)\,k_i \epsilon

    with the amplitude a, the relay's side :math:`\sigma = \pm 1`, and a weight w that rises from 0
    to 1 and falls again, each within :data:`RAMP`. So there is no jump at the start and none at
    the end, and between two samples a switch changes the effort by at most :math:`2 w a`. All
    limits act on u after that.

    Source: K. J. Astrom and T. Hagglund, "Automatic tuning of simple regulators with
    specifications on phase and amplitude margins", Automatica 20 (1984) 645-651.
    """

    __slots__ = (
        "_lead",
        "_request",
        "_side",
        "_since_switch",
        "_time",
        "_weight",
        "cycles",
        "ending",
    )

    def __init__(self, request: RelayRequest, lead: float) -> None:
        self._request, self._lead = request, lead
        self._side = 1.0
        self._weight = self._time = self._since_switch = 0.0
        self.cycles = 0
        self.ending = ""

    @property
    def weight(self) -> float:
        """The weight w of the last sample."""
        return self._weight

    @property
    def is_over(self) -> bool:
        """Whether it has given back all."""
        return bool(self.ending) and self._weight == 0.0

    def end(self, reason: str) -> None:
        """Give back from now on."""
        self.ending = self.ending or reason

    def drop(self, reason: str) -> None:
        """End at once: what it has given is taken over from elsewhere."""
        self.end(reason)
        self._weight = 0.0

    def update(self, error: float, error_rate: float, replaced: float, dt: float) -> float:
        """Take one sample and return what is added to the law's effort, in [N m]."""
        request = self._request
        self._time += dt
        if abs(error) > request.deviation:
            self.end(f"the error of {abs(error):.4g} rad is above {request.deviation:g} rad")
        elif self._time >= request.duration - RAMP:
            self.end(f"it has taken {request.duration:g} s")
        self._switch(error + self._lead * error_rate, dt)
        step = -dt / RAMP if self.ending else dt / RAMP
        self._weight = min(max(self._weight + step, 0.0), 1.0)
        return self._weight * (request.amplitude * self._side - replaced)

    def _switch(self, leading: float, dt: float) -> None:
        """Push the other way once s has passed the hysteresis there."""
        self._since_switch += dt
        if leading * self._side >= -self._request.hysteresis:
            if self._weight == 1.0 and self._since_switch > _STALLED:
                self.end(f"it did not move the joint within {_STALLED:g} s")
            return
        self._side, self._since_switch = -self._side, 0.0
        if self._weight == 1.0 and not self.ending and self._side > 0.0:
            self.cycles += 1
            if self.cycles >= self._request.cycles:
                self.end(CYCLES_DONE)
