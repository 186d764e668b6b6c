"""The comparison as text, CSV, LaTeX and JSON, and the table of two engines."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence

from hpid_ros.base.text import csv_text, shown
from hpid_ros.metrics.comparison import Comparison, EngineTotal, median
from hpid_ros.metrics.quantities import (
    EFFORT_L2,
    ERROR_L2,
    ERROR_MAX,
    PAPER,
    QUANTITIES,
    STEADY_STATE_ERROR,
    Data,
    Fold,
    Quantity,
)
from hpid_ros.metrics.results import RunIndices
from hpid_ros.report.table import (
    NOTHING,
    UNDEFINED,
    Grid,
    footnotes,
    format_ratio,
    format_values,
    heading_of,
    table_text,
    total_name,
)

NAMES: Mapping[str, str] = {"pybullet": "PyBullet", "mujoco": "MuJoCo"}  # engines

_PLAIN = 10.0  # percent; above it decimals say nothing


def engine_grids(totals: Sequence[EngineTotal], note: str) -> list[Grid]:
    """Return the distances of the paper's indices, then of each experiment all numbers."""
    experiments = dict.fromkeys(total.experiment for total in totals)
    return [
        _summary(totals, note),
        *(_details([t for t in totals if t.experiment == each], note) for each in experiments),
    ]


def engines_csv(totals: Sequence[EngineTotal]) -> str:
    """Return every number of every seed in both engines, at full precision."""
    engines = tuple(totals[0].values)
    names = ("experiment", "controller", "seed", "quantity", "unit")
    rows: list[list[object]] = [[*names, *engines, "distance"]]
    for total in totals:
        columns = (*total.values.values(), total.distances)
        for seed in sorted({seed for each in columns for seed in each}):
            run = (total.experiment, total.controller, seed)
            cells = (each.get(seed, "") for each in columns)
            rows.append([*run, total.quantity.key, total.unit, *cells])
    return csv_text(rows)


def format_distance(distance: float | None) -> str:
    """Return a distance in percent, with its sign: +0.120 %."""
    if distance is None:
        return NOTHING
    percent = 100.0 * distance
    if not math.isfinite(percent):
        return "inf"
    return f"{percent:+.3f} %" if abs(percent) < _PLAIN else f"{percent:+.1f} %"


def _summary(totals: Sequence[EngineTotal], note: str) -> Grid:
    rows: dict[tuple[str, str], dict[str, str]] = {}
    for total in totals:
        cells = rows.setdefault((total.experiment, total.controller), {})
        cells[total.quantity.key] = format_distance(total.distance)
    first, second = _names(totals)
    return Grid(
        "engines",
        f"How far {second}'s totals lie from {first}'s",
        ("experiment", "controller", *(q.symbol for q in PAPER)),
        tuple(
            (*names, *(cells.get(quantity.key, NOTHING) for quantity in PAPER))
            for names, cells in rows.items()
        ),
        f"{second} / {first} with the same seed, less 1; medians over the seeds. {note}",
    )


def _details(totals: Sequence[EngineTotal], note: str) -> Grid:
    first, second = _names(totals)
    name = totals[0].experiment
    is_repeated = any(len(total.distances) > 1 for total in totals)
    largest = ", its median and the largest of any seed" if is_repeated else ""
    return Grid(
        f"engines {name}",
        f"{name}: both engines",
        (
            *("index", "controller", first, second, "distance"),
            *(("largest",) if is_repeated else ()),
            *(f"ratio, {each}" for each in (first, second)),
        ),
        tuple(_row(total, is_repeated=is_repeated) for total in totals),
        f"{'Medians; d' if is_repeated else 'D'}istance: {second} / {first} with the same seed, "
        f"less 1{largest}; ratio: to the first controller in the same engine. {note}",
    )


def _row(total: EngineTotal, *, is_repeated: bool) -> tuple[str, ...]:
    medians = [median(list(each.values())) for each in total.values.values()]
    texts = iter(format_values([each for each in medians if each is not None]))
    values = [NOTHING if each is None else next(texts) for each in medians]
    ratios = [median(list(total.ratios.get(engine, {}).values())) for engine in total.values]
    return (
        f"{total.quantity.symbol} [{total.unit}]",
        total.controller,
        *values,
        format_distance(total.distance),
        *((format_distance(total.largest_distance),) if is_repeated else ()),
        *(NOTHING if each is None else format_ratio(each) for each in ratios),
    )


def _names(totals: Sequence[EngineTotal]) -> tuple[str, ...]:
    return tuple(NAMES.get(engine, engine) for engine in totals[0].values)


CSV_COLUMNS = (
    *("run", "scope", "joint", "quantity", "unit", "value", "ratio"),
    *("repeats", "first_quartile", "third_quartile", "note", "against"),
)

_LATEX_SPECIAL = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "μ": r"$\mu$",
        **{character: f"\\{character}" for character in "&%$#_{}"},
    }
)
_LATEX_SYMBOLS = {
    EFFORT_L2.key: r"$\|u\|_{L^2}$",
    ERROR_L2.key: r"$\|e\|_{L^2}$",
    ERROR_MAX.key: r"$\max|e|$",
    STEADY_STATE_ERROR.key: r"$e_{ss}$",
}


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


