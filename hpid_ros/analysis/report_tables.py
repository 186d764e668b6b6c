"""The indices as HTML tables for the report."""

from __future__ import annotations

import re
from collections.abc import Sequence
from html import escape

from hpid_ros.analysis.comparison import Comparison, Verdict, verdict
from hpid_ros.analysis.indices import INDICES, NORMS, Quantity
from hpid_ros.analysis.report_facts import scrolling
from hpid_ros.analysis.table import MARKS, format_ratio, format_values

_SPOKEN = {Verdict.BETTER: "lower", Verdict.WORSE: "higher", Verdict.EQUAL: "equal"}


def index_table(comparison: Comparison) -> str:
    """Return the paper's Table I: joints by indices, runs and ratios, a total line.

    Args:
        comparison: What it shows.
    """
    headings = _run_headings(comparison)
    groups = "".join(
        f'<th class="group first" scope="colgroup" colspan="{len(headings)}">'
        f"{quantity.symbol} [{_unit(quantity)}]</th>"
        for quantity in INDICES
    )
    labels = "".join(_group_cells("th", headings)) * len(INDICES)
    joints = (*comparison.joint_names, None)
    cells = {quantity: _index_cells(comparison, quantity, joints) for quantity in INDICES}
    rows = [
        f'<tr><th scope="row">{escape(joint or "total")}</th>'
        f"{''.join(''.join(cells[quantity][k]) for quantity in INDICES)}</tr>"
        for k, joint in enumerate(joints)
    ]
    return scrolling(
        "Indices of each joint",
        f'<table><thead><tr><th class="text" scope="col" rowspan="2">joint</th>{groups}</tr>'
        f"<tr>{labels}</tr></thead><tbody>{''.join(rows[:-1])}</tbody>"
        f"<tfoot>{rows[-1]}</tfoot></table>",
    )


def norm_table(comparison: Comparison) -> str:
    """Return the L2 norms over all joints.

    Args:
        comparison: What it shows.
    """
    rows = []
    for quantity in NORMS:
        name = f"{quantity.meaning} [{_unit(quantity)}]"
        cells = "".join(_index_cells(comparison, quantity, (None,))[0])
        rows.append(f'<tr><th scope="row">{name[0].upper()}{name[1:]}</th>{cells}</tr>')
    labels = "".join(_group_cells("th", _run_headings(comparison)))
    return scrolling(
        "L2 norms over all joints",
        f'<table><thead><tr><th class="text" scope="col">over all joints</th>{labels}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table>",
    )


def legend(comparison: Comparison) -> str:
    """Return what symbols and marks of the tables mean.

    Args:
        comparison: What the tables show.
    """
    text = "; ".join(f"{quantity.symbol}: {quantity.meaning}" for quantity in INDICES) + "."
    if comparison.others:
        text += (
            f" Ratio: run / {comparison.baseline.label}; {MARKS[Verdict.BETTER]} lower, which "
            f"is better, {MARKS[Verdict.WORSE]} higher, {MARKS[Verdict.EQUAL]} equal."
        )
    return f'<p class="soft">{escape(text)}</p>'


def _run_headings(comparison: Comparison) -> list[str]:
    headings = [escape(comparison.baseline.label)]
    for run in comparison.others:
        headings += [escape(run.label), "ratio"]
    return headings


def _index_cells(
    comparison: Comparison, quantity: Quantity, joints: Sequence[str | None]
) -> list[list[str]]:
    """Return for each joint the cells of all runs and ratios of one quantity."""
    values = [run.value(quantity, joint) for joint in joints for run in comparison.runs]
    texts = iter(format_values(values))
    rows = []
    for joint in joints:
        contents = [next(texts)]
        for run in comparison.others:
            contents += [next(texts), _ratio(comparison.ratio(run.label, quantity, joint))]
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


def _unit(quantity: Quantity) -> str:
    return re.sub(r"\^([\d.]+)", r"<sup>\1</sup>", escape(quantity.unit))
