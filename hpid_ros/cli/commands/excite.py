"""``hpid excite``: a safe motion of running joints that tells what they are, recorded."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from hpid_ros.base.files import refuse_output
from hpid_ros.cli.commands import DONE, FAILED, INTERRUPTED
from hpid_ros.cli.options import inertias_from, write_output
from hpid_ros.cli.terminal import agreed, new_bag, output_console
from hpid_ros.live.controllers import Controller
from hpid_ros.live.graph_client import running_graph
from hpid_ros.live.motion import Tell, bounds_of, carry_out, chosen
from hpid_ros.motion.excitation import Design, ExcitationPlan, Wish, plan
from hpid_ros.report.figures import require_picture
from hpid_ros.report.table import TableColumn, WideTable
from hpid_ros.tuning.identification_report import excitation_figure


def run(options: argparse.Namespace) -> int:
    """Plan, show, ask, excite."""
    if options.plot is not None:
        require_picture(options.plot)
        refuse_output(options.plot, force=options.force, inputs=(), option="--plot")
    bag = new_bag(options.output, "excitation", "-o", is_dry=options.dry_run)
    graph = running_graph(options.states, options.namespace)
    controllers = chosen(graph, options.joint)
    planned = _plan(options, controllers)
    console = output_console()
    _show(console, planned, are_together=options.together)
    if options.plot is not None:
        from hpid_ros.report.plots import render

        form = options.plot.suffix.lower()[1:]
        write_output(options.plot, render(excitation_figure(planned), form))
        console.print(f"written: {options.plot}", soft_wrap=True)
    if options.dry_run:
        return DONE
    count = len(planned.joints)
    noun = planned.names[0] if count == 1 else f"{count} joints"
    if not agreed(f"Move {noun} for {planned.duration:.0f} s now", is_given=options.yes):
        console.print("nothing was moved")
        return FAILED
    with _progress(console, planned) as tell:
        ending = carry_out(planned, controllers, graph, bag, options.states, tell)
    if ending.reason:
        console.print(f"stopped: {ending.reason}", style="red", soft_wrap=True)
        if ending.is_at_rest:
            console.print("the joints are at rest; controllers that run hold them")
        else:
            console.print("nobody has seen the joints come to rest", style="red")
    console.print(f"recorded: {bag}", soft_wrap=True)
    if ending.is_interrupted or ending.reason:
        return INTERRUPTED if ending.is_interrupted else FAILED
    urdf = options.urdf or ("MY.urdf" if count > 1 else "")
    console.print(f"next: hpid identify {bag}{f' --urdf {urdf}' if urdf else ''}", soft_wrap=True)
    if count > 1 and not options.together and not options.urdf:
        console.print(f"or, without a URDF: hpid identify {bag}", soft_wrap=True)
    return DONE


def _plan(options: argparse.Namespace, controllers: Sequence[Controller]) -> ExcitationPlan:
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
def _progress(console: Console, planned: ExcitationPlan) -> Iterator[Tell]:
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
