"""The simulated world as a file says it: the sections of an experiment that are of the world."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from hpid_ros.base.errors import ExperimentError, HpidError, SettingError
from hpid_ros.base.records import Record, Section, quantity, take_layered, take_record
from hpid_ros.base.schema import json_schema, layered_schema
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.base.yaml_files import Document
from hpid_ros.motion.references import PlannedReference, planned_reference
from hpid_ros.robot.amendments import RobotSection
from hpid_ros.robot.description import RobotDescription, robot_source
from hpid_ros.simulation.drives import DriveSettings
from hpid_ros.simulation.settings import (
    ENGINES,
    VELOCITIES,
    Disturbances,
    GripCommand,
    Sensor,
    Workplace,
    WorldSettings,
    default_engine,
)

WORLD_SECTIONS = (
    "robot",
    "control",
    "simulation",
    "seed",
    "sensors",
    "actuators",
    "disturbances",
    "scene",
)
"""Keys of a file that describe its world."""
_OF_EXPERIMENTS = ("name", "duration", "reference", "controllers", "compare", "judge")
"""Keys of an experiment that are not of its world."""
_BY_JOINT = ("encoder_counts", "noise")
_SAME_PERIOD = 1e-7  # of a period: a moment that near to its beginning is that


@dataclass(frozen=True)
class ControlSection(Record):
    """How often the robot is controlled."""

    rate: float = quantity(
        "States, and commands, per second", "Hz", default=1000.0, least=0.1, most=1e5
    )
    answer_timeout: float = quantity(
        "Wall time that lock-step waits for an answer", "s", default=2.0, above=0.0, most=3600.0
    )


@dataclass(frozen=True)
class PhysicsSection(Record):
    """How the physics are computed."""

    engine: str | None = quantity(
        "Who computes the physics; PyBullet where it is installed, else MuJoCo, if left out",
        default=None,
        choices=ENGINES,
    )
    physics_steps: int = quantity(
        "Physics steps in one control period", default=4, least=1, most=1000
    )


@dataclass(frozen=True)
class MeasuredSection(Record):
    """What is measured of all joints alike."""

    velocity: str = quantity(
        "Velocities in joint_states: none, or differences of the measured positions",
        default="none",
        choices=VELOCITIES,
    )


class WorldFile(NamedTuple):
    """What a file says of its world."""

    world: WorldSettings  # the simulated robot
    control: ControlSection  # how often it is controlled
    reference: PlannedReference | None  # what its joints follow, and the plan behind it
    description: RobotDescription  # its robot, with all that the file knows better


def read_world(root: Section, folders: Sequence[Path]) -> WorldFile:
    """Return the world that a file describes; other sections stay for the caller."""
    control = _whole(ControlSection, root.section("control", {}))
    physics = _whole(PhysicsSection, root.section("simulation", {}))
    seed = root.whole("seed", 0, least=0)
    robot = _whole(RobotSection, root.section("robot"))
    known = robot.load(lambda name: _load(name, folders))
    reference = _reference(root, known)
    joints = _driven(robot, known, reference)
    sensors, velocity = _sensors(root.section("sensors", {}), joints)
    counts = tuple(each.encoder_counts for each in sensors)
    noises = tuple(each.noise for each in sensors)
    homing = tuple(each.homing for each in sensors)
    period_ns = round(NANOSECONDS / control.rate)
    events = _whole(Disturbances, root.section("disturbances", {}))
    workplace = _workplace(root.section("scene", {}), reference)

    def on_period(event: Any, key: str = "time") -> Any:
        """Move an event that is meant for a period's beginning there: to whole nanoseconds."""
        asked = getattr(event, key) * control.rate
        period = round(asked)
        is_on_one = abs(asked - period) < _SAME_PERIOD
        return replace(event, **{key: period * period_ns / NANOSECONDS}) if is_on_one else event

    world = WorldSettings(
        robot_description=_description(robot, known, folders),
        joints=joints,
        control_period_ns=period_ns,
        engine=physics.engine or default_engine(),
        physics_steps=physics.physics_steps,
        initial_positions=robot.initial_positions,
        encoder_counts=counts[0] if len(set(counts)) == 1 else counts,
        seed=seed,
        fixed_base=robot.fixed_base,
        payload_mass=robot.payload,
        drives=_drives(root.section("actuators", {}), joints),
        position_noise=noises[0] if len(set(noises)) == 1 else noises,
        homing=homing if any(homing) else (),
        velocity=velocity,
        disturbances=replace(
            events,
            payload=tuple(map(on_period, events.payload)),
            wrenches=tuple(on_period(each, "start") for each in events.wrenches),
        ),
        workplace=replace(workplace, grips=tuple(map(on_period, workplace.grips))),
        base=_base(robot, known),
    )
    try:
        world.start(known)
    except HpidError as error:
        raise ExperimentError(f"robot.{error}") from None
    for link in world.links:
        known.link(link)
    # Whatever is planned and designed for the start begins where the simulation does.
    world = replace(world, initial_positions=known.start(robot.initial_positions))
    return WorldFile(world, control, reference, known)


