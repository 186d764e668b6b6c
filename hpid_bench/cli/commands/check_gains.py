"""``hpid check-gains``: certificates of every joint's loop; ``hpid gains``: gains by a rule."""

from __future__ import annotations

import argparse
import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

from rich.console import RenderableType, group
from rich.text import Text

from hpid_bench.cli.commands import DONE, FAILED
from hpid_bench.cli.options import (
    JointPlants,
    first_homogeneous,
    joint_progress,
    judged_loops,
    load_robot,
    loop_file,
    named_experiment,
    print_undriven,
    shown_name,
    sliding_joints_from,
    warn_unlimited,
)
from hpid_bench.cli.robot_arguments import GAIN_OPTIONS
from hpid_bench.cli.terminal import output_console
from hpid_bench.experiment.description import Experiment, initial_inertias
from hpid_bench.report.console import TextConsole
from hpid_bench.report.table import WideTable
from hpid_bench.tuning.gain_design import design, held_by_friction, yaml_text
from hpid_ros.base.errors import SettingError
from hpid_ros.base.processes import side_by_side
from hpid_ros.base.units import of_slide, unit_over
from hpid_ros.control.homogeneous_pid import Gains
from hpid_ros.control.laws import LAWS
from hpid_ros.control.norms import GOOD_SAMPLING_MARGIN
from hpid_ros.control.parameter_files import ParameterFile
from hpid_ros.control.settings import LoopSettings
from hpid_ros.metrics.results import for_json
from hpid_ros.stability.gain_check import (
    LARGEST_SAMPLING_MARGIN,
    LARGEST_SAMPLING_MARGIN_LATE,
    CertificateVerification,
    GainVerdict,
    check_gains,
    saved_certificates,
    verify_certificates,
)

if TYPE_CHECKING:
    from hpid_ros.robot.coupling import Settling


_RATIOS = ("integral_ratio", "sampling_margin")
_HEADINGS = ("loop", "ok", "mu", "certified mu", "rho", "T kd", "lam", "settles", "inertia")


@group()
def gain_table(
    verdicts: Mapping[str, GainVerdict], slides: Collection[str] = ()
) -> Iterator[RenderableType]:
    """Yield one row for each loop, and the reasons below."""
    rows = [(name, *_cells(verdict)) for name, verdict in verdicts.items()]
    yield WideTable.of_rows(_HEADINGS, rows, names=2, texts=2)
    yield ""
    for name, verdict in verdicts.items():
        if verdict.reason:
            reason = of_slide(verdict.reason) if name in slides else verdict.reason
            yield Text(f"{name}: {reason}", style="red")
        if verdict.sampling_margin > LARGEST_SAMPLING_MARGIN_LATE:
            yield Text(
                f"{name}: T kd lam / m = {verdict.sampling_margin:.2f}: the sampled loop "
                f"breaks at {LARGEST_SAMPLING_MARGIN_LATE:g} where an effort comes one period "
                f"late, as over a topic, and at {LARGEST_SAMPLING_MARGIN:g} at best",
                style="red",
            )
        elif verdict.sampling_margin > GOOD_SAMPLING_MARGIN:
            yield Text(
                f"{name}: T kd lam / m = {verdict.sampling_margin:.2f} exceeds "
                f"{GOOD_SAMPLING_MARGIN}: sampling will be felt",
                style="yellow",
            )
    unit = unit_over("kg m^2", (name in slides for name in verdicts))
    if "," in unit:
        unit = f"kg m^2; kg: {', '.join(name for name in verdicts if name in slides)}"
    yield Text(
        "ok: certified at this mu, on a fine grid, for the unsampled loop without floor or "
        "cap; a loop may well be stable without. rho = m ki / (kp kd); T kd: T kd lam / m, "
        "without a unit; lam = n^mu up to norm 2; settles [s]: an error of error_scale to a "
        f"hundredth, at the latest; inertia m [{unit}].",
        style="dim",
    )


def _cells(verdict: GainVerdict) -> list[str | Text]:
    law = LAWS[verdict.law]
    low, high = verdict.inertia
    interval = "none"
    if verdict.interval is not None:
        interval = f"{verdict.interval[0]:+.3f} {verdict.interval[1]:+.3f}"
    least, largest = verdict.multipliers
    return [
        Text("yes", style="green") if verdict.is_certified else Text("NO", style="red"),
        f"{verdict.degree:+.3f}" if law.is_homogeneous else law.title,
        interval,
        f"{verdict.integral_ratio:.3f}",
        f"{verdict.sampling_margin:.3f}",
        "1" if least == largest == 1.0 else f"{least:.2f} {largest:.2f}",
        "-" if verdict.settling_bound is None else f"{verdict.settling_bound:.3g}",
        f"{low:.3g}" if low == high else f"{low:.3g} {high:.3g}",
    ]


def _plain(verdict: GainVerdict) -> dict[str, Any]:
    """Return plain data for JSON; what is not finite is null."""
    numbers = {name: for_json(getattr(verdict, name)) for name in _RATIOS}
    return {**asdict(verdict), **numbers, "multipliers": [*map(for_json, verdict.multipliers)]}


