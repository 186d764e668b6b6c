"""What a loop sees of its joint, sample by sample, as a linear system: its velocity source.

Each class here is the linear twin of a source in :mod:`hpid_ros.control.estimation`: one sample of
it, and its frequency response at z = exp(j w T).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from hpid_ros.base.arrays import Numbers
from hpid_ros.control import LoopSettings
from hpid_ros.control.estimation.observer import ObserverFigures
from hpid_ros.control.settings.assembly import observer_figures
from hpid_ros.frequency.plant import Complexes

_LEAST_MEMORY = 1e-3  # of the observer: what is kept from one sample to the next, at least


class Seen(NamedTuple):
    """What a law is given in one sample, for each of N starts at once."""

    position: Numbers  # the position that the error is taken of, (N,)
    velocity: Numbers  # the velocity, (N,)
    disturbance: Numbers  # the effort that is estimated to disturb the joint, (N,)
    states: Numbers  # the source's own states after the sample, (K, N)


class LawResponse(NamedTuple):
    """A law on what it sees: its effort is minus this times position and velocity."""

    position: Complexes  # of the position seen
    velocity: Complexes  # of the velocity seen
    disturbance: float  # which part of the estimated disturbance is fed forward: 0 or 1


class ControllerResponse(NamedTuple):
    """A controller on what is measured: its effort is minus this times position and velocity."""

    position: Complexes  # [N m/rad] of the measured position
    velocity: Complexes  # [N m s/rad] of the measured velocity


class LinearSource(Protocol):
    """A velocity source as a linear system."""

    @property
    def size(self) -> int:
        """How many states it has."""

    def sample(self, states: Numbers, position: Numbers, velocity: Numbers, sent: Numbers) -> Seen:
        """Take one sample."""

    def controller(self, law: LawResponse, ahead: Complexes) -> ControllerResponse:
        """Return what a law makes of what is measured."""


class MeasuredSource:
    """The velocity is measured, and taken to be the joint's own at the sample."""

    size = 0

    def sample(self, states: Numbers, position: Numbers, velocity: Numbers, sent: Numbers) -> Seen:
        """Take one sample; see :class:`LinearSource`."""
        return Seen(position, velocity, np.zeros_like(position), states)

    def controller(self, law: LawResponse, ahead: Complexes) -> ControllerResponse:
        """Return what a law makes of what is measured; see :class:`LinearSource`."""
        return ControllerResponse(law.position, law.velocity)


@dataclass(frozen=True)
class FilteredSource:
    r"""Differences of the position behind a first-order low-pass, by backward Euler.

    .. math:: V(z) = (z - 1) / ((\tau + T) z - \tau)
    """

    time_constant: float  # [s] tau; 0 is the bare difference
    period: float  # [s] T
    size: int = 2  # the position and the velocity of the sample before

    def sample(self, states: Numbers, position: Numbers, velocity: Numbers, sent: Numbers) -> Seen:
        """Take one sample; see :class:`LinearSource`."""
        before, rate = states
        whole = self.time_constant + self.period
        rate = rate + (position - before - self.period * rate) / whole
        return Seen(position, rate, np.zeros_like(position), np.stack([position, rate]))

    def controller(self, law: LawResponse, ahead: Complexes) -> ControllerResponse:
        """Return what a law makes of what is measured; see :class:`LinearSource`."""
        tau, period = self.time_constant, self.period
        rate = ahead / ((tau + period) * ahead + period)
        return ControllerResponse(law.position + law.velocity * rate, np.zeros_like(ahead))


class ObserverSource:
    r"""The extended state observer at degree 0 and a constant period, its gains settled.

    They are those of three equal poles at :math:`\theta = e^{-\omega T}`: 1 - theta^3,
    3/2 (1 - theta)^2 (1 + theta) / T and (1 - theta)^3 / T^2.

    Source: the fading-memory filter of second degree, P. Zarchan and H. Musoff, "Fundamentals of
    Kalman Filtering", chapter on recursive digital filters; that :class:`.Observer` settles there
    is tested.
    """

    size = 3

    def __init__(self, figures: ObserverFigures) -> None:
        t = figures.period
        theta = max(math.exp(-figures.bandwidth * t), _LEAST_MEMORY)
        rest = 1.0 - theta
        self._inertia = figures.inertia
        self._follow = np.array([[1.0, t, 0.5 * t * t], [0.0, 1.0, t], [0.0, 0.0, 1.0]])
        self._push = np.array([0.5 * t * t, t, 0.0]) / figures.inertia
        self._correct = np.array(
            [1.0 - theta**3, 1.5 * rest * rest * (1.0 + theta) / t, rest**3 / (t * t)]
        )

    def sample(self, states: Numbers, position: Numbers, velocity: Numbers, sent: Numbers) -> Seen:
        """Take one sample; see :class:`LinearSource`."""
        ahead = self._follow @ states + np.outer(self._push, sent)
        ahead = ahead + np.outer(self._correct, position - ahead[0])
        return Seen(ahead[0], ahead[1], self._inertia * ahead[2], ahead)

    def controller(self, law: LawResponse, ahead: Complexes) -> ControllerResponse:
        """Return what a law makes of what is measured; see :class:`LinearSource`.

        The observer knows the efforts that the law sends, so that they are in a loop of their own.
        """
        back = 1.0 / (1.0 + ahead)
        kept = np.eye(3) - np.outer(self._correct, (1.0, 0.0, 0.0))
        system = np.eye(3) - back[:, None, None] * (kept @ self._follow)
        of_effort = back[:, None] * (kept @ self._push)
        inputs = np.stack([np.broadcast_to(self._correct, of_effort.shape), of_effort], axis=-1)
        states = np.linalg.solve(system, inputs)
        own = law.disturbance * self._inertia * states[:, 2]
        answer = law.position[:, None] * states[:, 0] + law.velocity[:, None] * states[:, 1] + own
        return ControllerResponse(answer[:, 0] / (1.0 + answer[:, 1]), np.zeros_like(ahead))


def linear_source(settings: LoopSettings) -> LinearSource:
    """Return a loop's velocity source as a linear system.

    Levant's differentiator is the bare difference wherever the joint's acceleration stays within
    its bound, and is taken for it. An observer whose inertia is unknown is the filtered
    difference, as in the loop.
    """
    period = settings.timing.control_period
    figures = observer_figures(settings)
    if figures is not None:
        return ObserverSource(figures)
    if settings.velocity.source == "homogeneous_differentiator":
        return FilteredSource(0.0, period)
    if settings.velocity.is_measured:
        return MeasuredSource()
    return FilteredSource(settings.velocity.filter_time_constant, period)
