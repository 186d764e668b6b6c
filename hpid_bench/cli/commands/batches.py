"""``hpid sweep``, ``hpid study``, ``hpid tune``: many runs without ROS, on cores or a cluster.

A sweep is a grid over the parameters of one controller, a study are experiments over many seeds
with what becomes of the paper's claims, and tune searches free parameters for one stated cost.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

from rich.console import Console, RenderableType

from hpid_bench.cli.commands import DONE, FAILED
from hpid_bench.cli.options import (
    chosen_engine,
    experiment_to_run,
    output_folder,
    print_engine_note,
    progress,
)
from hpid_bench.cli.terminal import output_console
from hpid_bench.experiment.batch import Runner, RunRecord, run_batch
from hpid_bench.experiment.description import Experiment
from hpid_bench.experiment.result_folder import EXPERIMENT, ResultFolder
from hpid_bench.experiment.search import (
    Cost,
    Evaluation,
    Search,
    SearchPlan,
    SearchResult,
    SearchSpace,
    WorstExcess,
)
from hpid_bench.experiment.study import (
    StudyResult,
    run_study,
    runs_csv,
    study_folder,
    tables,
)
from hpid_bench.experiment.study_plan import (
    default_files,
    is_robot_installed,
    kept_records,
    plan_study,
)
from hpid_bench.experiment.sweep import Axis, plan_sweep, run_sweep
from hpid_bench.report.console import TextConsole
from hpid_bench.report.table import spaced, tables_markdown, tables_text
from hpid_ros.base.errors import RunError, SettingError, require_known
from hpid_ros.base.names import require_label
from hpid_ros.control.laws import LAWS


@contextmanager
def _running(
    options: argparse.Namespace,
    console: Console,
    made: Callable[[], ResultFolder],
    experiments: Iterable[Experiment],
    interrupted: str = "what was run",
) -> Iterator[tuple[Runner, ResultFolder]]:
    """Give what runs a batch and the folder of its result; say at the end where that is."""
    with ExitStack() as stack:
        if options.scheduler is not None:
            from hpid_bench.experiment.cluster import Cluster

            runner: Runner = stack.enter_context(Cluster(options.scheduler))
            console.print(str(runner), soft_wrap=True)
        elif options.jobs is not None and options.jobs < 1:
            raise SettingError(f"--jobs must be at least 1, not {options.jobs}")
        else:
            runner = partial(run_batch, jobs=options.jobs)
        folder = made()
        print_engine_note(experiments)
        try:
            yield runner, folder
        except (KeyboardInterrupt, RunError):
            console.print(f"{interrupted}: {folder.path}", soft_wrap=True)
            raise
        console.print(f"result: {folder.path}", soft_wrap=True)


@contextmanager
def _run_progress(console: Console, runs: int) -> Iterator[Callable[[RunRecord], None]]:
    """Show the progress of runs and how many have failed."""
    failures = 0
    with progress(console, "runs", runs) as advanced:

        def ended(record: RunRecord) -> None:
            nonlocal failures
            failures += bool(record.failure)
            advanced(f"{failures} failed" if failures else "")

        yield ended


def _print(
    form: str, tables: Sequence[RenderableType], texts: Mapping[str, Callable[[], str]]
) -> None:
    """Print a result: tables, on a terminal as wide as that, or the text of another format."""
    if form in texts:
        print(texts[form](), end="")
    elif sys.stdout.isatty():
        console = output_console()
        for table in tables:
            console.print(table)
    else:
        print(tables_text(tables), end="")


def sweep(options: argparse.Namespace) -> int:
    axes = [Axis.parse(text) for text in options.vary]
    experiment = experiment_to_run(options)
    planned = plan_sweep(
        experiment, axes, controller=options.controller, joints=options.joint, seeds=options.seeds
    )
    console = TextConsole(stderr=True)
    made = _new_folder(options, experiment, "sweep")
    with _running(options, console, made, [experiment]) as (runner, folder):
        with folder, _run_progress(console, len(planned.tasks())) as ended:
            result = run_sweep(planned, folder, runner, ended)
        _print(options.format, [result], {"csv": result.summary_csv, "json": result.json})
    return FAILED if result.table.failures else DONE


def _new_folder(
    options: argparse.Namespace, experiment: Experiment, name: str
) -> Callable[[], ResultFolder]:
    """Return what makes the folder of a result, once everything else has been looked at."""
    path = output_folder(options, f"{experiment.name}-{name}")
    return partial(ResultFolder.create, path, force=options.force, inputs=experiment.inputs)


def study(options: argparse.Namespace) -> int:
    if options.resume and (options.force or options.output is None):
        raise SettingError("--resume needs the study's folder as --output, and not --force")
    plan = plan_study(
        options.experiments or _shipped_files(),
        joints=options.joint,
        seeds=options.seeds,
        engine=chosen_engine(options),
    )
    console = TextConsole(stderr=True)
    path = output_folder(options, "study")
    made = partial(
        study_folder, path, force=options.force, resume=options.resume, inputs=plan.inputs
    )
    experiments = (entry.experiment for entry in plan.entries)
    with _running(options, console, made, experiments) as (runner, folder):
        runs = len(plan.tasks()) - len(kept_records(plan, folder.path))
        with folder, _run_progress(console, runs) as ended:
            result = run_study(plan, folder, runner, ended)
        _print_study(result, options.format)
    return FAILED if result.table.failures else DONE


def _shipped_files() -> list[Path]:
    """Return this package's experiments whose robots are installed, and say which are not."""
    files = default_files()
    missing = [file for file in files if not is_robot_installed(file)]
    if missing:
        names = ", ".join(file.stem for file in missing)
        print(f"hpid: left out, because their robots are not installed: {names}", file=sys.stderr)
    return [file for file in files if file not in missing]


