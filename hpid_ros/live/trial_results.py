"""What test motions are carried out with, and what their recordings say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hpid_ros.analysis.comparison import Comparison
from hpid_ros.bags.selection import BagSelection
from hpid_ros.base.errors import RunError
from hpid_ros.control.settings.table import Value
from hpid_ros.excitation.plan import ExcitationPlan
from hpid_ros.live.tuning import Values, differences, same
from hpid_ros.metrics.compare import compare
from hpid_ros.metrics.measure import Measured, Measuring, measure
from hpid_ros.recordings.series import JointSeries

_AFTER = 0.3  # [s] of a recording behind the motion that are measured
_STANDS_WITHIN = 1e-9  # [rad]


@dataclass(frozen=True)
class Variant:
    """What controllers are set to for one motion."""

    label: str  # what it is called
    values: Mapping[str, Values] | None = None  # all loop parameters by node


class Tried:
    """What a trial sets: what its variants differ in from what was there, and nothing else."""

    def __init__(self, before: Mapping[str, Values], variants: Sequence[Variant]) -> None:
        self._before = before
        self._names = {
            node: {
                name
                for each in variants
                for name in differences(had, (each.values or {}).get(node, {}))
            }
            for node, had in before.items()
        }
        self._set: dict[str, dict[str, Value]] = {node: {} for node in before}

    def wanted(self, variant: Variant) -> dict[str, Values]:
        """Return what controllers are to be set to for a variant, by node."""
        values = variant.values or {}
        return {
            node: {name: values[node][name] for name in names if name in values[node]}
            for node, names in self._names.items()
            if node in values
        }

    def note(self, values: Mapping[str, Values]) -> None:
        """Take note of what was set."""
        for node, each in values.items():
            self._set[node] |= each

    def to_give_back(self, in_force: Mapping[str, Values]) -> dict[str, Values]:
        """Return what there was, of what is still as the trial has set it, by node."""
        return {
            node: {
                name: self._before[node][name]
                for name, value in tried.items()
                if same(in_force[node][name], value) and not same(self._before[node][name], value)
            }
            for node, tried in self._set.items()
        }


@dataclass(frozen=True)
class TrialResult:
    """Motions that were measured."""

    variants: tuple[Variant, ...]  # in their order
    runs: tuple[Measured, ...]  # of each
    comparison: Comparison  # of all, ratios to the first
    bags: tuple[Path, ...]  # their recordings

    @classmethod
    def of(cls, variants: Sequence[Variant], runs: Sequence[Measured]) -> TrialResult:
        """Compare the motions that came to their ends, the first so many of the variants."""
        tried = tuple(variants)[: len(runs)]
        return cls(tried, tuple(runs), compare(runs), tuple(each.path for each in runs))


def measure_motion(bag: Path, label: str, planned: ExcitationPlan) -> Measured:
    """Measure a recording from the plan's start on.

    What a joint was told before, which is still on the graph, is in the recording, too: so the
    start is counted back from when the last reference came to rest.
    """
    selection = BagSelection(joints=planned.names)
    series = measure(bag, label, Measuring(selection)).series
    assert series is not None
    rests = [_rests_at(each) for each in series.joints if each.has_reference]
    if not rests:
        raise RunError(f"{label}: the recording tells no reference")
    begin = max(max(rests) - max(each.end for each in planned.joints), 0.0)
    end = begin + planned.duration + _AFTER
    return measure(bag, label, Measuring(replace(selection, start=begin, end=end)))


def _rests_at(series: JointSeries) -> float:
    """Return when a reference changes for the last time, in [s]."""
    moved = np.flatnonzero(np.abs(series.reference - series.reference[-1]) > _STANDS_WITHIN)
    return float(series.time[moved[-1]]) if len(moved) else 0.0
