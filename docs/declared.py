"""Tables of the site, from where the package, its experiments and benchmarks have the values."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import Any

from hpid_bench.cli.main import SUBCOMMANDS
from hpid_ros.base.records import ParameterSpec
from hpid_ros.base.schema import table
from hpid_ros.control.settings import LOOP_PARAMETERS, MODEL_PARAMETERS
from hpid_ros.motion.references import BrickTask, Oscillations, PathSection, Waypoints
from hpid_ros.nodes.parts.goals import FIXED_PARAMETERS, GOAL_PARAMETERS, joint_parameters
from hpid_ros.robot.amendments import RobotSection
from hpid_ros.simulation.drives import DriveSettings
from hpid_ros.simulation.settings import Disturbances, Sensor, Workplace
from hpid_ros.simulation.world_file import ControlSection, MeasuredSection, PhysicsSection

ROOT = Path(__file__).parents[1]
MEASURED = ROOT / "benchmarks" / "results" / "amd_epyc_2_cores.json"
Row = tuple[str, ...]


def parameters(*specs: ParameterSpec) -> Iterator[Row]:
    """Yield the rows of a node's parameters."""
    for spec in specs:
        default = (
            f"{spec.default:g}"
            if type(spec.default) is float
            else str(spec.default).lower() or "(empty)"
        )
        if isinstance(spec.default, float):
            allowed = f"{spec.minimum:g} to {spec.maximum:g}".replace(" to inf", " and more")
        elif isinstance(spec.default, bool):
            allowed = "true, false"
        else:
            allowed = ", ".join(spec.choices) or "a text"
        yield spec.name, default, allowed, spec.description


def keys(*sections: tuple[Any, str]) -> Iterator[Row]:
    """Yield the rows of sections of an experiment file."""
    for kind, prefix in sections:
        yield from map(tuple, table(kind, prefix))


def commands() -> Iterator[Row]:
    """Yield the rows of the subcommands of hpid."""
    for name, text in SUBCOMMANDS.items():
        yield f"hpid {name}", text


def experiments() -> Iterator[Row]:
    """Yield what the head of each experiment file says of it."""
    for path in sorted((ROOT / "config" / "experiments").glob("*.yaml")):
        head = takewhile(lambda line: line.startswith("#"), path.read_text().splitlines())
        yield path.stem, " ".join(line.lstrip("# ") for line in head)


def benchmarks() -> Iterator[Row]:
    """Yield the figures of ``make bench``."""
    for name, each in json.loads(MEASURED.read_text())["figures"].items():
        least, most = each["spread"]["ratio"]
        reference = f"{each['reference']:.4g}, {each['against']}"
        spread = f" ({least:.3g} to {most:.3g})" if least < most else ""
        missed = "" if each["met"] in (True, None) else ", **missed**"
        yield (
            name,
            f"{each['ours']:.4g}",
            reference,
            each["unit"],
            f"{each['ratio']:.3g}{spread}",
            (", ".join(each["target"]) or "none") + missed,
        )


HEADS = {
    "commands": "command | meaning",
    "experiments": "experiment | what it is",
    "benchmarks": "figure | ours | reference | unit | ratio (lowest to highest) | target",
}
TABLES: dict[str, Callable[[], Iterable[Row]]] = {
    "commands": commands,
    "experiments": experiments,
    "benchmarks": benchmarks,
    "loop": partial(parameters, *LOOP_PARAMETERS.values()),
    "model": partial(parameters, *MODEL_PARAMETERS.values()),
    "goals": partial(parameters, *GOAL_PARAMETERS.values(), *joint_parameters("JOINT").values()),
    "goals-fixed": partial(parameters, *FIXED_PARAMETERS.values()),
    "robot": partial(keys, (RobotSection, "robot.")),
    "control": partial(keys, (ControlSection, "control."), (PhysicsSection, "simulation.")),
    "sensors": partial(keys, (Sensor, "sensors."), (MeasuredSection, "sensors.")),
    "actuators": partial(keys, (DriveSettings, "actuators.")),
    "disturbances": partial(keys, (Disturbances, "disturbances.")),
    "scene": partial(keys, (Workplace, "scene.")),
    "waypoints": partial(keys, (Waypoints, "reference.")),
    "sine": partial(keys, (Oscillations, "reference.")),
    "base_path": partial(keys, (PathSection, "reference.")),
    "bricks": partial(keys, (BrickTask, "reference.")),
}


def markdown(name: str) -> list[str]:
    """Return the lines of a table."""
    rows = [f"| `{key}` | {' | '.join(rest)} |" for key, *rest in TABLES[name]()]
    heads = HEADS.get(name, "name | default | allowed | meaning")
    return [f"| {heads} |", "|---" * len(heads.split("|")) + "|", *rows]
