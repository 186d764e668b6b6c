"""``hpid gains``: gains of a published rule for every joint, with margins and certificate."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace

from hpid_ros.base.console import TextConsole
from hpid_ros.base.errors import SettingError
from hpid_ros.base.units import of_slide
from hpid_ros.cli.commands import DONE, FAILED
from hpid_ros.cli.options import first_homogeneous, joint_progress, named_experiment
from hpid_ros.control.homogeneous_pid import Gains
from hpid_ros.control.settings import LoopSettings
from hpid_ros.experiment.description import initial_inertias
from hpid_ros.tuning.gain_design import design, held_by_friction, yaml_text


def run(options: argparse.Namespace) -> int:
    """Compute the gains and print them."""
    inertias: Mapping[str, float]
    frictions: Mapping[str, float] = {}
    slides = frozenset[str]()
    if options.inertia is not None:
        if options.experiment:
            raise SettingError("--inertia is of one joint without a robot: name no FILE with it")
        loops: dict[str, LoopSettings] = {"joint": LoopSettings("joint", Gains(0.0, 0.0, 0.0))}
        inertias = {"joint": options.inertia}
    else:
        experiment = named_experiment(options.experiment)
        loops = {each.joint: each for each in first_homogeneous(experiment)}
        inertias = initial_inertias(experiment, tuple(loops.values()))
        slides, frictions = experiment.slides, experiment.frictions
    with joint_progress(TextConsole(stderr=True), "certified", len(loops)) as progress:
        designs = design(
            loops, inertias, options.rule, options.closed_loop_time, options.delay, progress
        )
    designs |= {
        joint: replace(each, reason=of_slide(each.reason))
        for joint, each in designs.items()
        if joint in slides
    }
    head = f"{options.rule}, closed-loop time {options.closed_loop_time:g} s"
    head += f", delay {options.delay:g} s" if options.delay else ""
    print(yaml_text(designs, head), end="")
    errors = TextConsole(stderr=True)
    for joint, friction in frictions.items():
        line = held_by_friction(joint, designs[joint].gains.p, friction)
        if line:
            line = of_slide(line) if joint in slides else line
            print(f"# {line}")
            errors.print(line, soft_wrap=True)
    return FAILED if any(each.reason for each in designs.values()) else DONE
