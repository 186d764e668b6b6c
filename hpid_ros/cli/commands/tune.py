"""``hpid tune``: search a controller's free parameters for one stated cost."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable

from hpid_ros.base.console import TextConsole
from hpid_ros.base.errors import SettingError, unknown_name
from hpid_ros.base.names import require_label
from hpid_ros.cli.commands import DONE, FAILED
from hpid_ros.cli.options import (
    chosen_runner,
    experiment_to_run,
    output_folder,
    print_engine_note,
    progress,
    result_announced,
)
from hpid_ros.control.settings import LAWS
from hpid_ros.experiment.result_folder import EXPERIMENT, ResultFolder
from hpid_ros.experiment.search import (
    Cost,
    Evaluation,
    Search,
    SearchPlan,
    SearchResult,
    SearchSpace,
    WorstExcess,
)


def run(options: argparse.Namespace) -> int:
    """Search, and print what was found."""
    if options.label is not None:
        require_label(options.label, "--label", SettingError)
    plan = _plan(options)
    errors = TextConsole(stderr=True)
    with chosen_runner(options, errors) as runner:
        path = output_folder(options, f"{plan.experiment.name}-tune-{options.law}")
        folder = ResultFolder.create(path, force=options.force, inputs=plan.experiment.inputs)
        print_engine_note([plan.experiment])
        with result_announced(errors, folder, "what was found"):
            with folder, progress(errors, "points", plan.total) as advanced:
                folder.write(EXPERIMENT, plan.experiment.text)
                search = Search(plan, runner, _least_cost(advanced))
                result = SearchResult(search, options.label or f"best {LAWS[options.law]}")
                try:
                    search.run()
                finally:
                    result.save(folder)
            errors.print(result.table(), end="", soft_wrap=True)
            print(result.snippet(), end="")
    return DONE if search.best is not None else FAILED


def _least_cost(advanced: Callable[[str], None]) -> Callable[[Evaluation], None]:
    """Return what tells the least cost so far with every point."""
    least = float("inf")

    def evaluated(evaluation: Evaluation) -> None:
        nonlocal least
        least = min(least, evaluation.cost)
        advanced(f"least cost {least:.4f}" if least < float("inf") else "")

    return evaluated


def _plan(options: argparse.Namespace) -> SearchPlan:
    experiment = experiment_to_run(options)
    for joint in options.joint:
        if joint not in experiment.world.joints:
            raise SettingError(unknown_name("joint", joint, experiment.world.joints))
    named = tuple(joint for joint in experiment.world.joints if joint in options.joint)
    bounds = dict(_numbers(text, "bounds", 2) for text in options.bounds)
    return SearchPlan(
        experiment=experiment,
        space=SearchSpace.of(
            experiment, options.law, {name: (low, high) for name, (low, high) in bounds.items()}
        ),
        cost=_cost(options),
        joints=named or experiment.judged,
        evaluations=options.evaluations,
        seeds=options.seeds,
        search_seed=options.search_seed,
        per_joint=options.per_joint,
        must_be_certified=not options.uncertified,
        settle=math.inf if options.settle is None else options.settle,
    )


def _cost(options: argparse.Namespace) -> Cost | WorstExcess:
    weights = {key: weight for key, (weight,) in _pairs(options.weight, "weight")}
    limits = {key: limit for key, (limit,) in _pairs(options.limit, "limit")}
    if weights and limits:
        raise SettingError("--weight and --limit are two costs; give one of them")
    if limits:
        return WorstExcess(limits)
    return Cost(weights) if weights else Cost.even()


def _pairs(texts: list[str], option: str) -> list[tuple[str, list[float]]]:
    return [_numbers(text, option, 1) for text in texts]


def _numbers(text: str, option: str, count: int) -> tuple[str, list[float]]:
    """Return the name and the numbers of ``NAME=NUMBER:...``."""
    name, _, rest = text.partition("=")
    try:
        numbers = [float(part) for part in rest.split(":")]
    except ValueError:
        numbers = []
    if len(numbers) != count or not name.strip():
        form = "NAME=" + ":".join(["NUMBER"] * count)
        raise SettingError(f"--{option} must be {form}, not {text!r}")
    return name.strip(), numbers
