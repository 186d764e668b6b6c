r"""One joint's sampled loop with its multiplier frozen: plant, response, stability.

The loop is cut where the effort is sent. With the multiplier frozen at lam the homogeneous law
is the PID of the gains p lam^2, d lam, i lam^3, exactly so wherever the norm is at its floor
or its cap.

.. math:: J \ddot q + b \dot q = u(t - \theta)

with the effort u held between two samples (zero-order hold). What is computed is exact for this
joint at the samples, whatever the delay: no Pade approximation, no Tustin.

Source: K. J. Astrom and B. Wittenmark, "Computer-Controlled Systems" (3rd ed., 1997), sections
2.3 (sampling of a system with a hold) and 2.3 "Systems with time delay"; the modified
z-transform.

Each source here is the linear twin of one in :mod:`hpid_ros.control.estimation`: ``sample`` takes
one sample of it, ``controller`` returns what a law makes of what is measured, at z = exp(j w T).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.errors import SettingError
from hpid_ros.base.units import Numbers
from hpid_ros.control.assembly import observer_design
from hpid_ros.control.settings import LoopSettings
from hpid_ros.control.velocity import ObserverDesign
from hpid_ros.stability.closed_loop import ScaledGains

Complexes = NDArray[np.complex128]
"""Of any shape, which the docstring says."""

_SERIES_BELOW = 0.05


class FrequencyResponse(NamedTuple):
    """Of a joint: from the effort of a sample to position and velocity, in [rad/(N m)], [.. / s].

    Of a controller: its effort is minus this times position and velocity, [N m/rad], [N m s/rad].
    """

    position: Complexes
    velocity: Complexes


class HeldEffort(NamedTuple):
    """What one period makes of position and velocity: x' = (q + reach v, keep v) + gains u."""

    reach: float  # [s] by how far a velocity of one moves the joint in one period
    keep: float  # which part of a velocity is left after it
    whole_periods: int  # an effort begins to act so many periods late
    # gains of the effort that begins to act within the period: position, velocity
    newer: tuple[float, float]
    older: tuple[float, float]  # gains of the effort before it, which acts until then


@dataclass(frozen=True)
class SampledJoint:
    """A joint behind a zero-order hold."""

    inertia: float  # [kg m^2] J, what one unit of effort accelerates
    period: float  # [s] control period T
    friction: float = 0.0  # [N m s/rad] viscous friction b
    delay: float = 0.0  # [s]

    def __post_init__(self) -> None:
        for name, unit in (("inertia", "kg m^2"), ("period", "s")):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise SettingError(f"the {name} must be positive and finite, not {value} {unit}")
        for name, unit in (("friction", "N m s/rad"), ("delay", "s")):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise SettingError(
                    f"the {name} must be finite and not negative, not {value} {unit}"
                )

    @property
    def nyquist(self) -> float:
        """Half the sampling frequency, in [rad/s]: no response is looked at beyond it."""
        return math.pi / self.period

    @property
    def held(self) -> HeldEffort:
        """What one period makes of position, velocity and effort."""
        period = self.period
        whole = math.floor(self.delay / period)
        late = self.delay - whole * period
        reach, keep = self._free(period - late)
        first = self._forced(late)
        older = (first[0] + reach * first[1], keep * first[1])
        return HeldEffort(*self._free(period), whole, self._forced(period - late), older)

    def _free(self, time: float) -> tuple[float, float]:
        """Return reach and rest of a velocity after a time."""
        decay = self.friction / self.inertia * time
        return time * _phi_1(decay), math.exp(-decay)

    def _forced(self, time: float) -> tuple[float, float]:
        """Return position and velocity after a time under a unit effort from rest."""
        decay = self.friction / self.inertia * time
        return time * time * _phi_2(decay) / self.inertia, time * _phi_1(decay) / self.inertia

    def response(self, frequency: Numbers) -> FrequencyResponse:
        """Return the frequency response of the held joint at z = exp(j w T)."""
        held = self.held
        ahead = np.expm1(1j * self.period * frequency)  # z - 1, with all its digits
        back = 1.0 / (1.0 + ahead)
        late = np.exp(-1j * held.whole_periods * self.period * frequency)
        forced = [
            late * (newer + older * back)
            for newer, older in zip(held.newer, held.older, strict=True)
        ]
        lost = self.friction / self.inertia * held.reach  # 1 - keep, likewise
        velocity = forced[1] / (ahead + lost)
        return FrequencyResponse((forced[0] + held.reach * velocity) / ahead, velocity)


def _phi_1(x: float) -> float:
    """Return (1 - exp(-x)) / x."""
    return -math.expm1(-x) / x if x else 1.0


