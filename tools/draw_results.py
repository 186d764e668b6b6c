"""Draws the figures of results.md into docs/figures and puts its tables in place.

python tools/draw_results.py STUDY [--search FOLDER]... [--page docs/results.md]

STUDY is the folder of ``hpid study``, each FOLDER one of ``hpid tune``. Every table stands in the
page between ``<!-- begin NAME -->`` and ``<!-- end NAME -->``; only what is between is written,
and a page that does not exist is made of all tables and figures.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
import sys
from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from hpid_bench.report.figures import INK, RUN_STYLES, RunStyle  # noqa: E402
from hpid_bench.report.plots import (  # noqa: E402
    DOTS_PER_INCH,
    MARKERS,
    WIDTH_IN,
    SearchPoints,
    add_legend,
    figure_style,
    front_figure,
    laid_out,
    ratio_ticks,
)
from hpid_ros.metrics.quantities import (  # noqa: E402
    EFFORT_L2,
    ERROR_L2,
    IAVC,
    ITAE,
    IVC,
    OVERSHOOT,
    Quantity,
    find_quantities,
)

BLOCK = re.compile(r"<!-- begin (?P<name>[^>]*?) -->\n(?P<body>.*?)<!-- end (?P=name) -->\n", re.S)
PAPER = find_quantities(["paper"])


def blocks_of(study: Path, searches: Sequence[Path]) -> dict[str, str]:
    """Return the tables by name."""
    tables = (study / "tables.md").read_text(encoding="utf-8")
    found = {match["name"]: match["body"] for match in BLOCK.finditer(tables)}
    return found | ({"searches": search_table(searches)} if searches else {})


def search_table(folders: Sequence[Path]) -> str:
    """Return what searches found, as a Markdown table."""
    heads = ["experiment", "engine", "found", "parameters", "cost"]
    heads += [*(q.symbol for q in PAPER), "last |e|"]
    rows = [heads, [*["---"] * 4, *["---:"] * (len(heads) - 4)]]
    for folder in folders:
        found = json.loads((folder / "tune.json").read_text(encoding="utf-8"))
        best = found["best"]
        lead = [found["experiment"], found["engine"], found["label"]]
        if best is None:
            rows.append([*lead, "none", *["-"] * (len(heads) - 4)])
            continue
        values = ", ".join(f"{name} {value:g}" for name, value in best["values"].items())
        values += "" if best["stage"] == "all" else f" (last of {best['stage']})"
        ratios = [f"{best['ratios'][q.key]:.3f}" for q in PAPER]
        cost, last = f"{best['cost']:.3f}", f"{best['last_error']:.4f}"
        rows.append([*lead, values, cost, *ratios, last])
    lines = ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def search_points(folder: Path) -> SearchPoints:
    """Return the points of a search that were run."""
    found = json.loads((folder / "tune.json").read_text(encoding="utf-8"))
    with (folder / "points.csv").open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["ivc_ratio"]]
    ratios = [{q.key: float(row[f"{q.key}_ratio"]) for q in PAPER} for row in rows]
    numbers = [int(row["point"]) for row in rows]
    best = found["best"]
    return SearchPoints(
        found["label"], ratios, None if best is None else numbers.index(best["point"])
    )


SHOWN = (IVC, IAVC, EFFORT_L2, ITAE, ERROR_L2, OVERSHOOT)
PAPER_RATIOS: Mapping[str, float] = {"ivc": 0.575, "iavc": 0.79, "effort_l2": 0.777, "itae": 0.947}
"""What the paper's Table I has, over its PID."""

_ROW_HEIGHT_IN, _MARGIN_IN = 0.32, 1.6
_SPACE = 0.6  # of a row, for all its controllers


@figure_style()
def ratio_figure(study: Mapping[str, Any]) -> Figure:
    """Return medians with bars from quartile to quartile, one panel an index."""
    experiments: Mapping[str, Any] = study["experiments"]
    labels = _labels(experiments)
    looks = {
        label: (style, MARKERS[k % len(MARKERS)])
        for k, (label, style) in enumerate(zip(labels, cycle(RUN_STYLES), strict=False))
    }
    height = 2.0 * (_MARGIN_IN + _ROW_HEIGHT_IN * len(experiments))
    figure = Figure(figsize=(WIDTH_IN, height), dpi=DOTS_PER_INCH)
    panels = figure.subplots(2, 3, sharey=True).flat
    for panel, quantity in zip(panels, SHOWN, strict=True):
        panel.axvline(1.0, color=INK, linewidth=0.8)
        if quantity.key in PAPER_RATIOS:
            panel.axvline(PAPER_RATIOS[quantity.key], color=INK, linewidth=0.8, dashes=(2.0, 2.0))
        for row, experiment in enumerate(experiments.values()):
            _draw_row(panel, row, experiment["controllers"], quantity, labels, looks)
        _label(panel, quantity, list(experiments))
    handles = [_point(style, marker, label) for label, (style, marker) in looks.items()]
    paper = Line2D([], [], color=INK, linewidth=0.8, dashes=(2.0, 2.0), label="the paper")
    add_legend(figure, [*handles, paper])
    return laid_out(figure)


