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
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from hpid_ros.metrics.quantities import find_quantities  # noqa: E402
from hpid_ros.report.study_figures import SearchPoints, front_figure, ratio_figure  # noqa: E402

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
