"""``hpid gains``: gains of a published rule for every joint, with margins and certificate."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from hpid_ros.base.errors import SettingError
from hpid_ros.base.units import of_slide
from hpid_ros.cli.commands import DONE, FAILED
from hpid_ros.cli.options import add_experiment, first_homogeneous, named_experiment

if TYPE_CHECKING:
    from hpid_ros.control.settings import LoopSettings


_RULES = ("simc", "pole-placement")


def add(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "gains",
        description="Compute every joint's gains by a published rule on its effective inertia, "
        "and print them as a part of an experiment file, with robustness margins and certified "
        "degrees beside them. simc: S. Skogestad, J. Process Control 13 (2003), for a double "
        "integrating process. pole-placement: three poles in one place.",
        epilog="Inertias are 1 / (M^-1)_jj in the experiment's initial pose; a wheel's is that "
        "of the robot that rolls on it, where the experiment says robot.base. Velocity filter, "
        "norm and degree are those of the experiment's first homogeneous controller. Exit code 0 "
        "only if every joint is certified.",
    )
    add_experiment(parser)
    parser.add_argument(
        "--inertia", type=float, metavar="M", help="of one joint without a robot [kg m^2]"
    )
    parser.add_argument("--rule", choices=_RULES, required=True)
    parser.add_argument(
        "--closed-loop-time",
        type=float,
        required=True,
        metavar="T",
        help="tau_c, time constant of the closed loop [s]",
    )
    parser.add_argument(
        "--delay", type=float, default=0.0, metavar="D", help="of the loop [s] (0)"
    )
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Compute the gains and print them."""
    from hpid_ros.base.console import TextConsole
    from hpid_ros.cli.options import joint_progress
    from hpid_ros.control.homogeneous_pid import Gains
    from hpid_ros.control.settings import LoopSettings
    from hpid_ros.experiment.description import initial_inertias
    from hpid_ros.tuning.gain_design import design, held_by_friction, yaml_text

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
            errors.print(line, soft_wrap=True, highlight=False, markup=False)
    return FAILED if any(each.reason for each in designs.values()) else DONE