def table_latex(comparison: Comparison) -> str:
    r"""Return the paper's Table I as plain ``tabular`` environments, for inside a ``table``.

    No package is needed. The lower value of each pair is bold, unless the runs cannot be compared;
    below the joints stand the totals and their ratios, below the table the L2 norms and what the
    numbers must be read with.
    """
    lines = ["% Lower is better; bold: the lowest."]
    if comparison.indices:
        lines += _index_lines(comparison)
    if comparison.indices and comparison.norms:
        lines.append(r"\par\medskip")
    if comparison.norms:
        lines += _norm_lines(comparison)
    for note in (*comparison.notes, *footnotes(comparison)):
        lines += [r"\par\smallskip", rf"{{\footnotesize {_sentence(note)}}}"]
    return "\n".join(lines) + "\n"


def _index_lines(comparison: Comparison) -> list[str]:
    runs, indices = comparison.runs, comparison.indices
    columns = "|".join("r" * len(runs) for _ in indices)
    labels = " & ".join(_escape(heading_of(run)) for run in runs)
    joints = (*comparison.joint_names, None)
    columns_of = {quantity: _index_cells(comparison, quantity, joints) for quantity in indices}
    titles = [f"{_symbol(q)} [{_unit(comparison.unit(q))}]" for q in indices]
    lines = [
        rf"\begin{{tabular}}{{|l|{columns}|}}",
        r"\hline",
        f"Joint & {_spanning(titles, runs)}",
        " & ".join(["", *[labels] * len(indices)]).lstrip() + r" \\ \hline",
    ]
    for k, joint in enumerate(joints):
        name = total_name(indices).capitalize() if joint is None else _escape(joint)
        row = [name, *(columns_of[quantity][k] for quantity in indices)]
        if joint is None:
            lines.append(r"\hline")
        lines.append(" & ".join(row) + r" \\ \hline")
    for run in comparison.others:
        ratios = [format_ratio(comparison.ratio(run.label, quantity)) for quantity in indices]
        name = f"{_escape(run.label)} / {_escape(comparison.baseline.label)}"
        lines.append(f"{name} & {_spanning([_number(ratio) for ratio in ratios], runs)}")
    return [*lines, r"\end{tabular}"]


def _index_cells(
    comparison: Comparison, quantity: Quantity, joints: tuple[str | None, ...]
) -> list[str]:
    """Return for each joint the cells of all runs, the lowest of them bold."""
    runs = comparison.runs
    is_compared = _is_compared(comparison, quantity)
    values = [[run.value(quantity, joint) for run in runs] for joint in joints]
    texts = iter(format_values(value for row in values for value in row))
    return [" & ".join(_cells(row, [next(texts) for _ in row], is_compared)) for row in values]


def _is_compared(comparison: Comparison, quantity: Quantity) -> bool:
    return not any(
        quantity.key in each.spoils
        for run in comparison.others
        for each in comparison.differences(run.label)
    )


def _norm_lines(comparison: Comparison) -> list[str]:
    labels = " & ".join(_escape(heading_of(run)) for run in comparison.runs)
    lines = [
        rf"\begin{{tabular}}{{|l|{'r|' * len(comparison.runs)}}}",
        r"\hline",
        rf"Over all joints & {labels} \\ \hline",
    ]
    for quantity in comparison.norms:
        values = [run.value(quantity) for run in comparison.runs]
        name = f"{_symbol(quantity)} [{_unit(comparison.unit(quantity))}]"
        cells = _cells(values, format_values(values), _is_compared(comparison, quantity))
        lines.append(" & ".join([name, *cells]) + r" \\ \hline")
    return [*lines, r"\end{tabular}"]


def _spanning(texts: list[str], runs: tuple[RunIndices, ...]) -> str:
    cells = (rf"\multicolumn{{{len(runs)}}}{{c|}}{{{text}}}" for text in texts)
    return " & ".join(cells) + r" \\ \hline"


def _cells(values: list[float], texts: list[str], is_compared: bool) -> list[str]:
    """Return the texts as LaTeX, in bold where a value is lower than one it is compared with."""
    known = [value for value in values if not math.isnan(value)]
    lowest, highest = min(known, default=0.0), max(known, default=0.0)
    return [
        rf"\textbf{{{_number(text)}}}"
        if is_compared and value == lowest < highest
        else _number(text)
        for value, text in zip(values, texts, strict=True)
    ]


def _number(text: str) -> str:
    if text == "inf":
        return r"$\infty$"
    if text == UNDEFINED:
        return "--"
    mantissa, _, exponent = text.partition("e")
    return rf"${mantissa} \cdot 10^{{{exponent}}}$" if exponent else text


def _sentence(text: str) -> str:
    """Return a sentence with symbols of quantities in it."""
    escaped = _escape(text)
    for key, symbol in _LATEX_SYMBOLS.items():
        escaped = escaped.replace(_escape(QUANTITIES[key].symbol), symbol)
    return escaped


def _symbol(quantity: Quantity) -> str:
    return _LATEX_SYMBOLS.get(quantity.key) or _escape(quantity.symbol)


def _unit(unit: str) -> str:
    r"""Return a unit as LaTeX: ``rad s^2`` as ``rad\,s$^2$``."""
    if ", " in unit:
        return ", ".join(map(_unit, unit.split(", ")))
    powers = {"0.5": "{1/2}"}
    parts = _escape(unit.replace("^", "*")).split(" ")
    return r"\,".join(
        re.sub(r"\*([\d.]+)", lambda m: f"$^{powers.get(m[1], m[1])}$", part) for part in parts
    )


def _escape(text: str) -> str:
    return shown(text).translate(_LATEX_SPECIAL)


def table_json(comparison: Comparison) -> str:
    return json.dumps(comparison.as_mapping(), indent=2) + "\n"


FORMATS: Mapping[str, Callable[[Comparison], str]] = {
    "table": table_text,
    "csv": table_csv,
    "json": table_json,
    "latex": table_latex,
}
"""What writes a comparison, by the format's name."""