def world_of(values: Any, document: Document | None) -> WorldFile:
    """Return the world of a whole document; what is an experiment's in it is passed over."""
    with nullcontext() if document is None else document.blaming(SettingError):
        root = Section(values, "", SettingError)
        for key in _OF_EXPERIMENTS:
            root.take(key, None)
        found = read_world(root, () if document is None else document.folders)
        root.finish()
    return found


def world_schema() -> dict[str, Any]:
    """Return the JSON Schema of each section that is of the world, by key."""
    sensors = layered_schema(Sensor)
    properties = sensors["properties"] | json_schema(MeasuredSection)["properties"]
    for key in _BY_JOINT:
        one = {name: value for name, value in properties[key].items() if name != "description"}
        properties[key] = {
            "anyOf": [one, {"type": "object", "additionalProperties": one}],
            "description": f"{properties[key]['description']}; for all, or by joint",
        }
    return {
        "robot": json_schema(RobotSection),
        "control": json_schema(ControlSection),
        "simulation": json_schema(PhysicsSection),
        "seed": {
            "type": "integer",
            "minimum": 0,
            "default": 0,
            "description": "Of everything that is drawn by chance",
        },
        "sensors": sensors | {"properties": properties},
        "actuators": layered_schema(DriveSettings),
        "disturbances": json_schema(Disturbances),
        "scene": json_schema(Workplace),
    }


def _whole(kind: type[Any], section: Section) -> Any:
    record = take_record(kind, section)
    section.finish()
    return record


def _load(source: str, folders: Sequence[Path]) -> RobotDescription:
    return RobotDescription.load(robot_source(source, folders))


def _description(robot: RobotSection, known: RobotDescription, folders: Sequence[Path]) -> str:
    is_plain = not (robot.joints or robot.links or robot.held or known.mends)
    return str(robot_source(robot.description, folders)) if is_plain else known.xml


def _reference(root: Section, known: RobotDescription) -> PlannedReference | None:
    if "reference" not in root:
        return None
    root.take("reference")
    return planned_reference(root.values, "reference", lambda section: known)


def _driven(
    robot: RobotSection, known: RobotDescription, reference: PlannedReference | None
) -> tuple[str, ...]:
    followed = () if reference is None else reference.trajectory.joint_names
    joints = robot.driven or followed or tuple(known.joints)
    if followed and set(joints) != set(followed):
        others = ", ".join(sorted(set(joints) ^ set(followed)))
        raise ExperimentError(
            f"robot.driven must name the joints of the reference: {others} is in one alone"
        )
    known.select(joints)
    return tuple(joints)


def _base(robot: RobotSection, known: RobotDescription) -> Any:
    try:
        return None if robot.base is None else robot.base.drive(known)
    except HpidError as error:
        raise ExperimentError(f"robot.base: {error}") from None


def _drives(section: Section, joints: Sequence[str]) -> tuple[DriveSettings, ...]:
    drives = take_layered(DriveSettings, section, joints)
    section.finish()
    return () if all(drive.is_ideal for drive in drives) else drives


def _sensors(section: Section, joints: Sequence[str]) -> tuple[tuple[Sensor, ...], str]:
    """Return the sensor of each joint, and where velocities come from."""
    values = section.items()
    own = section.section("joints", {})
    layers = {joint: own.section(joint).items() for joint in own.items()}
    for key in _BY_JOINT:
        if not isinstance(values.get(key), Mapping):
            continue
        by_name = section.section(key)
        del values[key]
        for joint in joints:
            layers[joint] = {key: by_name.take(joint), **layers.get(joint, {})}
        by_name.finish()
    layered = Section(values | {"joints": layers}, section.where, section.error)
    sensors = take_layered(Sensor, layered, joints)
    velocity = take_record(MeasuredSection, layered).velocity
    layered.finish()
    return sensors, velocity


def _workplace(section: Section, reference: PlannedReference | None) -> Workplace:
    if reference is None or reference.plan is None:
        return _whole(Workplace, section)
    if "grips" in section:
        raise section.error(f"{section.place('grips')}: the reference plans them already")
    grips = reference.plan.grips
    schedule = tuple(GripCommand(each.time_ns / NANOSECONDS, each.is_closed) for each in grips)
    workplace = take_record(Workplace, section, {"grips": schedule})
    section.finish()
    return workplace
