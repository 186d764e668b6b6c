"""An experiment file, checked as a whole before anything starts."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from hpid_ros.control import LOOP_PARAMETERS, LoopSettings
from hpid_ros.errors import ExperimentError, HpidError, unknown_name
from hpid_ros.experiment.world_models import (
    Layers,
    disturbances_from,
    drives_from,
    homing_from,
    noise_from,
)
from hpid_ros.resources import find_resource
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.joints import JointDescription
from hpid_ros.sections import Section
from hpid_ros.simulation.settings import VELOCITIES, WorldSettings
from hpid_ros.trajectory import JointTrajectory, reference_from
from hpid_ros.yaml_files import load_yaml

_NANOSECONDS = 1_000_000_000
_FULL_TURN = 6.283185307179586  # [rad]


@dataclass(frozen=True)
class Experiment:
    """One robot, one reference, and the controllers to compare on them.

    Attributes:
        name: Name of the experiment.
        text: The file as it stands.
        path: Where it stands.
        duration: Stamp of the last state in [s].
        seed: Seed of everything that is drawn by chance.
        answer_timeout: Wall time that lock-step waits for one answer in [s].
        world: The simulated robot.
        trajectory: The reference of every joint.
        controllers: For each label, in the order of the comparison, the settings of each
            driven joint, in the world's order.
    """

    name: str
    text: str
    path: Path
    duration: float
    seed: int
    answer_timeout: float
    world: WorldSettings
    trajectory: JointTrajectory
    controllers: Mapping[str, tuple[LoopSettings, ...]]

    @property
    def periods(self) -> int:
        """Control periods of the run; it has one state more."""
        return round(self.duration * _NANOSECONDS / self.world.control_period_ns)

    @property
    def digest(self) -> str:
        """SHA-256 of the file and of the robot's description, as hexadecimal."""
        digest = hashlib.sha256(self.text.encode())
        digest.update(RobotDescription.load(self.world.robot_description).xml.encode())
        return digest.hexdigest()


def load_experiment(path: str | Path) -> Experiment:
    """Read an experiment file.

    Args:
        path: The file.

    Raises:
        ExperimentError: Something is missing, unknown or impossible; the line names the file
            and the place in it.
    """
    file = Path(path)
    document = load_yaml(file, ExperimentError)
    try:
        root = Section(document, "", ExperimentError)
        experiment = _experiment(file, root)
        root.finish()
    except HpidError as error:
        raise ExperimentError(f"{file}: {error}") from None
    return experiment


def _experiment(file: Path, root: Section) -> Experiment:
    control = root.section("control", {})
    rate = control.number("rate", 1000.0, least=0.1, most=1e5)
    period_ns = round(_NANOSECONDS / rate)
    answer_timeout = control.number("answer_timeout", 2.0, above=0.0, most=3600.0)
    control.finish()
    seed = root.whole("seed", 0, least=0)
    trajectory = reference_from(root.take("reference"))
    duration = root.number("duration", above=0.0, most=1e5)
    world = _world(file, root, trajectory.joint_names, period_ns, seed)
    world = replace(world, disturbances=disturbances_from(root, duration))
    known = RobotDescription.load(world.robot_description)
    for link in world.links:
        known.link(link)
    if round(duration * _NANOSECONDS) % period_ns:
        raise ExperimentError(f"duration {duration} s is not a whole number of control periods")
    return Experiment(
        name=root.text("name"),
        text=file.read_text(encoding="utf-8"),
        path=file.resolve(),
        duration=duration,
        seed=seed,
        answer_timeout=answer_timeout,
        world=world,
        trajectory=trajectory,
        controllers=_controllers(root, world),
    )


