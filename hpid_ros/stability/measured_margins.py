r"""Margins of one loop with what is certified and what was measured.

Reference r, effort u and position q of a closed loop are correlated with the reference, which
the noise is not (joint input-output method):

.. math:: \hat P = S_{rq} / S_{ru}

is the joint from the effort sent to the position, hold and delay included. It is free of the bias
that the loop gives S_uq / S_uu, and does not depend on the law that was running. What the law of a
file makes of it is the measured open loop, :math:`\hat L = K \hat P`.

Source: L. Ljung, "System Identification" (2nd ed., 1999), section 13.5; R. Pintelon and
J. Schoukens, "System Identification: A Frequency Domain Approach" (2nd ed., 2012), section 2.6.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import csd, welch

from hpid_ros.base.errors import SettingError
from hpid_ros.base.units import SECONDS_PER_NANOSECOND, Numbers
from hpid_ros.messages.series import JointSeries, SeriesError
from hpid_ros.stability.frequency import Complexes, FrozenLoop
from hpid_ros.stability.gain_check import GainVerdict
from hpid_ros.stability.margins import FamilyMargins, LoopFamily, Margins

LEAST_COHERENCE = 0.95
_LEAST_POWER = 1e-4  # of the reference's largest density: where it does not excite
_SEGMENTS = 4.5  # lengths of one segment in the record, half of each overlapping the next
_LEAST_SAMPLES, _FIRST_BIN = 64, 3  # what the window smears from frequency 0 is left out
_RESTS = 1e-6  # of a reference's travel: no motion within one sample
_REST = 1.0  # [s] before and after a motion in which the joint is still at it
_LONGEST_STEP = 1.5  # of the period; beyond it a sample is missing
_PERIOD_TOLERANCE = 0.02


@dataclass(frozen=True, eq=False)
class MeasuredJoint:
    """A measured frequency response, at the frequencies at which it is certain."""

    frequency: Numbers  # [rad/s] (N,), increasing
    response: Complexes  # [rad/(N m)] from the effort sent to the position, (N,)
    coherence: Numbers  # the lesser of those of reference and effort, reference and position, (N,)
    spread: Numbers  # standard deviation of the response over its size, by the coherence, (N,)
    candidates: int  # how many frequencies there were
    period: float  # [s] median time between samples
    duration: float  # [s] of the stretch without a missing sample that was used


def measured_joint(
    series: JointSeries, least_coherence: float = LEAST_COHERENCE, control_period: float = 0.0
) -> MeasuredJoint:
    """Return a joint's frequency response from its recording.

    By Welch's method: Hann windows, half overlapping, at least eight in the record. A recording
    of another period than the loop's is refused, where that is given.
    """
    if not 0.0 < least_coherence < 1.0:
        raise SettingError(f"the least coherence must lie in (0, 1), not {least_coherence:g}")
    where = f"joint {series.joint!r}"
    if not (series.has_reference and series.has_effort):
        lacking = "effort" if series.has_reference else "reference"
        raise SeriesError(f"{where}: no {lacking} was recorded, hence no frequency response")
    period, (r, u, q) = _stretch(series)
    length = 2 ** math.floor(math.log2(max(r.size / _SEGMENTS, 1.0)))
    if length < _LEAST_SAMPLES:
        raise SeriesError(
            f"{where}: {r.size} samples without a gap are too few for a frequency response; "
            f"{math.ceil(_LEAST_SAMPLES * _SEGMENTS)} are needed"
        )
    if np.ptp(r) == 0.0:
        raise SeriesError(f"{where}: its reference does not move, and excites nothing")
    frequency, s_rr = welch(r, 1.0 / period, nperseg=length)
    s_uu, s_qq = (welch(each, 1.0 / period, nperseg=length)[1] for each in (u, q))
    s_ru, s_rq = (csd(r, each, 1.0 / period, nperseg=length)[1] for each in (u, q))
    with np.errstate(divide="ignore", invalid="ignore"):
        squares = [np.abs(s) ** 2 / (s_rr * own) for s, own in ((s_ru, s_uu), (s_rq, s_qq))]
        response = s_rq / s_ru
    coherence = np.nan_to_num(np.minimum(*squares))
    is_candidate = np.arange(frequency.size) >= _FIRST_BIN
    is_candidate[-1] = False  # the Nyquist frequency, where everything is real
    is_certain = is_candidate & (coherence >= least_coherence)
    is_certain &= s_rr >= _LEAST_POWER * s_rr[is_candidate].max(initial=0.0)
    if not is_certain.any():
        raise SeriesError(
            f"{where}: no frequency has a coherence of {least_coherence:g}: the reference does "
            f"not excite the joint, or something else moves it"
        )
    if control_period and abs(period - control_period) > _PERIOD_TOLERANCE * control_period:
        raise SettingError(
            f"{where}: the bag has a sample each {period:.6g} s, but control_period is "
            f"{control_period:g} s"
        )
    coherence = coherence[is_certain]
    windows = 2.0 * r.size / length - 1.0
    return MeasuredJoint(
        2.0 * math.pi * frequency[is_certain],
        response[is_certain],
        coherence,
        np.sqrt((1.0 - coherence) / (coherence * windows)),
        int(is_candidate.sum()),
        period,
        r.size * period,
    )


def _stretch(series: JointSeries) -> tuple[float, tuple[Numbers, Numbers, Numbers]]:
    """Return the period, and reference, effort and position of one stretch of samples.

    It is the one with most samples and most of the reference's travel; of it what is not long
    before or after that, when other joints may move.
    """
    stamps, states, commands = np.intersect1d(
        series.state_stamps_ns, series.command_stamps_ns, assume_unique=True, return_indices=True
    )
    if stamps.size < 2:
        raise SeriesError(f"joint {series.joint!r}: no command answers a state of the recording")
    steps = np.diff(stamps) * SECONDS_PER_NANOSECOND
    period = float(np.median(steps))
    breaks = np.flatnonzero(steps > _LONGEST_STEP * period) + 1
    edges = np.concatenate([[0], breaks, [stamps.size]])
    reference = series.reference[states]
    parts = [slice(int(a), int(b)) for a, b in pairwise(edges)]
    travels = [float(np.abs(np.diff(reference[each])).sum()) for each in parts]
    sizes = [each.stop - each.start for each in parts]
    part = max(zip(travels, sizes, parts, strict=True), key=lambda t: (t[0] * t[1], t[1]))[2]
    part = _moving(reference, part, math.ceil(_REST / period))
    return period, (reference[part], series.effort[commands[part]], series.position[states[part]])


def _moving(reference: Numbers, part: slice, rest: int) -> slice:
    """Return the part of a stretch from when a reference moves until it rests again."""
    own = reference[part]
    moving = np.flatnonzero(np.abs(np.diff(own)) > _RESTS * np.ptp(own))
    if not moving.size:
        return part
    begin, end = int(moving[0]) - rest, int(moving[-1]) + 2 + rest
    return slice(part.start + max(begin, 0), min(part.start + end, part.stop))


class Distance(NamedTuple):
    """How far a measured open loop is from a computed one."""

    median: float  # of |measured / computed - 1| over the frequencies
    most: float  # what 95 % of them stay below
    inertia: float  # [kg m^2] what inertia the measured gain stands for
    sensitivity: float  # the largest |S| among the measured frequencies
    computed_sensitivity: float  # the largest |S| of the computed loop at the same frequencies


def distance(loop: FrozenLoop, measured: MeasuredJoint) -> Distance:
    """Compare a computed loop with a measured joint under the same controller."""
    computed = loop.response(measured.frequency)
    joint = loop.joint.response(measured.frequency).position
    found = measured_loop(loop, measured)
    off = np.abs(found / computed - 1.0)
    gain = math.exp(float(np.median(np.log(np.abs(measured.response / joint)))))
    return Distance(
        float(np.median(off)),
        float(np.quantile(off, 0.95)),
        loop.joint.inertia / gain,
        float((1.0 / np.abs(1.0 + found)).max()),
        float((1.0 / np.abs(1.0 + computed)).max()),
    )


def nearest_distance(family: LoopFamily, measured: MeasuredJoint) -> Distance:
    """Return the distance to the PID on the inertia of its range nearest to the measured one."""
    low, high = family.inertia
    own = distance(family.loop(low), measured).inertia
    return distance(family.loop(min(max(own, low), high)), measured)


def measured_loop(loop: FrozenLoop, measured: MeasuredJoint) -> Complexes:
    """Return the open loop that a controller makes of a measured joint, (N,)."""
    return loop.controller(measured.frequency) * measured.response


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
            "cases": [
                {
                    "inertia": each.inertia,
                    "multiplier": each.multiplier,
                    "margins": None if each.margins is None else _figures(each.margins),
                }
                for each in self.found.cases
            ],
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


def _figures(margins: Margins) -> dict[str, Any]:
    low, high = margins.disk_gain
    values = {
        **asdict(margins),
        "disk_gain_reduction": low,
        "disk_gain": high,
        "disk_phase": margins.disk_phase,
    }
    return {name: value if math.isfinite(value) else None for name, value in values.items()}
