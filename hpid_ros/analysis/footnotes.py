"""Why numbers and ratios of a table are not defined: the notes below it."""

from __future__ import annotations

from collections.abc import Iterator

from hpid_ros.analysis.comparison import Comparison, enumerate_words
from hpid_ros.analysis.quantities import Quantity
from hpid_ros.analysis.results import RunIndices


def footnotes(comparison: Comparison) -> list[str]:
    """Return why numbers and ratios that are shown are not defined, one sentence each.

    Args:
        comparison: The comparison.
    """
    return [*_of_numbers(comparison), *_of_ratios(comparison)]


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
