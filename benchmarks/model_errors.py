"""The cost of a wrong model: ``python -m benchmarks.model_errors [EXPERIMENT]``.

Runs an experiment's controllers in process on robots that their models do not know: with a payload
of 0, 1 and 2 kg, with all masses of the model 20 % too small or too large, and with the mass of
each link wrong by up to 20 % at random. Prints a table of totals in Markdown.
"""

from __future__ import annotations

import argparse
import random
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

from hpid_bench.experiment.batch import (
    LAST_ERROR,
    RunTask,
    WorldKeeper,
    simulated,
)
from hpid_bench.experiment.description import Experiment, load_experiment
from hpid_ros.base.resources import share_folder
from hpid_ros.control import LoopSettings
from hpid_ros.metrics.quantities import PAPER
from hpid_ros.robot.description import RobotDescription

MASS_ERROR = 0.2
PAYLOADS = (0.0, 1.0, 2.0)  # [kg]
SEEDS = (1, 2, 3)
_MOMENTS = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")


class Case(NamedTuple):
    """One way in which the robot and its model differ."""

    name: str  # in a few words
    payload: float = 0.0  # of the robot in [kg]; the model has none
    mass_scale: float = 1.0  # of the model
    description: str = ""  # URDF of the model; empty for the robot's


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.model_errors", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    default = share_folder() / "config" / "experiments" / "decoupling.yaml"
    parser.add_argument("experiment", nargs="?", type=Path, default=default, metavar="EXPERIMENT")
    parser.add_argument("--duration", type=float, help="of each run [s], if not the experiment's")
    options = parser.parse_args(arguments)
    experiment = load_experiment(options.experiment)
    if options.duration:
        experiment = replace(experiment, duration=options.duration)
    print("| robot and model | controller | IVC | IAVC | ITAE | L2 u | L2 e | last error |")
    print("|---|---|---|---|---|---|---|---|")
    for case in cases(experiment):
        with WorldKeeper() as keeper:
            for label in experiment.controllers:
                if case.payload == 0.0 and case.name and _knows_no_model(experiment, label):
                    continue  # it runs as in the first case
                print(_row(case, label, task(experiment, label, case), keeper), flush=True)
    return 0


def cases(experiment: Experiment) -> Iterator[Case]:
    """Yield every way in which robot and model differ; the first is not at all."""
    xml = RobotDescription.load(experiment.world.robot_description).xml
    yield Case("")
    for payload in PAYLOADS[1:]:
        yield Case(f"payload of {payload:g} kg unknown", payload)
    for scale in (1.0 - MASS_ERROR, 1.0 + MASS_ERROR):
        yield Case(f"all masses of the model x {scale:g}", mass_scale=scale)
    for seed in SEEDS:
        name = f"each link's mass +-{MASS_ERROR:.0%}, draw {seed}"
        yield Case(name, description=with_wrong_masses(xml, seed))


def with_wrong_masses(xml: str, seed: int) -> str:
    """Return a robot whose links' masses and inertias are wrong, each by a factor of its own."""
    root = ElementTree.fromstring(xml)
    chance = random.Random(seed)
    for inertial in root.iter("inertial"):
        factor = chance.uniform(1.0 - MASS_ERROR, 1.0 + MASS_ERROR)
        for tag, names in (("mass", ("value",)), ("inertia", _MOMENTS)):
            element = inertial.find(tag)
            if element is not None:
                for name in names:
                    element.set(name, repr(factor * float(element.get(name, "0"))))
    return ElementTree.tostring(root, encoding="unicode")


def task(experiment: Experiment, label: str, case: Case) -> RunTask:
    """Return the run of one controller in one case."""
    whole = RunTask.of(experiment, label)
    return replace(
        whole,
        world=replace(whole.world, payload_mass=case.payload),
        loops=tuple(_wrong(each, case) for each in whole.loops),
    )


def _wrong(settings: LoopSettings, case: Case) -> LoopSettings:
    if not settings.model.is_on:
        return settings
    model = replace(settings.model, mass_scale=case.mass_scale, description=case.description)
    return replace(settings, model=model)


def _knows_no_model(experiment: Experiment, label: str) -> bool:
    return not any(each.model.is_on for each in experiment.controllers[label])


def _row(case: Case, label: str, of: RunTask, keeper: WorldKeeper) -> str:
    record = simulated(of, keeper)
    digits = dict(zip((*PAPER, LAST_ERROR), (0, 2, 4, 3, 4, 5), strict=True))
    numbers = [f"{record.value(quantity):.{each}f}" for quantity, each in digits.items()]
    return f"| {case.name or 'as the model says'} | {label} | " + " | ".join(numbers) + " |"


if __name__ == "__main__":
    sys.exit(main())
