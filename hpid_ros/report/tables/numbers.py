"""Numbers of tables as texts, and the notes on those that are not defined."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Sequence

from hpid_ros.analysis.comparison import Comparison, enumerate_words
from hpid_ros.analysis.quantities import Quantity
from hpid_ros.analysis.results import RunIndices

SIGNIFICANT_DIGITS = 5
# Beyond these a column is scientific: plain digits would be many, or zeros.
SMALLEST_PLAIN, LARGEST_PLAIN = 1e-3, 1e6
UNDEFINED = "–"


def format_values(values: Iterable[float], digits: int = SIGNIFICANT_DIGITS) -> list[str]:
    """Return numbers of one column with the same decimals, so that their points line up.

    The largest decides: it shows about `digits` digits. A number that would read as zero
    without being zero, and a column of very large or small numbers, are scientific.
    """
    column = list(values)
    largest = max((abs(value) for value in column if math.isfinite(value)), default=0.0)
    if largest and not SMALLEST_PLAIN <= largest < LARGEST_PLAIN:
        return [_scientific(value) for value in column]
    whole = max(1, math.floor(math.log10(largest)) + 1) if largest else 1
    decimals = max(0, digits - whole)
    texts = [f"{value:.{decimals}f}" for value in column]
    return [
        text if math.isfinite(value) and (not value or float(text)) else _scientific(value)
        for value, text in zip(column, texts, strict=True)
    ]


def format_ratio(ratio: float) -> str:
    """Return a ratio in at most five characters or so: 0.612, 12.35, 1.2e5, inf."""
    if math.isnan(ratio):
        return UNDEFINED
    if math.isinf(ratio) or ratio < 10.0:
        return f"{ratio:.3f}"
    return f"{ratio:.4g}" if ratio < 1e4 else _scientific(ratio)


def format_quartiles(quartiles: tuple[float, float] | None) -> str:
    """Return the quartiles of repeated runs as one text."""
    if quartiles is None:
        return UNDEFINED
    low, high = format_values(quartiles, SIGNIFICANT_DIGITS - 1)
    return f"{low}..{high}"


def _scientific(value: float) -> str:
    if math.isnan(value):
        return UNDEFINED
    if math.isinf(value):
        return "inf" if value > 0.0 else "-inf"
    if value == 0.0:
        return "0"
    mantissa, exponent = f"{value:.1e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def footnotes(comparison: Comparison) -> list[str]:
    """Return what units mean and why numbers and ratios are not defined, one sentence each."""
    return [*_of_units(comparison), *_of_numbers(comparison), *_of_ratios(comparison)]


def slides_note(joints: Sequence[str], slides: Collection[str], angle_unit: str = "rad") -> str:
    """Return a sentence on joints of unlike units that stand beside each other; else nothing."""
    sliding = [joint for joint in joints if joint in slides]
    if len(sliding) in (0, len(joints)):
        return ""
    verb = "slides" if len(sliding) == 1 else "slide"
    return (
        f"{enumerate_words(sliding)} {verb}, in m and N; the others are in {angle_unit} and N m. "
        "Totals add unlike units."
    )


def _of_units(comparison: Comparison) -> Iterator[str]:
    note = slides_note(comparison.joint_names, comparison.slides, comparison.angle_unit)
    units = (comparison.unit(each) for each in (*comparison.indices, *comparison.norms))
    if note and any("," in unit for unit in units):
        yield note


def _of_numbers(comparison: Comparison) -> Iterator[str]:
    """Yield a sentence for each reason, with the symbols, runs and joints that it concerns."""
    symbols: dict[tuple[str, tuple[str, ...], str], list[str]] = {}
    for run in comparison.runs:
        for quantity in (*comparison.indices, *comparison.norms):
            for reason, joints in _joints_by_reason(comparison, run, quantity).items():
                where = () if len(joints) == len(run.joints) else tuple(joints)
                symbols.setdefault((reason, where, run.label), []).append(quantity.symbol)
    labels: dict[tuple[str, tuple[str, ...], str], list[str]] = {}
    for (reason, joints_of, label), of_run in symbols.items():
        labels.setdefault((", ".join(of_run), joints_of, reason), []).append(label)
    for (what, joints_of, reason), of_runs in labels.items():
        runs = f" of {enumerate_words(of_runs)}" if len(of_runs) < len(comparison.runs) else ""
        where_text = f", joint {', '.join(joints_of)}" if joints_of else ""
        yield f"No {what}{runs}{where_text}: {reason}."


def _joints_by_reason(
    comparison: Comparison, run: RunIndices, quantity: Quantity
) -> dict[str, list[str]]:
    """Return which joints' lack leaves a number undefined, by reason."""
    scopes = comparison.joint_names if quantity in comparison.indices else (None,)
    reasons: dict[str, list[str]] = {}
    for scope in scopes:
        for joint, reason in run.why_undefined(quantity, scope).items():
            reasons.setdefault(reason, []).append(joint)
    return reasons


def _of_ratios(comparison: Comparison) -> Iterator[str]:
    """Yield a sentence for each way in which a run cannot be compared with the baseline."""
    count = len((*comparison.indices, *comparison.norms))
    for run in comparison.others:
        for reason, spoilt in comparison.spoilt(run.label).items():
            symbols = ", ".join(quantity.symbol for quantity in spoilt)
            what = "ratios" if len(spoilt) == count else f"ratios of {symbols}"
            yield f"No {what} of {run.label} to {comparison.baseline.label}: {reason}."
