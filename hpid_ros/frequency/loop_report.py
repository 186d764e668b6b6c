"""What is known of one loop: its margins, what is certified of its law, what was measured."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from hpid_ros.frequency.family import Case, FamilyMargins, LoopFamily
from hpid_ros.frequency.margins import Margins
from hpid_ros.frequency.measured import Distance, MeasuredJoint
from hpid_ros.stability.gain_check import GainVerdict


@dataclass(frozen=True)
class LoopReport:
    """What is known of one loop."""

    family: LoopFamily  # its frozen loops
    found: FamilyMargins  # their margins
    verdict: GainVerdict  # on the law whose multiplier moves
    # the joint by a recording, and how far it is from the PID computed
    measured: tuple[MeasuredJoint, Distance] | None = None
    is_slide: bool = False  # whether the joint slides: its inertia is in kg

    @property
    def pid(self) -> FamilyMargins:
        """The margins of the linear PID with these gains."""
        return self.found.of((1.0,))

    @property
    def at_rest(self) -> FamilyMargins:
        """The margins where the norm is at its floor."""
        return self.found.of((self.family.at_rest,))

    @property
    def band(self) -> FamilyMargins:
        """The margins over every multiplier that the loop reaches."""
        return self.found.of(self.family.multipliers)

    def as_mapping(self) -> dict[str, Any]:
        """Return plain data for JSON; what is not finite is null."""
        family = self.family
        period = family.settings.timing.control_period
        document: dict[str, Any] = {
            "joint": family.settings.joint,
            "law": family.settings.law,
            "degree": family.settings.degree,
            "control_period": period,
            "inertia": family.inertia,
            "friction": family.friction,
            "delay": family.delay,
            "norm": family.norms,
            "multiplier": (family.multipliers[0], family.multipliers[-1]),
            "is_stable_frozen": self.band.is_stable,
            "is_certified": self.verdict.is_certified,
            "certified_degrees": self.verdict.interval,
            "reason": self.verdict.reason,
            "pid": _summary(self.pid),
            "at_rest": _summary(self.at_rest),
            "band": _summary(self.band),
            "cases": [_case(each) for each in self.found.cases],
        }
        if self.measured is not None:
            joint, apart = self.measured
            document["measured"] = {
                **apart._asdict(),
                "frequency": joint.frequency.tolist(),
                "real": joint.response.real.tolist(),
                "imaginary": joint.response.imag.tolist(),
                "coherence": joint.coherence.tolist(),
                "spread": joint.spread.tolist(),
                "candidates": joint.candidates,
                "duration": joint.duration,
            }
        return document


def _summary(found: FamilyMargins) -> dict[str, Any]:
    worst = found.worst
    return {
        "worst": None if worst is None else _figures(worst),
        "where": {
            name: {"inertia": at.inertia, "multiplier": at.multiplier}
            for name, at in found.where.items()
        },
        "unstable": [
            {"inertia": each.inertia, "multiplier": each.multiplier} for each in found.unstable
        ],
    }


def _case(case: Case) -> dict[str, Any]:
    margins = None if case.margins is None else _figures(case.margins)
    return {"inertia": case.inertia, "multiplier": case.multiplier, "margins": margins}


def _figures(margins: Margins) -> dict[str, Any]:
    low, high = margins.disk_gain
    values = {
        **asdict(margins),
        "disk_gain_reduction": low,
        "disk_gain": high,
        "disk_phase": margins.disk_phase,
    }
    return {name: value if math.isfinite(value) else None for name, value in values.items()}