def _labels(experiments: Mapping[str, Any]) -> list[str]:
    """Return the labels of all controllers but the baselines, in their order."""
    found: dict[str, None] = {}
    for experiment in experiments.values():
        others = [name for name in experiment["controllers"] if name != experiment["baseline"]]
        found |= dict.fromkeys(others)
    return list(found)


def _draw_row(
    panel: Axes,
    row: int,
    controllers: Mapping[str, Any],
    quantity: Quantity,
    labels: Sequence[str],
    looks: Mapping[str, tuple[RunStyle, str]],
) -> None:
    step = _SPACE / len(labels)
    for place, label in enumerate(labels):
        ratios = controllers.get(label, {}).get("ratios", {}).get(quantity.key)
        if ratios is None or not ratios["median"]:
            continue  # it has none, or one over zero
        style, marker = looks[label]
        y = row + (place - 0.5 * (len(labels) - 1)) * step
        low, middle, high = (ratios[name] for name in ("first", "median", "third"))
        panel.plot([low, high], [y, y], color=style.color, linewidth=2.5, alpha=0.5)
        panel.add_line(_point(style, marker, label, middle, y))


def _label(panel: Axes, quantity: Quantity, names: Sequence[str]) -> None:
    panel.set_xscale("log")
    panel.set_title(f"{quantity.symbol}, {quantity.meaning}")
    panel.set_ylim(len(names) - 0.5, -0.5)
    panel.set_yticks(range(len(names)), names)
    panel.grid(axis="y", visible=False)
    panel.margins(x=0.08)
    low, high = panel.get_xlim()
    panel.set_xlim(min(low, 0.5), max(high, 1.25))
    ratio_ticks(panel.xaxis)
    panel.set_xlabel("over the PID's")


def _point(
    style: RunStyle, marker: str, label: str, x: float | None = None, y: float | None = None
) -> Line2D:
    places = ([], []) if x is None or y is None else ([x], [y])
    return Line2D(
        *places,
        color=style.color,
        marker=marker,
        markersize=6.5,
        markeredgecolor="white",
        linestyle="",
        label=label,
        zorder=4,
    )


def draw(study: Mapping[str, Any], searches: Sequence[Path], figures: Path) -> list[str]:
    """Draw everything and return the names of the files."""
    figures.mkdir(parents=True, exist_ok=True)
    ratio_figure(study).savefig(figures / "results_ratios.png")
    names = ["results_ratios.png"]
    alike: dict[str, list[Path]] = {}
    for folder in searches:
        found = json.loads((folder / "tune.json").read_text(encoding="utf-8"))
        alike.setdefault(f"{found['experiment']}_{found['engine']}", []).append(folder)
    for name, folders in alike.items():
        names.append(f"results_trade_off_{name}.png")
        front_figure([search_points(each) for each in folders]).savefig(figures / names[-1])
    return names


def placed(page: str, blocks: Mapping[str, str]) -> str:
    """Return a page with its tables replaced by those of the same name."""

    def replaced(match: re.Match[str]) -> str:
        name = match["name"]
        body = blocks.get(name, match["body"])
        return f"<!-- begin {name} -->\n{body}<!-- end {name} -->\n"

    return BLOCK.sub(replaced, page)


def main() -> int:
    """Draw the figures and write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("study", type=Path)
    parser.add_argument("--search", type=Path, action="append", default=[], metavar="FOLDER")
    parser.add_argument("--page", type=Path, default=ROOT / "docs" / "results.md")
    options = parser.parse_args()
    study = json.loads((options.study / "study.json").read_text(encoding="utf-8"))
    names = draw(study, options.search, options.page.parent / "figures")
    blocks = blocks_of(options.study, options.search)
    if options.page.exists():
        page = placed(options.page.read_text(encoding="utf-8"), blocks)
    else:
        parts = [
            f"<!-- begin {name} -->\n{body}<!-- end {name} -->\n" for name, body in blocks.items()
        ]
        pictures = [f"![{Path(name).stem}](figures/{name})\n" for name in names]
        page = "\n".join(["# Results\n", *pictures, *parts])
    options.page.write_text(page, encoding="utf-8")
    print(f"{options.page} and {', '.join(names)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
