"""The result of a search: table, front, and a snippet for the experiment."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import yaml

from hpid_ros.base.foreign_text import csv_text
from hpid_ros.control import LoopSettings
from hpid_ros.experiment.description import Experiment
from hpid_ros.experiment.result.folder import ResultFolder, versions
from hpid_ros.report.tables.numbers import format_ratio
from hpid_ros.studies.batch import LAST_ERROR, PAPER_QUANTITIES
from hpid_ros.studies.search import Evaluation, Search
from hpid_ros.studies.search_space import SearchSpace, source_label

_JOINTS = "joints"


def compare_entry(
    experiment: Experiment, space: SearchSpace, loops: Sequence[LoopSettings]
) -> dict[str, Any]:
    """Return the entry that gives these loops in this experiment file, or one that extends it.

    What the search did not touch stands as in the entry that it began with: the baseline's, or
    for the homogeneous law that of the first homogeneous controller.
    """
    source = source_label(experiment, space.law)
    written = yaml.safe_load(experiment.text)["compare"][source] or {}
    common = _flat({key: value for key, value in written.items() if key != _JOINTS})
    each = {joint: _flat(entry) for joint, entry in written.get(_JOINTS, {}).items()}
    common["law"] = space.law
    for name in space.directions.changed:
        values = {loop.joint: loop.to_parameters()[name] for loop in loops}
        for parameters in (common, *each.values()):
            parameters.pop(name, None)
        if len(set(values.values())) == 1:
            common[name] = next(iter(values.values()))
        else:
            for joint, value in values.items():
                each.setdefault(joint, {})[name] = value
    entry = _nested(common)
    own = {joint: _nested(each[joint]) for joint in experiment.world.joints if each.get(joint)}
    return {**entry, _JOINTS: own} if own else entry


def _flat(entry: Mapping[str, Any]) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in entry.items():
        below = value.items() if isinstance(value, Mapping) else [(None, value)]
        flat |= {key if rest is None else f"{key}.{rest}": each for rest, each in below}
    return flat


def _nested(flat: Mapping[str, Any]) -> dict[str, Any]:
    nested: dict[str, Any] = {}
    for name, value in flat.items():
        section, _, key = name.rpartition(".")
        (nested.setdefault(section, {}) if section else nested)[key] = value
    return nested


class SearchResult:
    """What a search has found so far, as texts."""

    def __init__(self, search: Search, label: str) -> None:
        self._search, self._plan, self.label = search, search.plan, label

    def snippet(self) -> str:
        """Return the best controller as a ``compare`` section; empty if there is none."""
        best = self._search.best
        if best is None:
            return ""
        entry = compare_entry(self._plan.experiment, self._plan.space, best.loops)
        text: str = yaml.safe_dump(
            {"compare": {self.label: entry}}, sort_keys=False, default_flow_style=None, width=96
        )
        return text

    def points_csv(self) -> str:
        """Return every point, one a row: its place, parameters, cost, ratios, last error."""
        names = [each.name for each in self._plan.space.parameters]
        keys = [quantity.key for quantity in PAPER_QUANTITIES]
        ratios = [f"{key}_ratio" for key in keys]
        rows: list[list[object]] = [
            ["point", "stage", *names, "cost", *ratios, LAST_ERROR.key, "note"]
        ]
        for each in self._search.evaluations:
            cells = [each.ratios.get(key, "") for key in keys]
            cost = each.cost if math.isfinite(each.cost) else ""
            last = each.last_error if math.isfinite(each.last_error) else ""
            values = [each.values.get(name, "") for name in names]  # one joint has no distribution
            rows.append([each.number, each.stage, *values, cost, *cells, last, each.note])
        return csv_text(rows)

    def as_mapping(self) -> dict[str, object]:
        """Return everything that the plan determines, ready for JSON."""
        plan, experiment = self._plan, self._plan.experiment
        best = self._search.best
        return {
            "experiment": experiment.name,
            "sha256": experiment.digest,
            "engine": experiment.world.engine,
            "versions": versions(),
            "baseline": next(iter(experiment.controllers)),
            "label": self.label,
            "law": plan.space.law,
            "joints": list(plan.joints),
            "training_seeds": list(plan.training_seeds),
            "search_seed": plan.search_seed,
            "per_joint": plan.per_joint,
            "must_be_certified": plan.must_be_certified,
            "settle": plan.settle if math.isfinite(plan.settle) else None,
            **plan.cost.as_mapping(),
            "bounds": {each.name: [each.low, each.high] for each in plan.space.parameters},
            "evaluations": {"planned": plan.total, "made": len(self._search.evaluations)},
            "best": None if best is None else _mapping(best),
            "parameters": {
                each.joint: dict(each.to_parameters()) for each in (best.loops if best else ())
            },
        }

    def table(self) -> str:
        """Return in a few lines what was found."""
        plan, best = self._plan, self._search.best
        made = len(self._search.evaluations)
        refused = sum(each.note.startswith("refused") for each in self._search.evaluations)
        lines = [
            f"{plan.experiment.name}: {made} of {plan.total} points, {refused} refused, "
            f"{plan.seeds} training seed{'s' * (plan.seeds > 1)} from {plan.training_seeds[0]}, "
            f"totals over {', '.join(plan.joints)}"
        ]
        if best is None:
            return lines[0] + "\nno point has a cost\n"
        baseline = next(iter(plan.experiment.controllers))
        values = ", ".join(f"{name} {value:g}" for name, value in best.values.items())
        of = "" if best.stage == "all" else f" of {best.stage}"
        lines += [
            f"{self.label}: cost {best.cost:.4f} ({baseline}: 1), {values}{of}",
            "  ".join(f"{q.symbol} {format_ratio(best.ratios[q.key])}" for q in PAPER_QUANTITIES)
            + f"  largest error of the last second {best.last_error:.4g} {plan.position_unit}",
        ]
        return "\n".join(lines) + "\n"

    def save(self, folder: ResultFolder) -> None:
        """Write everything."""
        folder.write("points.csv", self.points_csv())
        folder.write("tune.json", json.dumps(self.as_mapping(), indent=2) + "\n")
        folder.write("table.txt", self.table())
        folder.write("best.yaml", self.snippet())
        if any(each.ratios for each in self._search.evaluations):
            self._draw(folder)

    def _draw(self, folder: ResultFolder) -> None:
        from hpid_ros.report.figures.studies import SearchPoints, front_figure

        run = [each for each in self._search.evaluations if each.ratios]
        best = self._search.best
        points = SearchPoints(
            self.label, [each.ratios for each in run], None if best is None else run.index(best)
        )
        baseline = next(iter(self._plan.experiment.controllers))
        front_figure([points], baseline).savefig(folder.file("trade_off.png"))


def _mapping(best: Evaluation) -> Mapping[str, Any]:
    return {
        "point": best.number,
        "stage": best.stage,
        "values": dict(best.values),
        "cost": best.cost,
        "ratios": dict(best.ratios),
        LAST_ERROR.key: best.last_error,
    }
