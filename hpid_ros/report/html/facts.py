"""The report's tables: indices, settings, losses, provenance."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence

from hpid_ros.analysis.comparison import THRESHOLD, Comparison, Verdict, verdict
from hpid_ros.analysis.doubts import COLUMNS, quality_rows
from hpid_ros.analysis.quantities import QUANTITIES, Quantity
from hpid_ros.base.foreign_text import html_text
from hpid_ros.recordings.series import RunSeries
from hpid_ros.report.tables.numbers import footnotes, format_ratio, format_values
from hpid_ros.report.tables.table import MARKS, heading_of, quartiles_of, total_name

# Settings by parameter name, of each joint, of each run's label.
Parameters = Mapping[str, Mapping[str, Mapping[str, object]]]

PRINTED_COLUMNS = (10, 14, 18, 26)
"""Tables of at least so many columns are set smaller on paper, where nothing scrolls."""


def losses(runs: Sequence[RunSeries]) -> Iterator[str]:
    """Yield for each run what went missing: a line if nothing did, else a table by joint.

    Args:
        runs: The runs.
    """
    for run in runs:
        counts = {(len(s.state_stamps_ns), len(s.command_stamps_ns)) for s in run.joints}
        if not any(run.losses.values()) and len(counts) == 1:
            states, commands = counts.pop()
            text = f"{run.label}: none. Each joint has {states} states and {commands} commands."
            yield f"<p>{html_text(text)}</p>"
            continue
        rows = [
            (
                series.joint,
                len(series.state_stamps_ns),
                len(series.command_stamps_ns),
                run.losses[series.joint].unanswered_states,
                run.losses[series.joint].repeated_commands,
            )
            for series in run.joints
        ]
        columns = ("joint", "states", "commands", "unanswered states", "repeated commands")
        yield f"<h3>{html_text(run.label)}</h3>"
        yield plain_table(f"Losses of {run.label}", columns, rows)


def data_quality(runs: Sequence[RunSeries]) -> Iterator[str]:
    """Yield for each run that was read from a recording what it was made of.

    Args:
        runs: The runs.
    """
    for run in runs:
        quality = run.quality
        if not quality.joints:
            continue
        yield f"<h3>Recording of {html_text(run.label)}</h3>"
        for line in quality.lines:
            yield f"<p>{html_text(line)}</p>"
        references = {each.reference for each in quality.joints.values()}
        yield f"<p>Reference: {html_text(', '.join(sorted(references)))}.</p>"
        rows = [row for joint, each in quality.joints.items() for row in quality_rows(joint, each)]
        yield plain_table(f"Recording of {run.label}", COLUMNS, rows)


def retunes(runs: Sequence[RunSeries]) -> Iterator[str]:
    """Yield a table of the changes of parameters while runs were recorded; nothing without one.

    Args:
        runs: The runs.
    """
    rows = [
        (run.label, f"{(each.stamp_ns - run.start_ns) / 1e9:.3f}", each.node, each.change)
        for run in runs
        for each in run.retunes
    ]
    if rows:
        yield "<h3>Retuned while running</h3>"
        yield plain_table("Changes of parameters", ("run", "t [s]", "node", "change"), rows)


def parameter_tables(parameters: Parameters) -> Iterator[str]:
    """Yield for each run a heading, the settings that all joints share, and those that differ.

    Args:
        parameters: Settings by run, joint and parameter.
    """
    for label, joints in parameters.items():
        yield f"<h3>{html_text(label)}</h3>"
        names = list(dict.fromkeys(name for settings in joints.values() for name in settings))
        names = [name for name in names if name != "joint"]  # the rows' own name
        texts = {
            name: [_text(settings.get(name)) for settings in joints.values()] for name in names
        }
        shared = [name for name in names if len(joints) > 1 and len(set(texts[name])) == 1]
        own = [name for name in names if name not in shared]
        if own:
            rows = ((joint, *(texts[name][k] for name in own)) for k, joint in enumerate(joints))
            yield plain_table(f"Parameters of {label}", ("joint", *own), rows)
        if shared:
            settings = ", ".join(f"{name} = {texts[name][0]}" for name in shared)
            yield f"<p>The same for all joints: {html_text(settings)}.</p>"


def provenance_table(provenance: Mapping[str, object]) -> str:
    """Return where the numbers come from; nested entries get dotted names.

    Args:
        provenance: Any mapping of plain values and mappings.
    """
    rows = "".join(
        f'<tr><th scope="row">{html_text(name)}</th><td>{html_text(_text(value))}</td></tr>'
        for name, value in _flatten(provenance)
    )
    return scrolling("Provenance", f'<table class="wrap"><tbody>{rows}</tbody></table>')


def plain_table(name: str, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table of texts and numbers with one line of headings.

    Args:
        name: What a screen reader calls it.
        columns: The headings.
        rows: The rows, each as long as the headings.
    """
    texts = [[_text(value) for value in row] for row in rows]
    kinds = [
        "" if all(_is_number(row[k]) for row in texts) else ' class="text"'
        for k in range(len(columns))
    ]
    head = "".join(
        f'<th{kind} scope="col">{html_text(column)}</th>'
        for kind, column in zip(kinds, columns, strict=True)
    )
    body = "".join(
        "<tr>"
        + "".join(f"<td{k}>{html_text(t)}</td>" for k, t in zip(kinds, row, strict=True))
        + "</tr>"
        for row in texts
    )
    table = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    return scrolling(name, table, len(columns))


def scrolling(name: str, markup: str, columns: int = 2) -> str:
    """Return markup in a box that scrolls by itself, so that the page never does sideways.

    Args:
        name: What a screen reader calls it.
        markup: What is in it.
        columns: How many columns it has beside that of its rows' names.
    """
    # The style sheet has a size of type for each of these.
    size = max((each for each in PRINTED_COLUMNS if each <= columns), default=0)
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{html_text(name)}" '
        f'data-columns="{size}">{markup}</div>'
    )


def _flatten(entries: Mapping[str, object], prefix: str = "") -> Iterator[tuple[str, object]]:
    for name, value in entries.items():
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _text(value: object) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, (list, tuple)):
        return ", ".join(_text(item) for item in value)
    return str(value)


def _is_number(text: str) -> bool:
    if text == "–":
        return True
    try:
        float(text)
    except ValueError:
        return False
    return True


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