def _print_study(result: StudyResult, form: str) -> None:
    found = tables(result)
    texts: dict[str, Callable[[], str]] = {
        "docs": partial(tables_markdown, found),
        "csv": partial(runs_csv, result),
        "json": lambda: json.dumps(result.as_mapping(), indent=2) + "\n",
    }
    _print(form, [*spaced(found)], texts)


def tune(options: argparse.Namespace) -> int:
    if options.label is not None:
        require_label(options.label, "--label", SettingError)
    plan = _search_plan(options)
    console = TextConsole(stderr=True)
    made = _new_folder(options, plan.experiment, f"tune-{options.law}")
    running = _running(options, console, made, [plan.experiment], "what was found")
    with running as (runner, folder):
        with folder, progress(console, "points", plan.total) as advanced:
            folder.write(EXPERIMENT, plan.experiment.text)
            search = Search(plan, runner, _least_cost(advanced))
            result = SearchResult(search, options.label or f"best {LAWS[options.law].title}")
            try:
                search.run()
            finally:
                result.save(folder)
        console.print(result.table(), end="", soft_wrap=True)
        print(result.snippet(), end="")
    return DONE if search.best is not None else FAILED


def _least_cost(advanced: Callable[[str], None]) -> Callable[[Evaluation], None]:
    """Return what tells the least cost so far with every point."""
    least = math.inf

    def evaluated(evaluation: Evaluation) -> None:
        nonlocal least
        least = min(least, evaluation.cost)
        advanced(f"least cost {least:.4f}" if least < math.inf else "")

    return evaluated


def _search_plan(options: argparse.Namespace) -> SearchPlan:
    experiment = experiment_to_run(options)
    require_known("joint", options.joint, experiment.world.joints)
    named = tuple(joint for joint in experiment.world.joints if joint in options.joint)
    bounds = {}
    for text in options.bounds:
        name, (low, high) = _numbers(text, "bounds", 2)
        bounds[name] = (low, high)
    return SearchPlan(
        experiment=experiment,
        space=SearchSpace.of(experiment, options.law, bounds),
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
    weights, limits = (
        {key: number for key, (number,) in (_numbers(text, option, 1) for text in texts)}
        for option, texts in (("weight", options.weight), ("limit", options.limit))
    )
    if weights and limits:
        raise SettingError("--weight and --limit are two costs; give one of them")
    if limits:
        return WorstExcess(limits)
    return Cost(weights) if weights else Cost.even()


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