def _phi_2(x: float) -> float:
    """Return (x - 1 + exp(-x)) / x^2."""
    if x < _SERIES_BELOW:
        return sum((-x) ** k / math.factorial(k + 2) for k in range(8))
    return (x + math.expm1(-x)) / (x * x)


_LEAST_MEMORY = 1e-3  # of the observer: what is kept from one sample to the next, at least


class Seen(NamedTuple):
    """What a law is given in one sample, for each of N starts at once."""

    position: Numbers  # the position that the error is taken of, (N,)
    velocity: Numbers  # the velocity, (N,)
    disturbance: Numbers  # the effort that is fed forward against a disturbance, (N,)
    states: Numbers  # the source's own states after the sample, (K, N)


class MeasuredSource:
    """The velocity is measured, and taken to be the joint's own at the sample."""

    size = 0

    def sample(self, states: Numbers, position: Numbers, velocity: Numbers, sent: Numbers) -> Seen:
        return Seen(position, velocity, np.zeros_like(position), states)

    def controller(self, law: FrequencyResponse, ahead: Complexes) -> FrequencyResponse:
        return FrequencyResponse(law.position, law.velocity)


@dataclass(frozen=True)
class FilteredSource:
    r"""Differences of the position behind a first-order low-pass, by backward Euler.

    .. math:: V(z) = (z - 1) / ((\tau + T) z - \tau)
    """

    time_constant: float  # [s] tau; 0 is the bare difference
    period: float  # [s] T
    size: int = 2  # the position and the velocity of the sample before

    def sample(self, states: Numbers, position: Numbers, velocity: Numbers, sent: Numbers) -> Seen:
        before, rate = states
        whole = self.time_constant + self.period
        rate = rate + (position - before - self.period * rate) / whole
        return Seen(position, rate, np.zeros_like(position), np.stack([position, rate]))

    def controller(self, law: FrequencyResponse, ahead: Complexes) -> FrequencyResponse:
        tau, period = self.time_constant, self.period
        rate = ahead / ((tau + period) * ahead + period)
        return FrequencyResponse(law.position + law.velocity * rate, np.zeros_like(ahead))


class ObserverSource:
    r"""The extended state observer at degree 0 and a constant period, its gains settled.

    They are those of three equal poles at :math:`\theta = e^{-\omega T}`: 1 - theta^3,
    3/2 (1 - theta)^2 (1 + theta) / T and (1 - theta)^3 / T^2.

    Source: the fading-memory filter of second degree, P. Zarchan and H. Musoff, "Fundamentals of
    Kalman Filtering", chapter on recursive digital filters; that :class:`.Observer` settles there
    is tested.
    """

    size = 3

    def __init__(self, design: ObserverDesign, feeds: bool) -> None:
        self._feed, t = float(feeds), design.period
        theta = max(math.exp(-design.bandwidth * t), _LEAST_MEMORY)
        rest = 1.0 - theta
        self._inertia = design.inertia
        self._follow = np.array([[1.0, t, 0.5 * t * t], [0.0, 1.0, t], [0.0, 0.0, 1.0]])
        self._push = np.array([0.5 * t * t, t, 0.0]) / design.inertia
        self._correct = np.array(
            [1.0 - theta**3, 1.5 * rest * rest * (1.0 + theta) / t, rest**3 / (t * t)]
        )

    def sample(self, states: Numbers, position: Numbers, velocity: Numbers, sent: Numbers) -> Seen:
        ahead = self._follow @ states + np.outer(self._push, sent)
        ahead = ahead + np.outer(self._correct, position - ahead[0])
        return Seen(ahead[0], ahead[1], self._feed * self._inertia * ahead[2], ahead)

    def controller(self, law: FrequencyResponse, ahead: Complexes) -> FrequencyResponse:
        # The observer knows the efforts that the law sends: they are in a loop of their own.
        back = 1.0 / (1.0 + ahead)
        kept = np.eye(3) - np.outer(self._correct, (1.0, 0.0, 0.0))
        system = np.eye(3) - back[:, None, None] * (kept @ self._follow)
        of_effort = back[:, None] * (kept @ self._push)
        inputs = np.stack([np.broadcast_to(self._correct, of_effort.shape), of_effort], axis=-1)
        states = np.linalg.solve(system, inputs)
        own = self._feed * self._inertia * states[:, 2]
        answer = law.position[:, None] * states[:, 0] + law.velocity[:, None] * states[:, 1] + own
        return FrequencyResponse(answer[:, 0] / (1.0 + answer[:, 1]), np.zeros_like(ahead))


LinearSource = MeasuredSource | FilteredSource | ObserverSource


