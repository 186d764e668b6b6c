"""``hpid robot``: what a robot's description says, and what it does not."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

from rich import box

from hpid_bench.cli.commands import DONE, FAILED
from hpid_bench.cli.options import load_robot, write_output
from hpid_bench.cli.terminal import output_console
from hpid_bench.report.table import WideTable
from hpid_ros.base.files import refuse_output
from hpid_ros.robot.amendments import amended, review
from hpid_ros.robot.description import GivenRobot, listed
from hpid_ros.robot.dynamics import Dynamics

_COLUMNS = ("range", "effort", "velocity", "damping", "friction", "Jr N²", "inertia", "gravity")
_CAPTION = (
    "SI units. Jr N²: rotor inertia as the joint feels it. Inertia: 1 / (M⁻¹)ⱼⱼ on a fixed base "
    "in the initial pose, and over the joints' ranges. Gravity: effort that holds the initial "
    "pose."
)
_OF_SLIDES = "m and m/s, N, N s/m and kg, where joints that turn have rad, N m, kg m²"
_UNSAFE = "Add the limits before a robot is driven by it: its controllers do not start without."
_SHOWN = 3  # names in a remark


def run(options: argparse.Namespace) -> int:
    if options.save:
        inputs = [Path(options.file)]
        refuse_output(options.save, force=options.force, inputs=inputs, option="--save")
    robot = load_robot(options.file)
    facts = _facts(robot, options.poses)
    remarks = review(robot.description)
    is_unsafe = any(each.is_unsafe for each in remarks)
    if options.json:
        texts = [{"names": each.names, "text": each.text} for each in remarks]
        document = {
            "robot": robot.description.name,
            "joints": facts,
            "held": dict(robot.description.held),
            "remarks": texts,
        }
        print(json.dumps(document, indent=2))
    else:
        console = output_console()
        console.print(_table(robot.description.name, facts))
        console.print(_CAPTION, style="dim")
        slides = tuple(joint.name for joint in robot.description.joints.values() if joint.is_slide)
        if slides:
            verb = "slides" if len(slides) == 1 else "slide"
            console.print(f"{listed(slides, _SHOWN)} {verb}: {_OF_SLIDES}", soft_wrap=True)
        driven = robot.description.joints if robot.driven is None else robot.driven
        if undriven := robot.description.undriven(driven):
            console.print(undriven, soft_wrap=True)
        for each in remarks:
            console.print(
                f"{listed(each.names, _SHOWN)}: {each.text}",
                style="yellow" if each.is_unsafe else "",
                soft_wrap=True,
            )
        if is_unsafe:
            console.print(_UNSAFE, style="yellow", soft_wrap=True)
    if options.save:
        # With nothing to amend, only its meshes are named so that they are found from there.
        write_output(options.save, amended(robot.description, {}, {}, {}).xml)
    return FAILED if is_unsafe else DONE


def _facts(robot: GivenRobot, poses: int) -> dict[str, dict[str, Any]]:
    """Return what is known of each joint; None is unlimited."""
    joints = robot.description.joints
    dynamics = Dynamics(robot.description)
    start = robot.initial_positions
    inertias = dynamics.inertia_range(joints, poses, 1, start)
    gravity = dynamics.gravity_torques(joints, start)
    return {
        name: {
            "type": joint.type,
            "lower": _finite(joint.lower),
            "upper": _finite(joint.upper),
            "effort": _finite(joint.effort),
            "velocity": _finite(joint.velocity),
            "damping": joint.damping,
            "friction": joint.friction,
            "reflected_inertia": joint.reflected_inertia,
            "inertia": inertias[name].nominal,
            "least_inertia": inertias[name].minimum,
            "largest_inertia": inertias[name].maximum,
            "gravity": gravity[name],
        }
        for name, joint in joints.items()
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _table(name: str, facts: dict[str, dict[str, Any]]) -> WideTable:

    rows = [
        (
            joint,
            f"{_number(fact['lower'])} … {_number(fact['upper'])}",
            *(_number(fact[key]) for key in ("effort", "velocity", "damping", "friction")),
            _number(fact["reflected_inertia"]),
            f"{_number(fact['inertia'])} ({_number(fact['least_inertia'])} … "
            f"{_number(fact['largest_inertia'])})",
            f"{fact['gravity']:.2f}",
        )
        for joint, fact in facts.items()
    ]
    return WideTable.of_rows(("joint", *_COLUMNS), rows, title=name, box=box.SIMPLE_HEAD)


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.3g}"
