"""A law with its model term, limits and anti-windup: from an error to an effort."""

from __future__ import annotations

import math

from hpid_ros.control.assembly import make_anti_windup, make_law, make_motion_limits
from hpid_ros.control.homogeneous_pid import Terms
from hpid_ros.control.limits import MotionLimits
from hpid_ros.control.model import ModelTerm
from hpid_ros.control.overrides import Relay
from hpid_ros.control.settings import LoopSettings


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
        terms, gain = self._law.terms, self.model_gain
        return Terms(gain * terms.p, gain * terms.i, gain * terms.d)

    @property
    def integral(self) -> float:
        """The integral term that the next sample uses, in [N m]."""
        return self.model_gain * self._law.integral

    def retune(self, settings: LoopSettings, where: tuple[float, float] | None) -> float:
        """Apply other settings; the integral stays, and the effort is within the limits.

        Return what ``i_clamp`` takes from the integral, in [N m].
        """
        law = make_law(settings)
        law.continue_from(self._law)
        limits = make_motion_limits(settings)
        effort = settings.effort.within(self.effort)
        if limits is not None and where is not None:  # position and velocity
            limits.replace(self.limits, where[0])
            braked = limits.braked
            effort = limits.limit(effort, *where, before=effort, dt=0.0)
            limits.braked = braked  # this is no sample
        self._adopt(settings, limits)
        self._law, integral = law, law.integral
        self.restore_integral(integral)
        if effort != self.effort:
            self.override_effort(effort)
        return self.model_gain * (integral - law.integral)

    def restore_integral(self, integral: float) -> None:
        """Replace the integral, in the law's own units, within its limits."""
        if self._has_integral:
            least, most = self._integral_clamp
            integral = min(max(integral, least), most)
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
        self.effort, self._is_external = effort, True

    def reset(self) -> None:
        """Forget the integral, and be without effort."""
        self._law.reset()
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
        law, (least, most) = self._law, self._clamp
        integral = self.effort
        if is_next and not self._is_external:
            terms = self.terms
            rest = terms.p + terms.i + self.model_effort + self._added_effort
            if self.limits is not None and self.is_saturated:  # what they took is not in force
                rest = self.effort - terms.d
            integral = min(max(rest, least), most)
        integral -= feedforward
        gain = 1.0
        if model is not None:
            gain = model.gain
            integral = (integral - model.effort) / gain
        law.reset()
        if self._has_integral:
            self.restore_integral(integral)
        return gain * (integral - law.integral)

    def update(
        self,
        error: float,
        error_rate: float,
        dt: float,
        *,
        position: float,
        velocity: float,
        model: ModelTerm | None,
        acceleration: float,
        feedforward: float,
    ) -> float:
        """Take one sample: position and velocity for the limits, the rest for the effort."""
        law = self._law
        before = law.integral
        try:
            wanted = law.update(error, error_rate, dt)
        except OverflowError:  # a power of an absurd but finite error
            wanted = math.inf
        if model is None:
            self.model_gain = gain = 1.0
            self.model_effort = self._model_offset = 0.0
        else:
            self.model_gain = gain = model.gain
            self._model_offset = added = model.effort
            if model.follows_acceleration:
                added += gain * acceleration
            self.model_effort = added
            wanted = gain * wanted + added
        self._added_effort = feedforward
        if feedforward:
            wanted += feedforward
        if self.relay is not None:
            terms = law.terms
            wanted += self.relay.update(error, error_rate, gain * (terms.p + terms.d), dt)
            law.restore_integral(law.integral - self.relay.weight * (law.integral - before))
            if self.relay.is_over:
                self.relay = None
        after = law.integral
        if not (math.isfinite(wanted) and math.isfinite(after)):
            law.restore_integral(before)
            raise ArithmeticError(f"the law gave {wanted} N m at an error of {error} rad")
        if self.limits is None:
            least, most = self._clamp
            effort = min(max(wanted, least), most)
        else:
            effort = self.limits.limit(wanted, position, velocity, self.effort, dt)
        self.is_saturated = effort != wanted
        # In the law's own units: what is taken from the effort is taken from the law's output.
        integral = self._anti_windup(before, after, error, wanted / gain, effort / gain, dt)
        self.restore_integral(integral)
        self.effort, self._is_external = effort, False
        return effort
