"""The comparison's table as files: CSV for programs, LaTeX for papers."""

from __future__ import annotations

import csv
import io

from hpid_ros.analysis.comparison import Comparison
from hpid_ros.analysis.indices import INDICES, NORMS, Quantity, RunIndices
from hpid_ros.analysis.table import format_ratio, format_values

CSV_COLUMNS = ("run", "scope", "joint", "quantity", "unit", "value", "ratio")

_LATEX_SPECIAL = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "μ": r"$\mu$",
        **{character: f"\\{character}" for character in "&%$#_{}"},
    }
)
_LATEX_UNITS = {
    "N m": r"N\,m",
    "N m s": r"N\,m\,s",
    "rad s^2": r"rad\,s$^2$",
    "N m s^0.5": r"N\,m\,s$^{1/2}$",
    "rad s^0.5": r"rad\,s$^{1/2}$",
}
_LATEX_NORMS = {"effort_l2": r"$\|u\|_{L^2}$", "error_l2": r"$\|e\|_{L^2}$"}


def table_csv(comparison: Comparison) -> str:
    """Return every number in long form, one a row, at full precision.

    Columns: :data:`CSV_COLUMNS`. ``scope`` is ``joint``, ``total`` (the sum over joints) or
    ``norm`` (over all joints), and ``joint`` is empty but for the first; ``ratio`` is the value
    over the baseline's (``inf`` against zero) and empty in the baseline's own rows.

    Args:
        comparison: What it holds.
    """
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(CSV_COLUMNS)
    scopes: list[tuple[str, str | None, tuple[Quantity, ...]]] = [
        *(("joint", joint, INDICES) for joint in comparison.joint_names),
        ("total", None, INDICES),
        ("norm", None, NORMS),
    ]
    for run in comparison.runs:
        for scope, joint, quantities in scopes:
            for quantity in quantities:
                value = repr(run.value(quantity, joint))
                ratio = ""
                if run is not comparison.baseline:
                    ratio = repr(comparison.ratio(run.label, quantity, joint))
                rows.writerow(
                    (run.label, scope, joint or "", quantity.key, quantity.unit, value, ratio)
                )
    return text.getvalue()


def table_latex(comparison: Comparison) -> str:
    r"""Return the paper's Table I as plain ``tabular`` environments, for inside a ``table``.

    No package is needed. The lower value of each pair is bold; below the joints stand the totals
    and their ratios, below the table the L2 norms.

    Args:
        comparison: What it holds.
    """
    runs = comparison.runs
    columns = "|".join("r" * len(runs) for _ in INDICES)
    labels = " & ".join(_escape(run.label) for run in runs)
    joints = (*comparison.joint_names, None)
    columns_of = {quantity: _index_cells(runs, quantity, joints) for quantity in INDICES}
    lines = [
        r"% IVC, IAVC, ITAE of each joint and L2 norms over all joints; lower is better.",
        rf"\begin{{tabular}}{{|l|{columns}|}}",
        r"\hline",
        f"Joint & {_spanning([f'{q.symbol} [{_LATEX_UNITS[q.unit]}]' for q in INDICES], runs)}",
        " & ".join(["", *[labels] * len(INDICES)]).lstrip() + r" \\ \hline",
    ]
    for k, joint in enumerate(joints):
        name = "Total" if joint is None else _escape(joint)
        row = [name, *(columns_of[quantity][k] for quantity in INDICES)]
        if joint is None:
            lines.append(r"\hline")
        lines.append(" & ".join(row) + r" \\ \hline")
    for run in comparison.others:
        ratios = [format_ratio(comparison.ratio(run.label, quantity)) for quantity in INDICES]
        name = f"{_escape(run.label)} / {_escape(comparison.baseline.label)}"
        lines.append(f"{name} & {_spanning([_number(ratio) for ratio in ratios], runs)}")
    lines += [r"\end{tabular}", r"\par\medskip", *_norm_lines(comparison)]
    return "\n".join(lines) + "\n"


def _index_cells(
    runs: tuple[RunIndices, ...], quantity: Quantity, joints: tuple[str | None, ...]
) -> list[str]:
    """Return for each joint the cells of all runs, the lowest of them bold."""
    values = [[run.value(quantity, joint) for run in runs] for joint in joints]
    texts = iter(format_values(value for row in values for value in row))
    return [" & ".join(_emphasise(row, [next(texts) for _ in row])) for row in values]


def _norm_lines(comparison: Comparison) -> list[str]:
    labels = " & ".join(_escape(run.label) for run in comparison.runs)
    lines = [
        rf"\begin{{tabular}}{{|l|{'r|' * len(comparison.runs)}}}",
        r"\hline",
        rf"Norm over all joints & {labels} \\ \hline",
    ]
    for quantity in NORMS:
        values = [run.value(quantity) for run in comparison.runs]
        name = f"{_LATEX_NORMS[quantity.key]} [{_LATEX_UNITS[quantity.unit]}]"
        cells = _emphasise(values, format_values(values))
        lines.append(" & ".join([name, *cells]) + r" \\ \hline")
    return [*lines, r"\end{tabular}"]


def _spanning(texts: list[str], runs: tuple[RunIndices, ...]) -> str:
    cells = (rf"\multicolumn{{{len(runs)}}}{{c|}}{{{text}}}" for text in texts)
    return " & ".join(cells) + r" \\ \hline"


def _emphasise(values: list[float], texts: list[str]) -> list[str]:
    """Return the texts as LaTeX, in bold where a value is lower than some other one."""
    lowest, highest = min(values), max(values)
    return [
        rf"\textbf{{{_number(text)}}}" if value == lowest < highest else _number(text)
        for value, text in zip(values, texts, strict=True)
    ]


def _number(text: str) -> str:
    if text == "inf":
        return r"$\infty$"
    mantissa, _, exponent = text.partition("e")
    return rf"${mantissa} \cdot 10^{{{exponent}}}$" if exponent else text


def _escape(text: str) -> str:
    return text.translate(_LATEX_SPECIAL)
