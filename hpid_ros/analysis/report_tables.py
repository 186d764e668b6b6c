"""The indices as HTML tables for the report."""

from __future__ import annotations

import re
from collections.abc import Sequence

from hpid_ros.analysis.comparison import THRESHOLD, Comparison, Verdict, verdict
from hpid_ros.analysis.footnotes import footnotes
from hpid_ros.analysis.number_text import format_ratio, format_values
from hpid_ros.analysis.quantities import QUANTITIES, Quantity
from hpid_ros.analysis.report_facts import scrolling
from hpid_ros.analysis.table import MARKS, heading_of, quartiles_of, total_name
from hpid_ros.foreign_text import html_text

_SPOKEN = {
    Verdict.BETTER: "lower",
    Verdict.WORSE: "higher",
    Verdict.EQUAL: "equal",
    Verdict.UNKNOWN: "not defined",
}


def index_table(comparison: Comparison) -> str:
    """Return the paper's Table I: joints by indices, runs and ratios, a total line.

    Args:
        comparison: What it shows.
    """
    headings = _run_headings(comparison)
    groups = "".join(
        f'<th class="group first" scope="colgroup" colspan="{len(headings)}">'
        f"{html_text(quantity.symbol)} [{_unit(comparison, quantity)}]</th>"
        for quantity in comparison.indices
    )
    labels = "".join(_group_cells("th", headings)) * len(comparison.indices)
    joints = (*comparison.joint_names, None)
    cells = {q: _index_cells(comparison, q, joints) for q in comparison.indices}
    total = total_name(comparison.indices)
    rows = [
        f'<tr><th scope="row">{html_text(joint or total)}</th>'
        f"{''.join(''.join(cells[quantity][k]) for quantity in comparison.indices)}</tr>"
        for k, joint in enumerate(joints)
    ]
    return scrolling(
        "Indices of each joint",
        f'<table><thead><tr><th class="text" scope="col" rowspan="2">joint</th>{groups}</tr>'
        f"<tr>{labels}</tr></thead><tbody>{''.join(rows[:-1])}</tbody>"
        f"<tfoot>{rows[-1]}</tfoot></table>",
        len(headings) * len(comparison.indices),
    )


def norm_table(comparison: Comparison) -> str:
    """Return what the comparison shows over all joints alone: the L2 norms.

    Args:
        comparison: What it shows.
    """
    return _overall_table(comparison, comparison.norms, "L2 norms over all joints")


def further_tables(comparison: Comparison) -> list[str]:
    """Return every quantity that all runs have: over all joints, then each one by joint.

    Args:
        comparison: What it shows.
    """
    quantities = [
        quantity
        for quantity in QUANTITIES.values()
        if all(quantity in run.quantities for run in comparison.runs)
    ]
    parts = [_overall_table(comparison, quantities, "All indices over all joints")]
    for quantity in quantities:
        table = _joint_table(comparison, quantity)
        title = f"{html_text(quantity.symbol)} [{_unit(comparison, quantity)}]"
        parts.append(
            f"<details><summary>{title}: {html_text(quantity.meaning)}</summary>{table}</details>"
        )
    return parts


def legend(comparison: Comparison) -> str:
    """Return what symbols and marks of the tables mean, and why numbers are not there.

    Args:
        comparison: What the tables show.
    """
    shown = comparison.indices or comparison.norms
    text = "; ".join(f"{quantity.symbol}: {quantity.meaning}" for quantity in shown) + "."
    if any(run.spread for run in comparison.runs):
        text += " A number in brackets: median of so many runs, with first and third quartile."
    if comparison.others:
        text += (
            f" Ratio: run / {comparison.baseline.label}; {MARKS[Verdict.BETTER]} lower, which "
            f"is better, {MARKS[Verdict.WORSE]} higher, {MARKS[Verdict.EQUAL]} equal "
            f"{THRESHOLD}."
        )
    reasons = "".join(f"<p>{html_text(line)}</p>" for line in footnotes(comparison))
    return f'<p class="soft">{html_text(text)}</p>{reasons}'


def _overall_table(comparison: Comparison, quantities: Sequence[Quantity], name: str) -> str:
    rows = []
    for quantity in quantities:
        title = f"{html_text(quantity.symbol)} [{_unit(comparison, quantity)}]"
        cells = "".join(_index_cells(comparison, quantity, (None,))[0])
        meaning = f'<span class="soft">{html_text(quantity.meaning)}</span>'
        rows.append(f'<tr><th scope="row">{title} {meaning}</th>{cells}</tr>')
    headings = _run_headings(comparison)
    labels = "".join(_group_cells("th", headings))
    return scrolling(
        name,
        f'<table><thead><tr><th class="text" scope="col">over all joints</th>{labels}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table>",
        len(headings) + 2,
    )


def _joint_table(comparison: Comparison, quantity: Quantity) -> str:
    joints = (*comparison.joint_names, None)
    cells = _index_cells(comparison, quantity, joints)
    last = f"all: {quantity.fold.value}"
    rows = [
        f'<tr><th scope="row">{html_text(joint or last)}</th>{"".join(cells[k])}</tr>'
        for k, joint in enumerate(joints)
    ]
    headings = _run_headings(comparison)
    labels = "".join(_group_cells("th", headings))
    return scrolling(
        f"{quantity.meaning} of each joint",
        f'<table><thead><tr><th class="text" scope="col">joint</th>{labels}</tr></thead>'
        f"<tbody>{''.join(rows[:-1])}</tbody><tfoot>{rows[-1]}</tfoot></table>",
        len(headings),
    )


def _run_headings(comparison: Comparison) -> list[str]:
    headings: list[str] = []
    for run in comparison.runs:
        headings.append(html_text(heading_of(run)))
        headings += [] if run.spread is None else ["quartiles"]
        headings += [] if run is comparison.baseline else ["ratio"]
    return headings


def _index_cells(
    comparison: Comparison, quantity: Quantity, joints: Sequence[str | None]
) -> list[list[str]]:
    """Return for each joint the cells of all runs and ratios of one quantity."""
    values = [run.value(quantity, joint) for joint in joints for run in comparison.runs]
    texts = iter(format_values(values))
    rows = []
    for joint in joints:
        contents: list[str] = []
        for run in comparison.runs:
            contents.append(next(texts))
            contents += [] if run.spread is None else [quartiles_of(run, quantity, joint)]
            if run is not comparison.baseline:
                contents.append(_ratio(comparison.ratio(run.label, quantity, joint)))
        rows.append(_group_cells("td", contents))
    return rows


def _group_cells(tag: str, contents: Sequence[str]) -> list[str]:
    scope = ' scope="col"' if tag == "th" else ""
    first, *others = contents
    return [
        f'<{tag}{scope} class="first">{first}</{tag}>',
        *(f"<{tag}{scope}>{content}</{tag}>" for content in others),
    ]


def _ratio(ratio: float) -> str:
    kind = verdict(ratio)
    return (
        f'<span class="{kind.name.lower()}">{format_ratio(ratio)}'
        f'<span aria-hidden="true">{MARKS[kind]}</span></span>'
        f'<span class="unseen"> {_SPOKEN[kind]}</span>'
    )


def _unit(comparison: Comparison, quantity: Quantity) -> str:
    return re.sub(r"\^([\d.]+)", r"<sup>\1</sup>", html_text(comparison.unit(quantity)))
