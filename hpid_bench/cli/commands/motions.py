"""``hpid excite``, ``hpid autotune``: joints of a running robot moved safely, and recorded.

The one moves them so that a recording tells what they are; the other by a relay, whose test gives
SIMC gains and the homogeneous PID with them.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from hpid_bench.cli.commands import DONE, FAILED, INTERRUPTED
from hpid_bench.cli.options import inertias_from, write_output
from hpid_bench.cli.terminal import output_console
from hpid_bench.live.known_controllers import RunningController, RunningGraph
from hpid_bench.live.motion import (
    RelayFindings,
    TellMotion,
    bounds_of,
    carry_out,
    carry_out_relay,
    chosen_controllers,
    relay_findings,
)
from hpid_bench.live.running_controllers import running_graph
from hpid_bench.report.figures import require_picture
from hpid_bench.report.table import TableColumn, WideTable
from hpid_bench.tuning.autotune import Autotuned, autotuned
from hpid_bench.tuning.identification.identification_report import excitation_figure
from hpid_bench.tuning.identification.regression import COULOMB, VISCOUS
from hpid_bench.tuning.upgrade_file import controller_section
from hpid_ros.base.errors import ResultExistsError, SettingError
from hpid_ros.base.files import refuse_output
from hpid_ros.base.text import shown
from hpid_ros.base.units import of_slide
from hpid_ros.control.overrides import RAMP
from hpid_ros.messages.messages import measures_velocity
from hpid_ros.motion.excitation import (
    Design,
    ExcitationPlan,
    JointBounds,
    PlannedRelay,
    RelayWish,
    Wish,
    plan,
    planned_relay,
)


def agreed(question: str, *, is_given: bool) -> bool:
    if is_given:
        return True
    if not sys.stdin.isatty():
        raise SettingError("there is no terminal to ask at: --yes answers yes")
    print(f"{question}? [y/N] ", end="", flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def _new_bag(given: Path | None, kind: str, option: str, *, is_dry: bool) -> Path:
    """Return where to record: nothing is written over."""
    bag = given or Path(f"{kind}-{datetime.now():%Y%m%d-%H%M%S}")
    if bag.exists() and not is_dry:
        raise ResultExistsError(f"{bag} exists; name a new folder with {option}")
    return bag


def excite(options: argparse.Namespace) -> int:
    if options.plot is not None:
        require_picture(options.plot)
        refuse_output(options.plot, force=options.force, inputs=(), option="--plot")
    bag = _new_bag(options.output, "excitation", "-o", is_dry=options.dry_run)
    graph = running_graph(options.states, options.namespace)
    controllers = chosen_controllers(graph, options.joint)
    planned = _plan(options, controllers)
    console = output_console()
    _show(console, planned, are_together=options.together)
    if options.plot is not None:
        from hpid_bench.report.plots import drawing_bytes

        form = options.plot.suffix.lower()[1:]
        write_output(options.plot, drawing_bytes(excitation_figure(planned), form))
        console.print(f"written: {options.plot}", soft_wrap=True)
    if options.dry_run:
        return DONE
    count = len(planned.joints)
    noun = planned.names[0] if count == 1 else f"{count} joints"
    if not agreed(f"Move {noun} for {planned.duration:.0f} s now", is_given=options.yes):
        console.print("nothing was moved")
        return FAILED
    with _progress(console, planned) as tell:
        ending = carry_out(planned, controllers, graph, bag, tell)
    if ending.reason:
        console.print(f"stopped: {ending.reason}", style="red", soft_wrap=True)
        if ending.is_at_rest:
            console.print("the joints are at rest; controllers that run hold them")
        else:
            console.print("it was not seen whether the joints came to rest", style="red")
    console.print(f"recorded: {bag}", soft_wrap=True)
    if ending.is_interrupted or ending.reason:
        return INTERRUPTED if ending.is_interrupted else FAILED
    urdf = options.urdf or ("MY.urdf" if count > 1 else "")
    console.print(f"next: hpid identify {bag}{f' --urdf {urdf}' if urdf else ''}", soft_wrap=True)
    if count > 1 and not options.together and not options.urdf:
        console.print(f"or, without a URDF: hpid identify {bag}", soft_wrap=True)
    return DONE


def _plan(options: argparse.Namespace, controllers: Sequence[RunningController]) -> ExcitationPlan:
    names = [each.joint for each in controllers]
    pose = {each.joint: each.position for each in controllers if each.position is not None}
    inertias = inertias_from(options, names, [pose])
    bounds = [
        bounds_of(each, inertias[name][1] if name in inertias else None)
        for name, each in zip(names, controllers, strict=True)
    ]
    given = {"velocity": options.velocity, "acceleration": options.acceleration}
    wish = Wish(
        options.share,
        options.amplitude,
        **{name: value for name, value in given.items() if value is not None},
    )
    design = Design(
        kind=options.kind,
        duration=options.duration,
        band=tuple(options.frequencies),
        are_together=options.together,
        tolerance=options.tolerance,
        seed=options.seed,
    )
    return plan(bounds, wish, design)


def _show(console: Console, planned: ExcitationPlan, *, are_together: bool) -> None:
    joints = planned.joints
    columns = {
        "from": [f"{each.bounds.position:.3f}" for each in joints],
        "+-": [f"{each.peaks.position:.3g}" for each in joints],
        "room": [
            f"{min(b.upper - b.position, b.position - b.lower):.3g}"
            for b in (each.bounds for each in joints)
        ],
        "speed": [f"{each.peaks.velocity:.3g}" for each in joints],
        "limit": [f"{each.bounds.velocity:.3g}" for each in joints],
        "accel.": [f"{each.peaks.acceleration:.3g}" for each in joints],
        "effort": [f"{each.effort:.3g}" for each in joints],
        "load": [f"{each.bounds.load:.2g}" for each in joints],
        "limits": ["{:.3g} {:.3g}".format(*each.bounds.efforts) for each in joints],
        "off": [f"{each.tolerance:.3g}" for each in joints],
        "when": [f"{each.begin:.0f} {each.end:.0f}" for each in joints],
    }
    console.print(
        WideTable(
            [TableColumn("joint", planned.names, is_text=True)],
            [TableColumn(heading, cells) for heading, cells in columns.items()],
        )
    )
    console.print()
    console.print(
        "From where it is, by at most +- within the room to its stops, each in rad; speed and its "
        "limit in rad/s; accel. in rad/s^2; effort for it beside the load, and the limits, in N m "
        "(of joints that slide in m and N). Stopped when further than off from its reference, at "
        f"a limit, or above twice its speed. {'Together' if are_together else 'One by one'}, "
        "when in s.",
        style="dim",
    )
    for each in joints:
        for note in each.notes:
            console.print(f"{each.bounds.joint}: {note}", style="yellow", soft_wrap=True)


@contextmanager
def _progress(console: Console, planned: ExcitationPlan) -> Iterator[TellMotion]:
    columns = (
        TextColumn("{task.fields[doing]}"),
        BarColumn(bar_width=24),
        TextColumn("{task.fields[seconds]} s, Ctrl-C stops"),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal) as shown:
        task = shown.add_task("", total=planned.duration, doing="getting ready", seconds="0.0")

        def told(event: str, seconds: float) -> None:
            moving = [
                each.bounds.joint for each in planned.joints if each.begin <= seconds <= each.end
            ]
            doing = moving[0] if len(moving) == 1 else f"{len(moving)} joints"
            shown.update(task, completed=seconds, doing=doing, seconds=f"{seconds:.1f}")

        yield told


def autotune(options: argparse.Namespace) -> int:
    if not options.live:
        raise SettingError("autotune moves a robot that runs: say --live")
    if options.output is not None:
        refuse_output(options.output, force=options.force, inputs=(), option="-o")
    bag = _new_bag(options.bag, "autotune", "--bag", is_dry=options.dry_run)
    graph = running_graph(options.states, options.namespace)
    controller = _controller(graph, options.joint)
    bounds, planned = _planned_relay(options, controller)
    console = output_console()
    _show_relay(console, bounds, planned)
    if options.dry_run:
        return DONE
    duration = (planned.request.cycles + 2.0) * planned.period + 2.0 * RAMP
    question = f"Have a relay drive {bounds.joint} for about {duration:.0f} s now"
    if not agreed(question, is_given=options.yes):
        console.print("nothing was moved")
        return FAILED
    with console.status("getting ready") as status:

        def tell(event: str, seconds: float) -> None:
            status.update(f"the relay drives the joint: {seconds:.1f} s, Ctrl-C ends it")

        ending = carry_out_relay(planned, controller, graph, bag, tell)
    console.print(f"recorded: {bag}", soft_wrap=True)
    if ending.reason:
        line = f"the relay has ended: {ending.reason}; the controller holds the joint"
        console.print(line, style="red", soft_wrap=True)
        return INTERRUPTED if ending.is_interrupted else FAILED
    return _propose(console, options, controller, planned, bag)


def _controller(graph: RunningGraph, joint: str | None) -> RunningController:
    if joint is None and len(graph.controllers) > 1:
        known = ", ".join(graph.controllers)
        raise SettingError(f"several joints run: name one with --joint ({known})")
    (controller,) = chosen_controllers(graph, [joint] if joint else [])
    if not graph.has_commands:
        raise SettingError("autotune needs efforts on joint_commands (command_interface)")
    return controller


def _planned_relay(
    options: argparse.Namespace, controller: RunningController
) -> tuple[JointBounds, PlannedRelay]:
    settings = controller.settings
    gains = settings.gains
    if not (gains.p > 0.0 and gains.d > 0.0):
        raise SettingError(f"{controller.node} has no gains.p or no gains.d to hold its joint by")
    if options.inertia is not None and not options.inertia > 0.0:
        raise SettingError(f"--inertia must be positive, not {options.inertia:g}")
    bounds = bounds_of(controller, options.inertia)
    wish = RelayWish(options.effort, options.share, options.amplitude, options.cycles)
    period = settings.timing.control_period
    return bounds, planned_relay(bounds, gains.d / gains.p, period, wish)


def _show_relay(console: Console, bounds: JointBounds, planned: PlannedRelay) -> None:
    request = planned.request
    least, largest = bounds.efforts
    guessed = " (by the gains)" if bounds.is_inertia_guessed else ""
    lines = [
        f"{bounds.joint}: at {bounds.position:.4g} rad, held by {bounds.load:.4g} N m",
        f"relay: +-{request.amplitude:.4g} N m around that, within {least:.4g} and {largest:.4g}",
        f"expected: +-{planned.amplitude:.3g} rad, {planned.velocity:.3g} rad/s, a cycle in "
        f"{planned.period:.3g} s, for an inertia of {bounds.inertia:.3g} kg m^2{guessed}",
        f"ends: after {request.cycles:g} cycles; beyond {request.deviation:.3g} rad; after "
        f"{request.duration:.3g} s",
    ]
    for line in lines:
        console.print(of_slide(line) if bounds.is_slide else line, soft_wrap=True)


def _propose(
    console: Console,
    options: argparse.Namespace,
    controller: RunningController,
    planned: PlannedRelay,
    bag: Path,
) -> int:
    found = relay_findings(bag, controller, planned)
    tuned = autotuned(
        controller.settings,
        found.inertia,
        found.delay,
        options.closed_loop_time,
        options.goal,
        has_velocities=measures_velocity(bag, controller.joint),
    )
    is_slide = controller.limits.is_slide
    for line in [*_findings(found), "", *_proposal(controller, tuned)]:
        console.print(of_slide(line) if is_slide else line, soft_wrap=True)
    if options.output is None:
        console.print("-o FILE writes it")
        return DONE
    if not agreed(f"Write {options.output}", is_given=options.yes):
        console.print("nothing was written")
        return DONE
    _write(options.output, controller, tuned, found, bag)
    console.print(f"written: {options.output}", soft_wrap=True)
    console.print(
        f"nothing was set; this does: ros2 param load {controller.node} {options.output}",
        soft_wrap=True,
    )
    return DONE


def _findings(found: RelayFindings) -> list[str]:
    cycle, low_high = found.cycle, found.inertia
    middle, half = 0.5 * sum(low_high), 0.5 * (low_high[1] - low_high[0])
    lines = [
        f"limit cycle: {cycle.period:.4g} s ({cycle.spread:.1%} spread over {cycle.cycles}), "
        f"+-{cycle.amplitude:.3g} rad, ultimate gain {cycle.ultimate_gain:.4g} N m/rad",
        f"inertia: {middle:.4g} +-{half:.2g} kg m^2; {cycle.inertia:.4g} by the first harmonics, "
        f"{cycle.described_inertia:.4g} by the describing function",
    ]
    for name in (VISCOUS, COULOMB):
        estimate = found.identified.reliable(name)
        if estimate is not None:
            unit = "N m s/rad" if name == VISCOUS else "N m"
            lines.append(f"{name}: {estimate.value:.4g} +-{estimate.half_width:.2g} {unit}")
    if found.is_by_cycle:
        lines.append("the equation of motion does not tell the inertia: the first harmonics do")
    return lines


def _proposal(controller: RunningController, tuned: Autotuned) -> list[str]:
    before, after = controller.settings.gains, tuned.pid.gains
    proposal = tuned.upgrade
    lines = [
        f"SIMC, closed-loop time {tuned.closed_loop_time:.3g} s, delay {tuned.delay:.3g} s:",
        f"  p {after.p:g}  i {after.i:g}  d {after.d:g}   (now p {before.p:g}  i {before.i:g}  "
        f"d {before.d:g})",
    ]
    if proposal.settings.degree == 0.0:
        lines.append(f"  linear: {proposal.reasons.get('mu', 'nothing to gain')}")
    else:
        lines.append(f"  hPID: mu {proposal.settings.mu:+.2f}, {proposal.reasons['mu']}")
    return lines + [f"  {remark}" for remark in proposal.remarks]


def _write(
    path: Path, controller: RunningController, tuned: Autotuned, found: RelayFindings, bag: Path
) -> None:
    """Write one section: ``ros2 param load`` sends a node those of all nodes."""
    header = [
        f"# Gains of {shown(controller.joint)} by a relay test, recorded in {shown(bag.name)}.",
        f"# ros2 param load {controller.node} THIS_FILE sets them while the controller runs.",
        "",
    ]
    section = controller_section(
        controller.node.rpartition("/")[2],
        tuned.upgrade,
        _findings(found),
        is_slide=controller.limits.is_slide,
    )
    write_output(path, "\n".join([*header, *section]) + "\n")
