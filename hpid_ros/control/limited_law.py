"""A law with its model term, limits and anti-windup: from an error to an effort."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hpid_ros.control.assembly import make_anti_windup, make_law, make_motion_limits
from hpid_ros.control.homogeneous_pid import Terms
from hpid_ros.control.limits import LimitedSample, MotionLimits
from hpid_ros.control.model import ModelTerm
from hpid_ros.control.overrides import Relay
from hpid_ros.control.settings import LoopSettings


@dataclass(slots=True)
class LawSample:
    """What the law is given in one sample."""

    error: float  # [rad] reference minus position
    error_rate: float  # [rad/s]
    dt: float  # [s] over which the error is integrated
    position: float  # [rad] for the limits: measured, not an observer's
    velocity: float  # [rad/s] for the limits
    acceleration: float  # [rad/s^2] of the reference, for a model that follows it
    feedforward: float  # [N m] added to the effort
    model: ModelTerm | None


def _within(value: float, least: float, most: float) -> float:
    """Return a value held to its limits; in Python quicker than ``min`` of ``max``."""
    if value < least:
        return least
    return most if value > most else value


class LimitedLaw:
    """The law of one joint with model term, relay, limits and anti-windup."""

    __slots__ = (
        "_added_effort",
        "_anti_windup",
        "_clamp",
        "_has_integral",
        "_integral_clamp",
        "_is_external",
        "_law",
        "_model_offset",
        "_terms",
        "effort",
        "is_saturated",
        "limits",
        "model_effort",
        "model_gain",
        "relay",
    )

    effort: float  # [N m] the active effort
    model_gain: float  # what the model multiplied the law's last output by; 1 without a model
    model_effort: float  # [N m] what the model added in the last sample, before the limits
    is_saturated: bool  # whether the effort of the last sample was limited

    def __init__(self, settings: LoopSettings) -> None:
        self.is_saturated = False
        self.relay: Relay | None = None
        self._law = make_law(settings)
        self._adopt(settings, make_motion_limits(settings))
        self.reset()

    def _adopt(self, settings: LoopSettings, limits: MotionLimits | None) -> None:
        """Take from settings what is looked at in each sample."""
        effort, integral = settings.effort, settings.integral
        self._clamp = effort.u_clamp_min, effort.u_clamp_max
        self._integral_clamp = integral.i_clamp_min, integral.i_clamp_max
        self._has_integral = settings.gains.i > 0.0
        self._anti_windup, self.limits = make_anti_windup(settings), limits

    @property
    def terms(self) -> Terms:
        """The law's terms of the last sample in [N m], before the limits."""
        (p, i, d), gain = self._terms, self.model_gain
        return Terms(gain * p, gain * i, gain * d)

    @property
    def integral(self) -> float:
        """The integral term that the next sample uses, in [N m]."""
        return self.model_gain * self._law.integral

    @property
    def braked(self) -> int:
        """Samples in which a soft stop or the velocity limit braked the joint."""
        return self.limits.braked if self.limits else 0

    def retune(self, settings: LoopSettings, where: tuple[float, float] | None) -> float:
        """Apply other settings; the integral stays, and the effort is within the limits.

        Return what ``i_clamp`` takes from the integral, in [N m].
        """
        law, integral = make_law(settings), self._law.integral
        limits = make_motion_limits(settings)
        effort = settings.effort.within(self.effort)
        if limits is not None and where is not None:  # position and velocity
            limits.replace(self.limits, where[0])
            braked = limits.braked
            effort = limits.limit(effort, *where, before=effort, dt=0.0)
            limits.braked = braked  # this is no sample
        self._adopt(settings, limits)
        self._law = law
        self.restore_integral(integral)
        if effort != self.effort:
            self.override_effort(effort)
        return self.model_gain * (integral - law.integral)

    def restore_integral(self, integral: float) -> None:
        """Replace the integral, in the law's own units, within its limits."""
        if self._has_integral:
            least, most = self._integral_clamp
            integral = _within(integral, least, most)
        self._law.restore_integral(integral)

    @property
    def driving_effort(self) -> float:
        """The active effort without the model's own, in the law's units."""
        return (self.effort - self._model_offset) / self.model_gain

    def reduce_model_effort(self, effort: float) -> None:
        """Note that so much less of the active effort is the model's, in [N m]."""
        self.model_effort -= effort
        self._model_offset -= effort

    def absorb_added_effort(self, effort: float) -> float:
        """Reduce the integral by an effort added elsewhere; return what it could not take."""
        before = self._law.integral
        if self._has_integral:
            least, most = self._integral_clamp
            wanted = before - effort / self.model_gain
            self._law.restore_integral(min(max(wanted, min(least, before)), max(most, before)))
        return effort + self.model_gain * (self._law.integral - before)

    def override_effort(self, effort: float) -> None:
        """Note an effort that was given, but not computed by the law."""
        self.effort = effort
        self.disown_effort()

    def disown_effort(self) -> None:
        """Note that the active effort is not the sum of the law's terms: a takeover keeps it."""
        self._is_external = True

    def reset(self) -> None:
        """Forget the integral, and be without effort."""
        self._law.reset()
        self._terms = 0.0, 0.0, 0.0
        self.override_effort(0.0)
        self.model_gain = 1.0
        self.model_effort = self._model_offset = self._added_effort = 0.0

    def take_over(
        self,
        *,
        model: ModelTerm | None,
        feedforward: float,
        is_next: bool,
    ) -> float:
        """Start again with the active effort, by choice of the integral.

        ``feedforward`` is without what an acceleration needs, which is soon another. Return what
        the integral may not give of the effort, in [N m]: nothing would take it away again.
        """
        law = self._law
        integral = self.effort
        if is_next and not self._is_external:
            terms = self.terms
            rest = terms.p + terms.i + self.model_effort + self._added_effort
            if self.limits is not None and self.is_saturated:  # what they took is not in force
                rest = self.effort - terms.d
            integral = _within(rest, *self._clamp)
        integral -= feedforward
        gain = 1.0
        if model is not None:
            gain = model.gain
            integral = (integral - model.effort) / gain
        law.reset()
        self._terms = 0.0, 0.0, 0.0
        if self._has_integral:
            self.restore_integral(integral)
        return gain * (integral - law.integral)

    def update(self, sample: LawSample) -> float:
        """Take one sample and return its effort in [N m]."""
        error, error_rate, dt, model = sample.error, sample.error_rate, sample.dt, sample.model
        law = self._law
        before = law.integral
        try:
            proportional, derivative, increment = law.answer(error, error_rate, dt)
        except OverflowError:  # a power of an absurd but finite error
            raise ArithmeticError(f"the law gave inf N m at an error of {error} rad") from None
        wanted = proportional + derivative + before
        self._terms = proportional, before, derivative
        if model is None:
            self.model_gain = gain = 1.0
            self.model_effort = self._model_offset = 0.0
        else:
            self.model_gain = gain = model.gain
            self._model_offset = added = model.effort
            if model.follows_acceleration:
                added += gain * sample.acceleration
            self.model_effort = added
            wanted = gain * wanted + added
        self._added_effort = feedforward = sample.feedforward
        if feedforward:
            wanted += feedforward
        after = before + increment
        if self.relay is not None:
            wanted += self.relay.update(error, error_rate, gain * (proportional + derivative), dt)
            after -= self.relay.weight * (after - before)
            if self.relay.is_over:
                self.relay = None
        if not (math.isfinite(wanted) and math.isfinite(after)):
            raise ArithmeticError(f"the law gave {wanted} N m at an error of {error} rad")
        if self.limits is None:
            least, most = self._clamp
            effort = _within(wanted, least, most)
        else:
            effort = self.limits.limit(wanted, sample.position, sample.velocity, self.effort, dt)
        self.is_saturated = effort != wanted
        if self.is_saturated:
            # In the law's own units: what the limits took was taken from the law's output.
            limited = LimitedSample(before, after, wanted / gain, effort / gain, error, dt)
            after = self._anti_windup(limited)
        self.restore_integral(after)
        self.effort, self._is_external = effort, False
        return effort
