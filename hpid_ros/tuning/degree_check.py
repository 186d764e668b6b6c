"""Says of many loops whether they are stable and certified, each kind of loop computed once."""

from __future__ import annotations

from collections.abc import Hashable

from hpid_ros.control import LoopSettings
from hpid_ros.control.closed_loop import effective_gains
from hpid_ros.control.gains import is_hurwitz
from hpid_ros.control.stability import certify_degree
from hpid_ros.errors import GainError, NormError, SettingError

_DIGITS = 9
"""Loops whose gains over their inertia agree to so many digits are one: the margins with which
certificates are accepted are larger by orders of magnitude."""


class DegreeChecker:
    """Remembers what it found: joints tuned by one rule have one and the same loop."""

    def __init__(self) -> None:
        self._known: dict[Hashable, str] = {}

    def instability(self, settings: LoopSettings) -> str:
        """Return why a loop is unstable as a linear PID, in one line; empty if it is stable.

        Args:
            settings: The loop.

        Raises:
            SettingError: Its inertia is not known.
        """
        if not settings.plant_inertia > 0.0:
            raise SettingError(
                f"the inertia of {settings.joint!r} is not known: set its parameter inertia"
            )
        if is_hurwitz(settings.gains, settings.plant_inertia):
            return ""
        gains, inertia = settings.gains, settings.plant_inertia
        return (
            f"unstable as a linear PID: p d = {gains.p * gains.d:g} must exceed "
            f"i x inertia = {gains.i * inertia:g}"
        )

    def refusal(self, settings: LoopSettings) -> str:
        """Return why a loop is not certified, in one line; empty if it is.

        The linear law is certified by Routh and Hurwitz, the homogeneous one at its degree by
        :func:`~hpid_ros.control.stability.certify_degree`, at the inertia of its settings.

        Args:
            settings: The loop.

        Raises:
            SettingError: Its inertia is not known.
        """
        reason = self.instability(settings)
        if reason or settings.law == "pid" or settings.mu == 0.0:
            return reason
        gains = effective_gains(settings.gains, settings.plant_inertia)
        rounded = tuple(float(f"{each:.{_DIGITS}g}") for each in (gains.p, gains.i, gains.d))
        key = (
            *rounded,
            settings.mu,
            settings.norm_type,
            settings.norm_error_scale,
            settings.norm_rate_weight,
        )
        if key not in self._known:
            self._known[key] = _reason(settings)
        return self._known[key]


def _reason(settings: LoopSettings) -> str:
    try:
        certify_degree(settings.gains, settings.make_norm(), settings.plant_inertia)
    except (GainError, NormError) as error:
        return f"not certified at mu = {settings.mu:g}: {error}"
    return ""
