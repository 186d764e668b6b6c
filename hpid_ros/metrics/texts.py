"""The comparison as text for machines and pipes: plain lines, CSV and JSON, and its numbers."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

from hpid_ros.base.text import csv_text, shown, shown_lines
from hpid_ros.metrics.comparison import (
    THRESHOLD,
    Comparison,
    Verdict,
    enumerate_words,
    verdict,
    verdict_lines,
)
from hpid_ros.metrics.quantities import PAPER, Data, Fold, Quantity
from hpid_ros.metrics.results import RunIndices

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


MARKS = {Verdict.BETTER: "▼", Verdict.WORSE: "▲", Verdict.EQUAL: "=", Verdict.UNKNOWN: " "}


class Cell(NamedTuple):
    """A number, or a ratio with its verdict."""

    text: str
    verdict: Verdict | None = None  # of a ratio

    @property
    def mark(self) -> str:
        """The verdict's sign; empty for a number."""
        return "" if self.verdict is None else MARKS[self.verdict]


def ratio_cell(ratio: float) -> Cell:
    return Cell(format_ratio(ratio), verdict(ratio))


def ratio_legend(baseline: str, marks: Mapping[Verdict, str]) -> str:
    return (
        f"Ratio: run / {baseline}; {marks[Verdict.BETTER]} lower, which is better, "
        f"{marks[Verdict.WORSE]} higher, {marks[Verdict.EQUAL]} equal {THRESHOLD}."
    )


def heading_of(run: RunIndices) -> str:
    """Return a run's label, with the number of its repeats where there are several."""
    label = shown(run.label)
    return label if run.spread is None else f"{label} ({run.spread.repeats})"


def headings_of(comparison: Comparison) -> list[str]:
    """Return the headings of what :func:`cells_of` gives of a joint."""
    headings: list[str] = []
    for run in comparison.runs:
        headings.append(heading_of(run))
        headings += [] if run.spread is None else ["quartiles"]
        headings += [] if run is comparison.baseline else ["ratio"]
    return headings


def total_name(quantities: Sequence[Quantity]) -> str:
    """Return what the last line of a table is called."""
    return "total" if all(quantity.fold is Fold.SUM for quantity in quantities) else "all"


def cells_of(
    comparison: Comparison,
    quantity: Quantity,
    joints: Sequence[str | None],
    digits: int = SIGNIFICANT_DIGITS,
) -> list[list[Cell]]:
    """Return for each joint the cells of all runs and ratios; the joint None stands for all."""
    values = [run.value(quantity, joint) for joint in joints for run in comparison.runs]
    texts = iter(format_values(values, digits))
    rows = []
    for joint in joints:
        row: list[Cell] = []
        for run in comparison.runs:
            row.append(Cell(next(texts)))
            if run.spread is not None:
                quartiles = run.spread.quartiles[joint].get(quantity.key)
                row.append(Cell(format_quartiles(quartiles)))
            if run is not comparison.baseline:
                row.append(ratio_cell(comparison.ratio(run.label, quantity, joint)))
        rows.append(row)
    return rows


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


CSV_COLUMNS = (
    "run",
    "scope",
    "joint",
    "quantity",
    "unit",
    "value",
    "ratio",
    "repeats",
    "first_quartile",
    "third_quartile",
    "note",
    "against",
)


def table_csv(comparison: Comparison) -> str:
    """Return every number in long form, one a row, at full precision.

    Columns: :data:`CSV_COLUMNS`. ``scope`` is ``joint``, ``total`` (the sum over joints),
    ``all`` (folded in another way) or ``norm`` (over all joints), and ``joint`` is empty but for
    the first; ``value`` is empty where it is not defined; ``ratio`` is the value over the
    baseline's (``inf`` against zero) and empty in the baseline's own rows; repeats and
    quartiles are empty for a single run; ``note`` says why value or ratio are not defined, and
    what stands in for a recorded reference or commanded efforts; ``against`` has kind and topic of
    the reference, of numbers of the error.
    """
    rows: list[tuple[object, ...]] = [CSV_COLUMNS]
    for run in comparison.runs:
        for joint in comparison.joint_names:
            for quantity in comparison.indices:
                rows.append(_csv_row(comparison, run, "joint", joint, quantity))
        for quantity in comparison.indices:
            scope = "total" if quantity.fold is Fold.SUM else "all"
            rows.append(_csv_row(comparison, run, scope, None, quantity))
        for quantity in comparison.norms:
            rows.append(_csv_row(comparison, run, "norm", None, quantity))
    return csv_text(rows)


