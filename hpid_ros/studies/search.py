"""The search of a controller's free parameters for one stated cost, and its plan."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace

import numpy as np

from hpid_ros.analysis import RunIndices
from hpid_ros.base.arrays import Numbers
from hpid_ros.base.errors import HpidError, RunError, SettingError
from hpid_ros.base.units import unit_over
from hpid_ros.control import LoopSettings
from hpid_ros.experiment.description import Experiment
from hpid_ros.stability.degrees import DegreeChecker
from hpid_ros.studies.batch import LAST_ERROR, JudgedTask, Outcome, Runner, run_batch
from hpid_ros.studies.search_space import SearchCost, SearchSpace, mean_ratios

LEAST_EVALUATIONS = 10
_TRAINING = 1000
"""Training seeds begin so far above the experiment's own: those of a study stay unseen."""

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
    cost: SearchCost  # what is made small
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
        """The seeds that points are run with."""
        return tuple(self.experiment.seed + _TRAINING + k for k in range(self.seeds))

    @property
    def total(self) -> int:
        """Points of the whole search."""
        return self.evaluations * (1 + len(self.joints) * self.per_joint)

    def tasks(self, name: str, loops: Loops) -> list[JudgedTask]:
        """Return the runs of one controller, one for each training seed."""
        experiment = self.experiment
        return [
            JudgedTask(
                f"{name} seed={seed}",
                replace(experiment.world, seed=seed),
                loops,
                experiment.trajectory,
                experiment.periods,
                self.joints,
            )
            for seed in self.training_seeds
        ]


_LEAST_POPULATION, _POPULATION_PER_PARAMETER = 5, 4


class Search:
    """A search under way, with everything that it has found so far."""

    def __init__(
        self,
        plan: SearchPlan,
        run: Runner = run_batch,
        advanced: Callable[[Evaluation], None] = lambda evaluation: None,
    ) -> None:
        self.plan = plan
        self.evaluations: list[Evaluation] = []
        self.baseline: list[RunIndices] = []
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
        label, loops = next(iter(plan.experiment.controllers.items()))
        with closing(self._run(plan.tasks(label, loops))) as batch:
            self.baseline, failures = _numbers(list(batch))
        if failures:
            raise RunError(f"the baseline cannot be run: {failures[0]}")
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
        tasks = [(k, task) for k, point in enumerate(points) for task in self._tasks(point)]
        own: dict[int, list[Outcome]] = {}
        try:
            for refused in judged.values():
                self._advanced(refused)
            with closing(self._run([task for _, task in tasks])) as batch:
                for outcome in batch:
                    place = tasks[outcome.place][0]
                    outcomes = own.setdefault(place, [])
                    outcomes.append(outcome)
                    if len(outcomes) == self.plan.seeds:
                        judged[place] = self._judged(points[place], outcomes)
                        self._advanced(judged[place])
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

    def _tasks(self, point: Evaluation) -> list[JudgedTask]:
        return self.plan.tasks(f"point {point.number}", point.loops) if point.loops else []

    def _judged(self, point: Evaluation, outcomes: Sequence[Outcome]) -> Evaluation:
        """Return a point with its cost."""
        runs, failures = _numbers(outcomes)
        if failures:
            return replace(point, note=f"failed: {failures[0]}")
        ratios = mean_ratios(runs, self.baseline)
        last = max(each.value(LAST_ERROR) for each in runs)
        judged = replace(point, ratios=ratios, last_error=last)
        if not last <= self.plan.settle:
            unit = self.plan.position_unit
            return replace(judged, note=f"not settled: {last:.3g} {unit} in the last second")
        return replace(judged, cost=self.plan.cost.of(ratios))


def _numbers(outcomes: Sequence[Outcome]) -> tuple[list[RunIndices], list[str]]:
    """Return the numbers of the runs that have some, seed by seed, and why others have none."""
    outcomes = sorted(outcomes, key=lambda outcome: outcome.place)
    runs = [each.indices for each in outcomes if each.indices is not None]
    return runs, [each.failure for each in outcomes if each.failure]
