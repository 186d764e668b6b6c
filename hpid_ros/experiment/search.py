"""Searches a controller's free parameters for the least cost, in process and on every core."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hpid_ros.analysis import RunIndices
from hpid_ros.errors import HpidError, RunError
from hpid_ros.experiment.batch import Outcome, run_batch
from hpid_ros.experiment.judged_run import LAST_ERROR, JudgedTask
from hpid_ros.experiment.search_cost import mean_ratios
from hpid_ros.experiment.search_plan import Evaluation, SearchPlan
from hpid_ros.experiment.search_space import SearchSpace
from hpid_ros.tuning.degree_check import DegreeChecker

_LEAST_POPULATION, _POPULATION_PER_PARAMETER = 5, 4


class Search:
    """A search under way, with everything that it has found so far.

    Args:
        plan: What to search.
        jobs: As for :func:`~hpid_ros.experiment.batch.run_batch`.
        advanced: Is told of every point.
    """

    def __init__(
        self,
        plan: SearchPlan,
        jobs: int | None = None,
        advanced: Callable[[Evaluation], None] = lambda evaluation: None,
    ) -> None:
        self.plan = plan
        self.evaluations: list[Evaluation] = []
        self.baseline: list[RunIndices] = []
        self._jobs, self._advanced = jobs, advanced
        self._checker = DegreeChecker()

    @property
    def best(self) -> Evaluation | None:
        """The cheapest point so far, the first of equals; None if none has a finite cost."""
        finite = [each for each in self.evaluations if math.isfinite(each.cost)]
        return min(finite, key=lambda each: each.cost, default=None)

    def run(self) -> None:
        """Search; an interrupt leaves what was found.

        Raises:
            RunError: The baseline cannot be run, or a process died.
        """
        plan = self.plan
        label, loops = next(iter(plan.experiment.controllers.items()))
        with closing(run_batch(plan.tasks(label, loops), self._jobs)) as batch:
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

        def costs(shares: NDArray[np.float64]) -> NDArray[np.float64]:
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

    def _evaluated(
        self, space: SearchSpace, stage: str, shares: NDArray[np.float64]
    ) -> list[Evaluation]:
        """Return the evaluations of points, given as shares of the way along each direction."""
        points = [self._point(space, stage, k, row) for k, row in enumerate(shares)]
        judged = {k: point for k, point in enumerate(points) if not point.loops}
        tasks = [(k, task) for k, point in enumerate(points) for task in self._tasks(point)]
        own: dict[int, list[Outcome]] = {}
        try:
            for refused in judged.values():
                self._advanced(refused)
            with closing(run_batch([task for _, task in tasks], self._jobs)) as batch:
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

    def _point(
        self, space: SearchSpace, stage: str, place: int, shares: NDArray[np.float64]
    ) -> Evaluation:
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
            return replace(judged, note=f"not settled: {last:.3g} rad in the last second")
        return replace(judged, cost=self.plan.cost.of(ratios))


def _numbers(outcomes: Sequence[Outcome]) -> tuple[list[RunIndices], list[str]]:
    """Return the numbers of the runs that have some, seed by seed, and why others have none."""
    outcomes = sorted(outcomes, key=lambda outcome: outcome.place)
    runs = [each.indices for each in outcomes if each.indices is not None]
    return runs, [each.failure for each in outcomes if each.failure]