def _csv_row(
    comparison: Comparison, run: RunIndices, scope: str, joint: str | None, quantity: Quantity
) -> tuple[object, ...]:
    ratio: object = ""
    if run is not comparison.baseline:
        ratio = _plain(comparison.ratio(run.label, quantity, joint))
    spread: tuple[object, ...] = ("", "", "")
    if run.spread is not None:
        quartiles = run.spread.quartiles[joint].get(quantity.key, (math.nan, math.nan))
        spread = (run.spread.repeats, *(_plain(value) for value in quartiles))
    value, unit = _plain(run.value(quantity, joint)), comparison.unit(quantity, joint)
    note = "; ".join(_notes(comparison, run, joint, quantity))
    against = _against(run, joint) if quantity.needs is Data.REFERENCE else ""
    return (
        run.label,
        scope,
        joint or "",
        quantity.key,
        unit,
        value,
        ratio,
        *spread,
        note,
        against,
    )


def _against(run: RunIndices, joint: str | None) -> str:
    """Return what the error of a joint, or of all, was measured against."""
    if joint is not None:
        return run.against.get(joint, "")
    return "; ".join(dict.fromkeys(run.against.values()))


def _notes(
    comparison: Comparison, run: RunIndices, joint: str | None, quantity: Quantity
) -> Iterator[str]:
    """Yield what one number must be read with."""
    yield from dict.fromkeys(run.why_undefined(quantity, joint).values())
    if quantity.needs in run.assumed:
        yield f"{quantity.needs.value}: {run.assumed[quantity.needs]}"
    if joint is None and (text := run.left_out(quantity.needs)):
        yield text
    if run.cut:
        yield run.cut
    for each in comparison.differences(run.label):
        if quantity.key in each.spoils:
            yield f"not compared: {each.text}"


def _plain(value: float) -> float | str:
    return "" if math.isnan(value) else float(value)


def table_json(comparison: Comparison) -> str:
    return json.dumps(comparison.as_mapping(), indent=2) + "\n"


def legend_of(comparison: Comparison, marks: Mapping[Verdict, str] = MARKS) -> list[str]:
    """Return what symbols and marks of a table mean, one sentence each."""
    symbols = comparison.indices or comparison.norms
    lines = [", ".join(f"{each.symbol} {each.meaning}" for each in symbols) + "."]
    if any(run.spread for run in comparison.runs):
        lines.append("(n): median of n runs, with the first and third quartile.")
    if comparison.others:
        lines.append(ratio_legend(heading_of(comparison.baseline), marks))
    return lines


def verdicts_of(comparison: Comparison) -> list[str]:
    """Return the sentences on the paper's indices, where all of them are there."""
    is_paper = {*comparison.indices, *comparison.norms} >= set(PAPER)
    return list(verdict_lines(comparison)) if is_paper else []


def table_lines(comparison: Comparison) -> str:
    """Return every number in plain columns, one row for each index and joint, and what to know."""
    rows = [["index", "joint", *headings_of(comparison)]]
    for quantity in (*comparison.indices, *comparison.norms):
        is_norm = quantity not in comparison.indices
        joints = (None,) if is_norm else (*comparison.joint_names, None)
        title = f"{quantity.symbol} [{comparison.unit(quantity)}]"
        for joint, cells in zip(joints, cells_of(comparison, quantity, joints), strict=True):
            name = shown(joint) if joint else "all" if is_norm else total_name([quantity])
            rows.append([title, name, *(f"{each.text}{each.mark}" for each in cells)])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for title, name, *numbers in rows:
        columns = [title.ljust(widths[0]), name.ljust(widths[1])]
        columns += [each.rjust(width) for each, width in zip(numbers, widths[2:], strict=True)]
        lines.append("  ".join(columns).rstrip())
    notes = [*legend_of(comparison), *comparison.notes, *footnotes(comparison)]
    return shown_lines("\n".join([*lines, "", *notes, *verdicts_of(comparison)])) + "\n"


FORMATS: Mapping[str, Callable[[Comparison], str]] = {
    "table": table_lines,
    "csv": table_csv,
    "json": table_json,
}
"""What writes a comparison, by the format's name."""
