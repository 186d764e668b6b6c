"""One joint's sampled loop with its multiplier frozen: its response, and whether it is stable.

The loop is cut where the effort is sent. With the multiplier frozen at lam the homogeneous law
is the PID of the gains p lam^2, d lam, i lam^3, exactly so wherever the norm is at its floor
or its cap.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from hpid_ros.base.arrays import Numbers
from hpid_ros.control import LoopSettings
from hpid_ros.control.gains import Gains
from hpid_ros.frequency.plant import Complexes, SampledJoint
from hpid_ros.frequency.velocity import LawResponse, LinearSource, linear_source


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
    def gains(self) -> Gains:
        """The gains in force at this multiplier."""
        own, factor = self.settings.gains, self.multiplier
        return Gains(own.p * factor**2, own.i * factor**3, own.d * factor)

    def with_delay(self, delay: float) -> FrozenLoop:
        """Return the same loop with another delay, in [s]."""
        return replace(self, joint=replace(self.joint, delay=delay))

    def response(self, frequency: Numbers) -> Complexes:
        """Return the open loop L(exp(j w T)), which is -1 where the closed loop oscillates."""
        joint = self.joint.response(frequency)
        ahead = np.expm1(1j * self.joint.period * frequency)
        law = self._law_response(ahead)
        controller = self._source.controller(law, ahead)
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
        effort = effort - self._feeds * seen.disturbance
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

    @property
    def _feeds(self) -> float:
        """Which part of an observer's disturbance is fed forward."""
        return 1.0 if self.settings.observer.feed_disturbance else 0.0

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

    def _law_response(self, ahead: Complexes) -> LawResponse:
        law = self._law
        summed = self.joint.period / ahead
        return LawResponse(
            law.position + law.integral_position * summed,
            law.velocity + law.integral_velocity * summed,
            self._feeds,
        )