def run(options: argparse.Namespace) -> int:
    if options.file:
        saved = saved_certificates(options.file)
        if saved:
            return _verify(saved, options.json)
    experiment, file = _loops(options)
    loops = file.loops
    judged = judged_loops(options, file, experiment)
    with joint_progress(TextConsole(stderr=True), "certified", len(judged)) as progress:
        verdicts = check_gains(judged, progress)
    by_name = dict(zip(map(shown_name, loops), verdicts, strict=True))
    if options.json:
        print(json.dumps({name: _plain(each) for name, each in by_name.items()}, indent=2))
    else:
        slides = sliding_joints_from(options, experiment)
        sliding = [
            name
            for name, settings in zip(by_name, loops.values(), strict=True)
            if settings.joint in slides
        ]
        output_console().print(gain_table(by_name, sliding))
    settling = _settling(options, loops, experiment)
    if not options.json:
        for finding in settling:
            print(finding.text)
    is_settling = all(each.is_settling for each in settling)
    return DONE if is_settling and all(each.is_certified for each in verdicts) else FAILED


def _settling(
    options: argparse.Namespace, loops: Mapping[str, LoopSettings], experiment: Experiment | None
) -> list[Settling]:
    """Find whether decoupled joints that use each other's last efforts settle."""
    decoupled = [each for each in loops.values() if each.model.is_decoupling]
    if not decoupled:
        return []
    from hpid_ros.robot.coupling import settling_of

    source = options.urdf or ("" if experiment is None else str(options.file))
    if not source and not all(each.model.description for each in decoupled):
        if not options.json:
            print("whether decoupled joints settle is not known without the robot: give --urdf")
        return []
    return settling_of(decoupled, load_robot(source).source if source else "")


def _verify(saved: Mapping[str, Sequence[Mapping[str, Any]]], as_json: bool) -> int:
    """Check saved certificates again, each on its own."""
    loops, found = list(saved.items()), {}
    with joint_progress(TextConsole(stderr=True), "verified", len(saved)) as progress:
        for place, found[place] in side_by_side(_verified, loops, name=lambda loop: loop[0]):
            progress([loops[place][0]])
    findings = {name: found[place] for place, (name, _) in enumerate(loops)}
    if as_json:
        print(json.dumps({name: each._asdict() for name, each in findings.items()}, indent=2))
    else:
        for name, each in findings.items():
            print(f"{name}: {each.text}")
    return DONE if all(each.holds for each in findings.values()) else FAILED


def _verified(loop: tuple[str, Sequence[Mapping[str, Any]]]) -> CertificateVerification:
    return verify_certificates(loop[1])


def _loops(options: argparse.Namespace) -> tuple[Experiment | None, ParameterFile]:
    """Return the loops to check, and their experiment if they are of one."""
    given = {
        parameter: getattr(options, name)
        for name, parameter in GAIN_OPTIONS.items()
        if getattr(options, name) is not None
    }
    sources = [bool(options.file), options.live, bool(given)]
    if sum(sources) != 1:
        raise SettingError(
            "check-gains needs one source: a FILE, --live, or gains given as --p --i --d"
        )
    if options.live:
        from hpid_bench.live.running_controllers import running_loops

        return None, ParameterFile(running_loops(), {})
    if options.file:
        return loop_file(options.file)

    missing = [f"--{name}" for name in "pid" if getattr(options, name) is None]
    if missing:
        raise SettingError(f"gains given as options lack {', '.join(missing)}")
    law = "hpid" if options.mu is not None else "pid"
    loop = LoopSettings.from_parameters({"joint": "joint", "law": law, **given})
    return None, ParameterFile({"joint": loop}, {})


def gains(options: argparse.Namespace) -> int:
    inertias: Mapping[str, float]
    frictions: Mapping[str, float] = {}
    slides = frozenset[str]()
    if options.inertia is not None:
        if options.experiment:
            raise SettingError("--inertia is of one joint without a robot: name no FILE with it")
        timing = {} if options.period is None else {"control_period": options.period}
        one = LoopSettings("joint", Gains(0.0, 0.0, 0.0)).with_parameters(timing)
        loops: dict[str, LoopSettings] = {"joint": one}
        plants = JointPlants()
        inertias = {"joint": options.inertia}
    else:
        if options.period is not None:
            raise SettingError("--period is of one joint without a robot: a FILE has its own")
        experiment = named_experiment(options.experiment)
        plants = JointPlants.of(experiment)
        loops = {each.joint: each for each in first_homogeneous(experiment)}
        inertias = initial_inertias(experiment, tuple(loops.values()))
        slides, frictions = experiment.slides, experiment.frictions
        warn_unlimited(experiment.description, loops.values())
        print_undriven(experiment)
    with joint_progress(TextConsole(stderr=True), "certified", len(loops)) as progress:
        designs = design(
            loops,
            inertias,
            options.rule,
            options.closed_loop_time,
            options.delay,
            lambda settings, inertia: plants.family(settings, inertia, options.delay),
            progress,
        )
    designs |= {
        joint: replace(each, reason=of_slide(each.reason))
        for joint, each in designs.items()
        if joint in slides
    }
    head = f"{options.rule}, closed-loop time {options.closed_loop_time:g} s"
    head += f", delay {options.delay:g} s" if options.delay else ""
    period = next(iter(loops.values())).timing.control_period
    head += f"; margins as PID, sampled every {1e3 * period:g} ms"
    print(yaml_text(designs, head), end="")
    errors = TextConsole(stderr=True)
    for joint, friction in frictions.items():
        line = held_by_friction(joint, designs[joint].gains.p, friction)
        if line:
            line = of_slide(line) if joint in slides else line
            print(f"# {line}")
            errors.print(line, soft_wrap=True)
    return FAILED if any(each.reason for each in designs.values()) else DONE
