"""A search of parameters for one cost: cost, space, run, table, and a snippet for the experiment.

Both laws have a few numbers for all joints: the PID scales of its gains and how its bandwidth is
distributed over the joints, the homogeneous PID its degree and its norm, with the gains untouched.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from statistics import geometric_mean
from typing import Any

import numpy as np
import yaml

from hpid_bench.experiment.batch import LAST_ERROR, Runner, RunRecord, RunTask, run_batch
from hpid_bench.experiment.description import Experiment, flat, nested
from hpid_bench.experiment.result_folder import ResultFolder, versions
from hpid_ros.base.errors import HpidError, RunError, SettingError, require_known
from hpid_ros.base.rounding import significant
from hpid_ros.base.text import csv_text
from hpid_ros.base.units import Numbers, unit_over
from hpid_ros.base.yaml_text import dump_yaml
from hpid_ros.control.homogeneous_pid import Gains
from hpid_ros.control.laws import LAWS, LawName
from hpid_ros.control.settings import LoopSettings
from hpid_ros.metrics.comparison import ratio
from hpid_ros.metrics.quantities import PAPER
from hpid_ros.metrics.texts import format_ratio
from hpid_ros.stability.gain_check import DegreeChecker


@dataclass(frozen=True)
class Cost:
    r"""A weighted geometric mean of ratios to the baseline.

    .. math:: J = \exp\Big(\sum_q w_q \ln r_q \Big/ \sum_q w_q\Big)

    with :math:`r_q` the geometric mean over the seeds of an index over the baseline's with the
    same seed. The baseline costs 1, and no index counts more for having a larger unit.
    """

    weights: Mapping[str, float]  # of each index by key; those that are left out do not count

    def __post_init__(self) -> None:
        _check(self.weights, "weight", "not negative", lambda weight: weight >= 0.0)

    @classmethod
    def even(cls) -> Cost:
        """Return the cost in which all indices of the paper count the same."""
        return cls({quantity.key: 1.0 for quantity in PAPER})

    def of(self, ratios: Mapping[str, float]) -> float:
        counted = {key: weight for key, weight in self.weights.items() if weight > 0.0}
        if any(not math.isfinite(ratios[key]) for key in counted):
            return math.inf
        if any(ratios[key] == 0.0 for key in counted):
            return 0.0
        logarithm = math.fsum(weight * math.log(ratios[key]) for key, weight in counted.items())
        return math.exp(logarithm / math.fsum(counted.values()))


@dataclass(frozen=True)
class WorstExcess:
    r"""How far the worst index is from what is wanted of it.

    .. math:: J = \max_q r_q / l_q

    with the ratios :math:`r_q` of :class:`Cost`. At 1 or less all limits are kept together.
    """

    limits: Mapping[str, float]  # the largest ratio wanted of each index by key

    def __post_init__(self) -> None:
        _check(self.limits, "limit", "positive", lambda limit: limit > 0.0)

    def of(self, ratios: Mapping[str, float]) -> float:
        """Return the cost; infinite where an index is not finite."""
        excesses = [ratios[key] / limit for key, limit in self.limits.items()]
        return max(excesses) if all(map(math.isfinite, excesses)) else math.inf


def _check(
    numbers: Mapping[str, float], what: str, wanted: str, is_good: Callable[[float], bool]
) -> None:
    known = [quantity.key for quantity in PAPER]
    require_known("index", numbers, known)
    for key, number in numbers.items():
        if not (math.isfinite(number) and is_good(number)):
            raise SettingError(f"the {what} of {key} must be finite and {wanted}, not {number}")
    if not any(numbers.values()):
        raise SettingError(f"at least one index must have a positive {what}")


def mean_ratios(
    runs: Mapping[int, RunRecord], baseline: Mapping[int, RunRecord]
) -> dict[str, float]:
    """Return for each index the geometric mean over the seeds of its ratio to the baseline."""
    found = {}
    for quantity in PAPER:
        each = [ratio(runs[k].value(quantity), baseline[k].value(quantity)) for k in sorted(runs)]
        is_plain = all(math.isfinite(value) and value > 0.0 for value in each)
        mean = math.fsum(map(math.log, each)) / len(each) if is_plain else math.nan
        found[quantity.key] = math.exp(mean) if is_plain else max(each)
    return found


def _rounded(value: float) -> float:
    """Return six digits: what is printed is what was run."""
    return significant(value, 6)


@dataclass(frozen=True)
class FreeParameter:
    """One direction of a search."""

    name: str  # what a person calls it
    low: float  # least value
    high: float  # largest value
    start: float  # where the search begins: at the baseline
    meaning: str  # in a few words
    is_logarithmic: bool = True  # whether the search sees its logarithm

    def __post_init__(self) -> None:
        least = 0.0 if self.is_logarithmic else -math.inf
        if not least < self.low < self.high < math.inf:
            raise SettingError(
                f"the bounds of {self.name} must be finite, the first below the second"
                f"{' and positive' if self.is_logarithmic else ''}, not {self.low}:{self.high}"
            )

    def value(self, share: float) -> float:
        """Return the value at a share of the way from the least to the largest."""
        low, high = (self._seen(end) for end in (self.low, self.high))
        seen = low + min(max(share, 0.0), 1.0) * (high - low)
        return _rounded(math.exp(seen) if self.is_logarithmic else seen)

    def share(self, value: float) -> float:
        """Return the inverse of :meth:`value`, within [0, 1]."""
        low, high, seen = (self._seen(each) for each in (self.low, self.high, value))
        return min(max((seen - low) / (high - low), 0.0), 1.0)

    def _seen(self, value: float) -> float:
        return math.log(value) if self.is_logarithmic else value


PID_PARAMETERS = (
    FreeParameter("bandwidth", 0.2, 5.0, 1.0, "p, i and d times its square, cube and itself"),
    FreeParameter("damping", 0.3, 3.0, 1.0, "factor of d"),
    FreeParameter("integral", 0.05, 5.0, 1.0, "factor of i"),
    FreeParameter(
        "distribution",
        -0.4,
        0.4,
        0.0,
        "exponent of a joint's p over the geometric mean of all p; the power is a factor of its "
        "bandwidth",
        is_logarithmic=False,
    ),
)
"""Of a linear controller; the last one only where there is more than one joint."""

_DEGREE = FreeParameter("mu", -0.45, 0.45, 0.0, "degree", is_logarithmic=False)
HPID_PARAMETERS = (
    _DEGREE,
    FreeParameter("error_scale", 0.05, 20.0, 1.0, "factor of norm.error_scale"),
    FreeParameter("rate_weight", 1e-3, 10.0, 0.1, "norm.rate_weight [s/rad]"),
)
"""Of a homogeneous controller whose joints have scales of their own."""

EFFORT_PARAMETERS = (
    _DEGREE,
    FreeParameter("effort_scale", 0.05, 20.0, 1.0, "factor of norm.effort_scale"),
    FreeParameter("floor", 0.01, 1.0, 0.1, "norm.floor"),
)
"""Of a homogeneous controller whose norm is in units of effort."""


def source_label(experiment: Experiment, law: LawName) -> str:
    """Return the label of the controller whose other settings a search keeps."""
    for label in experiment.controllers if LAWS[law].is_homogeneous else ():
        loops = experiment.controllers[label]
        if label != experiment.baseline and any(loop.is_homogeneous for loop in loops):
            return label
    return experiment.baseline


_GAINS = ("gains.p", "gains.i", "gains.d")


@dataclass(frozen=True)
class SearchSpace:
    """All that a search may choose from."""

    law: LawName
    parameters: tuple[FreeParameter, ...]  # the free parameters
    # takes settings and the values by name, and returns other settings
    apply: Callable[..., LoopSettings]
    changed: tuple[str, ...]  # the names of the settings that it changes
    # the controller that is changed, joint by joint, at the start of the search
    start: tuple[LoopSettings, ...]
    joints: tuple[str, ...]  # the joints that are changed

    @classmethod
    def of(
        cls,
        experiment: Experiment,
        law: LawName,
        bounds: Mapping[str, tuple[float, float]] | None = None,
    ) -> SearchSpace:
        """Return the space around an experiment's baseline, over all its joints.

        A homogeneous search has the baseline's gains; everything else is that of
        :func:`source_label`.
        """
        require_known("law", [law], LAWS)
        baseline = experiment.controllers[experiment.baseline]
        source = experiment.controllers[source_label(experiment, law)]
        start = tuple(
            replace(each, law=law, mu=0.0, gains=known.gains)
            for each, known in zip(source, baseline, strict=True)
        )
        apply: Callable[..., LoopSettings]
        changed: tuple[str, ...]
        free: tuple[FreeParameter, ...]
        if not LAWS[law].is_homogeneous:
            free = PID_PARAMETERS[: len(PID_PARAMETERS) - (len(start) == 1)]
            for each in start:
                if not each.gains.p:
                    raise SettingError(
                        f"{each.joint}: gains.p is 0, there is nothing to scale; hpid gains "
                        f"computes some"
                    )
            apply = partial(_scaled_gains, geometric_mean(each.gains.p for each in start))
            changed = _GAINS
        else:
            in_effort = all(each.norm.effort_scale for each in start)
            degree, scale, other = EFFORT_PARAMETERS if in_effort else HPID_PARAMETERS
            first = getattr(start[0].norm, other.name)
            if not in_effort or other.low <= first <= other.high:
                other = replace(other, start=first)
            free = (degree, scale, other)
            apply = partial(_homogeneous, scale.name)
            changed = ("mu", f"norm.{scale.name}", f"norm.{other.name}")
            if any(each.gains != own.gains for each, own in zip(source, start, strict=True)):
                changed += _GAINS
        parameters = {each.name: each for each in free}
        bounds = bounds or {}
        require_known("free parameter", bounds, parameters)
        for name, (low, high) in bounds.items():
            parameters[name] = replace(parameters[name], low=low, high=high)
        joints = experiment.world.joints
        return cls(law, tuple(parameters.values()), apply, changed, start, joints)

    def controller(self, values: Sequence[float]) -> tuple[LoopSettings, ...]:
        found = {each.name: value for each, value in zip(self.parameters, values, strict=True)}
        loops = list(self.start)
        for place, each in enumerate(self.start):
            if each.joint in self.joints:
                try:
                    loops[place] = self.apply(each, **found)
                except HpidError as error:
                    raise type(error)(f"{each.joint}: {error}") from None
        return tuple(loops)

    def narrowed(self, joint: str, start: Sequence[LoopSettings]) -> SearchSpace:
        """Return the space of the same directions of one joint, from another start."""
        (own,) = [each for each in start if each.joint == joint]
        norm = own.norm
        at = {"mu": own.mu, "rate_weight": norm.rate_weight, "floor": norm.floor}
        parameters = tuple(
            replace(each, start=at.get(each.name, 1.0))
            for each in self.parameters
            if each.name != "distribution"  # one joint's bandwidth is said already
        )
        return replace(self, parameters=parameters, start=tuple(start), joints=(joint,))


def _scaled_gains(
    mean: float,
    settings: LoopSettings,
    bandwidth: float,
    damping: float,
    integral: float,
    distribution: float = 0.0,
) -> LoopSettings:
    gains = settings.gains
    own = bandwidth * (gains.p / mean) ** distribution
    scaled = (gains.p * own**2, gains.i * own**3 * integral, gains.d * own * damping)
    return replace(settings, gains=Gains(*map(_rounded, scaled)))


def _homogeneous(scale: str, settings: LoopSettings, mu: float, **norm: float) -> LoopSettings:
    norm[scale] = _rounded(getattr(settings.norm, scale) * norm[scale])
    return settings.with_parameters({"mu": mu, **{f"norm.{k}": x for k, x in norm.items()}})


LEAST_EVALUATIONS = 10
_TRAINING = (
    1000  # training seeds begin so far above the experiment's: those of a study stay unseen
)

Loops = tuple[LoopSettings, ...]


@dataclass(frozen=True)
class Evaluation:
    """One point of a search."""

    number: int  # counted from 0
    stage: str  # all joints, or the one that was refined
    values: Mapping[str, float]  # the free parameters by name
    loops: Loops  # the controller; empty if it was refused
    cost: float = math.inf  # infinite if it was refused or a run failed
    ratios: Mapping[str, float] = field(default_factory=dict)
    last_error: float = math.nan  # [rad] largest error of the last second over joints and seeds
    note: str = ""  # why it has no cost, in one line


@dataclass(frozen=True)
class SearchPlan:
    """Everything that decides what a search finds."""

    experiment: Experiment  # gives the robot, the reference and the baseline, its first controller
    space: SearchSpace  # what may be changed
    cost: Cost | WorstExcess  # what is made small
    joints: tuple[str, ...]  # the joints that are judged
    evaluations: int = 150  # points of the search over all joints, and of each refinement of one
    seeds: int = 3  # how many training seeds each point is run with
    search_seed: int = 1  # of the search itself
    per_joint: bool = False  # whether every judged joint is refined on its own after the search
    must_be_certified: bool = True  # whether degrees that are not certified are refused
    settle: float = math.inf  # [rad] largest error of the last second that is accepted

    def __post_init__(self) -> None:
        if self.evaluations < LEAST_EVALUATIONS:
            raise SettingError(
                f"evaluations must be at least {LEAST_EVALUATIONS}, not {self.evaluations}"
            )
        if self.seeds < 1:
            raise SettingError(f"seeds must be at least 1, not {self.seeds}")
        if not self.settle > 0.0:
            raise SettingError(f"settle must be positive, not {self.settle} {self.position_unit}")
        for each in self.space.start:
            reason = DegreeChecker().instability(each)
            if reason:
                raise SettingError(f"{each.joint}: {reason}")

    @property
    def position_unit(self) -> str:
        """Of the judged joints' positions: rad, m, or one of both."""
        are_slides = self.experiment.are_slides(self.joints)
        return unit_over("rad", are_slides).replace(", ", " or ")

    @property
    def training_seeds(self) -> tuple[int, ...]:
        return tuple(self.experiment.seed + _TRAINING + k for k in range(self.seeds))

    @property
    def total(self) -> int:
        return self.evaluations * (1 + len(self.joints) * self.per_joint)

    def tasks(self, name: str, loops: Loops) -> dict[int, RunTask]:
        """Return the runs of a controller by seed."""
        return {
            seed: RunTask.seeded(self.experiment, name, seed, loops, self.joints)
            for seed in self.training_seeds
        }


