"""``hpid tune``: search a controller's free parameters for one stated cost."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from hpid_ros.base.errors import SettingError
from hpid_ros.base.names import require_label
from hpid_ros.cli.commands import DONE, FAILED
from hpid_ros.cli.options import (
    add_engine,
    add_experiment,
    add_jobs,
    add_joints,
    add_output,
    chosen_runner,
    experiment_to_run,
    output_folder,
    print_engine_note,
    progress,
    result_announced,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from hpid_ros.experiment.search import Cost, Evaluation, SearchPlan, WorstExcess


_LABELS = {"pid": "best PID", "hpid": "best hPID"}


def add(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "tune",
        description="Search the free parameters of a controller for the least cost, without ROS, "
        "on every core. pid scales the baseline's gains (bandwidth, damping, integral, and how "
        "the bandwidth is distributed over the joints), hpid chooses degree and norm with three "
        "numbers and leaves the gains alone. The cost is the geometric mean over IVC, IAVC, "
        "ITAE, ||u|| and ||e|| of the ratio to the experiment's first controller, or what "
        "--limit makes of it.",
        epilog="Unstable gains and uncertified degrees are refused. The same options give the "
        "same result with any number of jobs. An interrupt leaves what was found.",
    )
    add_experiment(parser)
    add_engine(parser)
    parser.add_argument("--law", choices=tuple(_LABELS), required=True)
    add_joints(parser, "judge this joint; may be repeated (those that the experiment judges)")
    parser.add_argument(
        "--evaluations", type=int, default=150, metavar="N", help="points of the search (150)"
    )
    parser.add_argument(
        "--per-joint",
        action="store_true",
        help="then refine each judged joint on its own, with as many points again",
    )
    parser.add_argument(
        "--seeds", type=int, default=3, metavar="K", help="training seeds of each point (3)"
    )
    parser.add_argument(
        "--weight",
        action="append",
        default=[],
        metavar="INDEX=WEIGHT",
        help="of ivc, iavc, itae, effort_l2 or error_l2 in the cost (1 each); once one is "
        "given, the others are 0",
    )
    parser.add_argument(
        "--limit",
        action="append",
        default=[],
        metavar="INDEX=RATIO",
        help="wanted of the same indices; the cost is then the largest of ratio/limit, and at 1 "
        "all that are given are kept",
    )
    parser.add_argument(
        "--bounds",
        action="append",
        default=[],
        metavar="NAME=LOW:HIGH",
        help="of a free parameter: bandwidth, damping, integral, distribution; mu, "
        "error_scale, rate_weight, effort_scale, floor",
    )
    parser.add_argument(
        "--settle",
        type=float,
        metavar="RAD",
        help="refuse larger errors in the last second, in rad; in m where a joint slides",
    )
    parser.add_argument(
        "--uncertified", action="store_true", help="accept degrees that are not certified"
    )
    parser.add_argument(
        "--search-seed", type=int, default=1, metavar="S", help="of the search itself (1)"
    )
    parser.add_argument("--label", help="name of what is found (best PID, best hPID)")
    add_jobs(parser)
    add_output(parser, "NAME-tune-LAW")
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Search, and print what was found."""
    from hpid_ros.base.console import TextConsole
    from hpid_ros.experiment.result_folder import EXPERIMENT, ResultFolder
    from hpid_ros.experiment.search import Search, SearchResult

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
                result = SearchResult(search, options.label or _LABELS[options.law])
                try:
                    search.run()
                finally:
                    result.save(folder)
            errors.print(result.table(), end="", soft_wrap=True, highlight=False, markup=False)
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
    """Return the search that the options ask for."""
    import math

    from hpid_ros.base.errors import unknown_name
    from hpid_ros.experiment.search import SearchPlan, SearchSpace

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
    from hpid_ros.experiment.search import Cost, WorstExcess

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
