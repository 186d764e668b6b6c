"""Tables of parameters and keys for the site, from where the package declares them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any

from hpid_ros.base.records import ParameterSpec
from hpid_ros.base.schema import table
from hpid_ros.cli.main import COMMANDS
from hpid_ros.control.settings import LOOP_PARAMETERS, MODEL_PARAMETERS
from hpid_ros.motion.references import BrickTask, Oscillations, PathSection, Waypoints
from hpid_ros.nodes.parts.goals import FIXED_PARAMETERS, GOAL_PARAMETERS, joint_parameters
from hpid_ros.robot.amendments import RobotSection
from hpid_ros.simulation.drives import DriveSettings
from hpid_ros.simulation.settings import Disturbances, Sensor, Workplace
from hpid_ros.simulation.world_file import ControlSection, MeasuredSection, PhysicsSection

Row = tuple[str, ...]  # name, default, what is allowed, meaning; or name and meaning


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
    for name, command in COMMANDS.items():
        yield f"hpid {name}", command.help


TABLES: dict[str, Callable[[], Iterable[Row]]] = {
    "commands": commands,
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
    heads = "name | meaning" if name == "commands" else "name | default | allowed | meaning"
    return [f"| {heads} |", "|---" * len(heads.split("|")) + "|", *rows]
