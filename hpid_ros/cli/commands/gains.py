"""``hpid gains``: gains of a published rule for every joint, with margins and certificate."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from hpid_ros.base.errors import SettingError
from hpid_ros.cli.commands import DONE, FAILED
from hpid_ros.cli.loops import first_homogeneous
from hpid_ros.cli.options import add_experiment, named_experiment

if TYPE_CHECKING:
    from hpid_ros.control import LoopSettings

_RULES = ("simc", "pole-placement")


def add(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "gains",
        help="compute gains by a published tuning rule",
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
    from hpid_ros.control import Gains, LoopSettings
    from hpid_ros.tuning.gain_design import design, yaml_text

    inertias: Mapping[str, float]
    if options.inertia is not None:
        if options.experiment:
            raise SettingError("--inertia is of one joint without a robot: name no FILE with it")
        loops: dict[str, LoopSettings] = {"joint": LoopSettings("joint", Gains(0.0, 0.0, 0.0))}
        inertias = {"joint": options.inertia}
    else:
        loops, inertias = _of_experiment(options.experiment)
    with joint_progress(TextConsole(stderr=True), "certified", len(loops)) as tell:
        designs = design(
            loops, inertias, options.rule, options.closed_loop_time, options.delay, tell
        )
    head = f"{options.rule}, closed-loop time {options.closed_loop_time:g} s"
    head += f", delay {options.delay:g} s" if options.delay else ""
    print(yaml_text(designs, head), end="")
    return FAILED if any(each.reason for each in designs.values()) else DONE


def _of_experiment(file: str | None) -> tuple[dict[str, LoopSettings], Mapping[str, float]]:
    """Return the loops of an experiment and their inertias, by joint."""
    from hpid_ros.experiment.inertias import initial_inertias

    experiment = named_experiment(file)
    loops = first_homogeneous(experiment)
    return {each.joint: each for each in loops}, initial_inertias(experiment, loops)