def _world(
    file: Path, root: Section, joints: tuple[str, ...], period_ns: int, seed: int
) -> WorldSettings:
    robot = root.section("robot")
    description = find_resource(robot.text("description"), beside=file.resolve().parent)
    known = RobotDescription.load(description)
    known.select(joints)
    positions = robot.section("initial_positions", {})
    sensors = root.section("sensors", {})
    layers = Layers(sensors, joints)
    physics = root.section("simulation", {})
    world = WorldSettings(
        robot_description=str(description),
        joints=joints,
        control_period_ns=period_ns,
        physics_steps=physics.whole("physics_steps", 4, least=1, most=1000),
        initial_positions={joint: positions.number(joint) for joint in positions.items()},
        encoder_counts=_counts(sensors, joints),
        seed=seed,
        fixed_base=robot.flag("fixed_base", False),
        payload_mass=robot.number("payload", 0.0, least=0.0),
        drives=drives_from(root, joints),
        position_noise=noise_from(sensors, joints),
        homing=homing_from(layers, joints),
        velocity=_velocity(sensors),
    )
    world.start(known)
    for section in (robot, positions, layers, physics):
        section.finish()
    return world


def _counts(sensors: Section, joints: tuple[str, ...]) -> int | tuple[int, ...]:
    """Return the encoders' counts: one number for all, or one for each joint by name."""
    if not isinstance(sensors.take("encoder_counts", 0), Mapping):
        return sensors.whole("encoder_counts", 0, least=0)
    counts = sensors.section("encoder_counts")
    along = tuple(counts.whole(joint, least=0) for joint in joints)
    counts.finish()
    return along


def _velocity(sensors: Section) -> str:
    source = sensors.text("velocity", "none")
    if source not in VELOCITIES:
        raise ExperimentError(f"{sensors.where}: {unknown_name('velocity', source, VELOCITIES)}")
    return source


def _controllers(root: Section, world: WorldSettings) -> dict[str, tuple[LoopSettings, ...]]:
    controllers = root.section("controllers")
    common = _parameters(controllers, "common")
    each = controllers.section("joints", {})
    own = {joint: _parameters(each, joint) for joint in each.items()}
    controllers.finish()
    for joint in own:
        if joint not in world.joints:
            raise ExperimentError(f"{each.where}: {unknown_name('joint', joint, world.joints)}")
    compared = root.section("compare")
    labels = compared.items()
    if not labels:
        raise ExperimentError("compare must name at least one controller")
    joints = RobotDescription.load(world.robot_description).select(world.joints)
    result = {}
    for label in labels:
        changes = _parameters(compared, label)
        result[label] = tuple(
            _settings(label, joint, counts, world, [common, own.get(joint.name, {}), changes])
            for joint, counts in zip(joints, world.counts, strict=True)
        )
    return result


def _parameters(section: Section, key: str) -> dict[str, object]:
    """Return a section of loop parameters, nested or dotted, by dotted name."""
    flat: dict[str, object] = {}
    inner = section.section(key, {})
    for name, value in inner.items().items():
        nested = value.items() if isinstance(value, Mapping) else [(None, value)]
        for rest, entry in nested:
            dotted = name if rest is None else f"{name}.{rest}"
            if dotted not in LOOP_PARAMETERS or dotted == "joint":
                place = inner.place(dotted)
                known = [inner.place(p) for p in LOOP_PARAMETERS if p != "joint"]
                raise ExperimentError(unknown_name("key", place, known))
            flat[dotted] = entry
    return flat


def _settings(
    label: str,
    joint: JointDescription,
    counts: int,
    world: WorldSettings,
    layers: list[dict[str, object]],
) -> LoopSettings:
    """Return one joint's settings; later layers win, and the robot gives the defaults."""
    values: dict[str, object] = {
        "joint": joint.name,
        "control_period": world.control_period_ns / _NANOSECONDS,
        "encoder_resolution": _FULL_TURN / counts if counts else 0.0,
    }
    if joint.effort < LOOP_PARAMETERS["u_clamp_max"].maximum:
        values |= {"u_clamp_max": joint.effort, "u_clamp_min": -joint.effort}
    for layer in layers:
        values.update(layer)
    try:
        return LoopSettings.from_parameters(values)
    except HpidError as error:
        raise ExperimentError(f"controller {label!r}, joint {joint.name!r}: {error}") from None