def linear_source(settings: LoopSettings) -> LinearSource:
    """Return a loop's velocity source as a linear system.

    Levant's differentiator is the bare difference wherever the joint's acceleration stays within
    its bound, and is taken for it. An observer whose inertia is unknown is the filtered
    difference, as in the loop.
    """
    period = settings.timing.control_period
    design = observer_design(settings)
    if design is not None:
        return ObserverSource(design, settings.observer.feed_disturbance)
    if settings.velocity.velocity_source == "homogeneous_differentiator":
        return FilteredSource(0.0, period)
    if settings.velocity.is_measured:
        return MeasuredSource()
    return FilteredSource(settings.velocity.velocity_filter_time_constant, period)


class LawStep(NamedTuple):
    """One sample of a linear law, on position x and velocity v seen (the reference is 0).

    The effort is I - (position x + velocity v), and then the integral I falls by
    T (integral_position x + integral_velocity v).
    """

    position: float  # [N m/rad]
    velocity: float  # [N m s/rad]
    integral_position: float  # [N m/(rad s)]
    integral_velocity: float  # [N m/rad]


@dataclass(frozen=True)
class FrozenLoop:
    """A loop whose multiplier stays what it is."""

    settings: LoopSettings  # of the loop; limits, anti-windup and model term are left out
    joint: SampledJoint  # what it drives; its period is the loop's
    multiplier: float = 1.0  # lam, the factor of the bandwidth; 1 for the linear PID

    @cached_property
    def gains(self) -> ScaledGains:
        own, factor = self.settings.gains, self.multiplier
        return ScaledGains(own.p * factor**2, own.i * factor**3, own.d * factor)

    def with_delay(self, delay: float) -> FrozenLoop:
        """Return the same loop with another delay, in [s]."""
        return replace(self, joint=replace(self.joint, delay=delay))

    def response(self, frequency: Numbers) -> Complexes:
        """Return the open loop L(exp(j w T)), which is -1 where the closed loop oscillates."""
        joint = self.joint.response(frequency)
        ahead = np.expm1(1j * self.joint.period * frequency)
        law, summed = self._law, self.joint.period / ahead
        controller = self._source.controller(
            FrequencyResponse(
                law.position + law.integral_position * summed,
                law.velocity + law.integral_velocity * summed,
            ),
            ahead,
        )
        return controller.position * joint.position + controller.velocity * joint.velocity

    def controller(self, frequency: Numbers) -> Complexes:
        """Return minus the response from position to effort, in [N m/rad], (N,).

        Where the velocity is measured, it is taken to be what the joint's own model makes of its
        position.
        """
        return self.response(frequency) / self.joint.response(frequency).position

    @property
    def is_stable(self) -> bool:
        """Whether the closed loop is: every eigenvalue of one sample within the unit circle."""
        return self.spectral_radius < 1.0

    @property
    def spectral_radius(self) -> float:
        """The largest magnitude of an eigenvalue of the closed loop, from sample to sample."""
        matrix = self.transition
        if not np.isfinite(matrix).all():
            return float("inf")
        return float(np.abs(np.linalg.eigvals(matrix)).max())

    @property
    def transition(self) -> Numbers:
        """What one sample makes of the closed loop's state, (K, K).

        The state is position, velocity, the efforts under way, the velocity source's states and,
        with integral action, the integral.
        """
        held = self.joint.held
        source, law = self._source, self._law
        under_way = held.whole_periods + 1
        has_integral = self.gains.i > 0.0
        size = 2 + under_way + source.size + has_integral
        state = np.eye(size)
        position, velocity = state[0], state[1]
        sent = state[2 : 2 + under_way]
        integral = state[-1] if has_integral else np.zeros(size)
        seen = source.sample(
            state[2 + under_way : 2 + under_way + source.size], position, velocity, sent[0]
        )
        effort = integral - law.position * seen.position - law.velocity * seen.velocity
        effort = effort - seen.disturbance
        efforts = np.vstack([effort, sent])
        newer, older = efforts[held.whole_periods], efforts[held.whole_periods + 1]
        after = [
            position + held.reach * velocity + held.newer[0] * newer + held.older[0] * older,
            held.keep * velocity + held.newer[1] * newer + held.older[1] * older,
            *efforts[:-1],
            *seen.states,
        ]
        if has_integral:
            step = law.integral_position * seen.position + law.integral_velocity * seen.velocity
            after.append(integral - self.joint.period * step)
        return np.stack(after)

    @cached_property
    def _source(self) -> LinearSource:
        return linear_source(self.settings)

    @cached_property
    def _law(self) -> LawStep:
        p, i, d = self.gains.p, self.gains.i, self.gains.d
        if self.settings.discretization != "semi_implicit":
            return LawStep(p, d, i, 0.0)
        period = self.joint.period
        moved = period / self.settings.plant_inertia
        divisor = 1.0 + moved * (d + period * p)
        return LawStep(
            p / divisor,
            (d + period * p) / divisor,
            i * (1.0 + moved * d) / divisor,
            i * period / divisor,
        )