_LEAST_POPULATION, _POPULATION_PER_PARAMETER = 5, 4


class Search:
    def __init__(
        self,
        plan: SearchPlan,
        run: Runner = run_batch,
        advanced: Callable[[Evaluation], None] = lambda evaluation: None,
    ) -> None:
        self.plan = plan
        self.evaluations: list[Evaluation] = []
        self.baseline: dict[int, RunRecord] = {}
        self._run, self._advanced = run, advanced
        self._checker = DegreeChecker()

    @property
    def best(self) -> Evaluation | None:
        """The cheapest point so far, the first of equals; None if none has a finite cost."""
        finite = [each for each in self.evaluations if math.isfinite(each.cost)]
        return min(finite, key=lambda each: each.cost, default=None)

    def run(self) -> None:
        """Search; an interrupt leaves what was found."""
        plan = self.plan
        label = plan.experiment.baseline
        with closing(self._run(plan.tasks(label, plan.experiment.controllers[label]))) as batch:
            self.baseline = dict(batch)
        failure = _failure(self.baseline)
        if failure:
            raise RunError(f"the baseline cannot be run: {failure}")
        self._minimise(plan.space, "all")
        for joint in plan.joints if plan.per_joint else ():
            if self.best is not None:
                self._minimise(plan.space.narrowed(joint, self.best.loops), joint)

    def _minimise(self, space: SearchSpace, stage: str) -> None:
        """Search one space by differential evolution, in as many points as planned.

        Source: R. Storn and K. Price, "Differential Evolution", J. Global Optimization 11
        (1997), as in SciPy.
        """
        from scipy.optimize import differential_evolution
        from scipy.stats import qmc

        count = len(space.parameters)
        population = min(_POPULATION_PER_PARAMETER * count, self.plan.evaluations // 3)
        population = max(_LEAST_POPULATION, population)
        generations, rest = divmod(self.plan.evaluations, population)
        first = qmc.LatinHypercube(count, seed=self.plan.search_seed).random(population)
        first[0] = [each.share(each.start) for each in space.parameters]

        def costs(shares: Numbers) -> Numbers:
            return np.array([each.cost for each in self._evaluated(space, stage, shares.T)])

        if rest:  # so that all points that were asked for are used
            more = qmc.LatinHypercube(count, seed=self.plan.search_seed + 1).random(rest)
            self._evaluated(space, stage, more)
        differential_evolution(
            costs,
            [(0.0, 1.0)] * count,
            init=first,
            maxiter=generations - 1,
            tol=0.0,
            polish=False,
            updating="deferred",
            vectorized=True,
            seed=self.plan.search_seed,
        )

    def _evaluated(self, space: SearchSpace, stage: str, shares: Numbers) -> list[Evaluation]:
        """Return the evaluations of points, given as shares of the way along each direction."""
        points = [self._point(space, stage, k, row) for k, row in enumerate(shares)]
        judged = {k: point for k, point in enumerate(points) if not point.loops}
        tasks = {
            (k, seed): task
            for k, point in enumerate(points)
            if point.loops
            for seed, task in self.plan.tasks(f"point {point.number}", point.loops).items()
        }
        own: dict[int, dict[int, RunRecord]] = {}
        try:
            for refused in judged.values():
                self._advanced(refused)
            with closing(self._run(tasks)) as batch:
                for (k, seed), record in batch:
                    runs = own.setdefault(k, {})
                    runs[seed] = record
                    if len(runs) == self.plan.seeds:
                        judged[k] = self._judged(points[k], runs)
                        self._advanced(judged[k])
        finally:
            self.evaluations += [judged[place] for place in sorted(judged)]
        return [judged[place] for place in range(len(points))]

    def _point(self, space: SearchSpace, stage: str, place: int, shares: Numbers) -> Evaluation:
        """Return a point that has not been run, or why it will not be."""
        pairs = zip(space.parameters, shares.tolist(), strict=True)
        values = {each.name: each.value(share) for each, share in pairs}
        number = len(self.evaluations) + place
        try:
            loops = space.controller(list(values.values()))
        except HpidError as error:
            return Evaluation(number, stage, values, (), note=f"refused: {error}")
        check = self._checker
        refusal = check.refusal if self.plan.must_be_certified else check.instability
        for each in loops:
            reason = refusal(each)
            if reason:
                return Evaluation(number, stage, values, (), note=f"refused: {reason}")
        return Evaluation(number, stage, values, loops)

    def _judged(self, point: Evaluation, runs: Mapping[int, RunRecord]) -> Evaluation:
        failure = _failure(runs)
        if failure:
            return replace(point, note=f"failed: {failure}")
        ratios = mean_ratios(runs, self.baseline)
        last = max(each.value(LAST_ERROR) for each in runs.values())
        judged = replace(point, ratios=ratios, last_error=last)
        if not last <= self.plan.settle:
            unit = self.plan.position_unit
            return replace(judged, note=f"not settled: {last:.3g} {unit} in the last second")
        return replace(judged, cost=self.plan.cost.of(ratios))


def _failure(runs: Mapping[int, RunRecord]) -> str:
    """Return why the first of the runs failed that did."""
    return next((runs[seed].failure for seed in sorted(runs) if runs[seed].failure), "")


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
    common = flat({key: value for key, value in written.items() if key != _JOINTS})
    each = {joint: flat(entry) for joint, entry in written.get(_JOINTS, {}).items()}
    for name in ("law", *space.changed):
        values = {loop.joint: loop.to_parameters()[name] for loop in loops}
        for parameters in (common, *each.values()):
            parameters.pop(name, None)
        if len(set(values.values())) == 1:
            common[name] = next(iter(values.values()))
        else:
            for joint, value in values.items():
                each.setdefault(joint, {})[name] = value
    entry = nested(common)
    own = {joint: nested(each[joint]) for joint in experiment.world.joints if each.get(joint)}
    return {**entry, _JOINTS: own} if own else entry


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
        return dump_yaml({"compare": {self.label: entry}}, flow=None, width=96)

    def points_csv(self) -> str:
        """Return every point, one a row: its place, parameters, cost, ratios, last error."""
        names = [each.name for each in self._plan.space.parameters]
        keys = [quantity.key for quantity in PAPER]
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
            "baseline": experiment.baseline,
            "label": self.label,
            "law": plan.space.law,
            "joints": list(plan.joints),
            "training_seeds": list(plan.training_seeds),
            "search_seed": plan.search_seed,
            "per_joint": plan.per_joint,
            "must_be_certified": plan.must_be_certified,
            "settle": plan.settle if math.isfinite(plan.settle) else None,
            **asdict(plan.cost),
            "bounds": {each.name: [each.low, each.high] for each in plan.space.parameters},
            "evaluations": {"planned": plan.total, "made": len(self._search.evaluations)},
            "best": best
            and {
                "point": best.number,
                "stage": best.stage,
                "values": dict(best.values),
                "cost": best.cost,
                "ratios": dict(best.ratios),
                LAST_ERROR.key: best.last_error,
            },
            "parameters": {
                each.joint: dict(each.to_parameters()) for each in (best.loops if best else ())
            },
        }

    def table(self) -> str:
        plan, best = self._plan, self._search.best
        made = len(self._search.evaluations)
        refused = sum(each.note.startswith("refused") for each in self._search.evaluations)
        lines = [
            f"{plan.experiment.name}: {made} of {plan.total} points, {refused} refused, "
            f"{plan.seeds} training seed{'s' * (plan.seeds > 1)} from {plan.training_seeds[0]}, "
            f"totals over {', '.join(plan.joints)}"
        ]
        if best is None:
            why = "all were refused, failed or did not settle (see note in points.csv)"
            return f"{lines[0]}\nno usable point: {why}\n"
        baseline = plan.experiment.baseline
        values = ", ".join(f"{name} {value:g}" for name, value in best.values.items())
        of = "" if best.stage == "all" else f" of {best.stage}"
        lines += [
            f"{self.label}: cost {best.cost:.4f} ({baseline}: 1), {values}{of}",
            "  ".join(f"{q.symbol} {format_ratio(best.ratios[q.key])}" for q in PAPER)
            + f"  largest error of the last second {best.last_error:.4g} {plan.position_unit}",
        ]
        return "\n".join(lines) + "\n"

    def save(self, folder: ResultFolder) -> None:
        folder.write("points.csv", self.points_csv())
        folder.write("tune.json", json.dumps(self.as_mapping(), indent=2) + "\n")
        folder.write("table.txt", self.table())
        folder.write("best.yaml", self.snippet())
        run = [each for each in self._search.evaluations if each.ratios]
        if run:
            from hpid_bench.report.plots import SearchPoints, front_figure

            best = self._search.best
            place = None if best is None else run.index(best)
            points = SearchPoints(self.label, [each.ratios for each in run], place)
            front_figure([points], self._plan.experiment.baseline).savefig(
                folder.file("trade_off.png")
            )
