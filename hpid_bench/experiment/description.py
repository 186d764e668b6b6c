"""The experiment file: robot, world, reference, the controllers to compare; its JSON Schema."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from hpid_ros.base.errors import (
    ExperimentError,
    HpidError,
    SettingError,
    TrajectoryError,
    unknown_name,
)
from hpid_ros.base.names import require_label
from hpid_ros.base.records import Section
from hpid_ros.base.resources import find_resource
from hpid_ros.base.schema import field_schema, partial_schema
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.base.yaml_files import EXTENDS, Document, load_document, parse_yaml
from hpid_ros.control.joint_loop import JointLoop
from hpid_ros.control.model import ModelSettings
from hpid_ros.control.settings import LOOP_PARAMETERS, PARAMETERS, LoopSettings
from hpid_ros.motion.bricks import BrickPlan
from hpid_ros.motion.joint_trajectory import JointTrajectory
from hpid_ros.motion.references import planned_reference, task_schema
from hpid_ros.robot.coupling import with_inertia
from hpid_ros.robot.description import RobotDescription, robot_source, robot_xml
from hpid_ros.robot.dynamics import Dynamics, wheel_inertias
from hpid_ros.robot.joint_description import JointDescription
from hpid_ros.simulation.settings import ENGINES, WorldSettings
from hpid_ros.simulation.world_file import WORLD_SECTIONS, read_world, world_schema


def with_robot(
    settings: LoopSettings, world: WorldSettings, description: RobotDescription
) -> LoopSettings:
    """Return settings whose model has what the experiment's robot says.

    A model rolls where the robot does, and holds the joints that are not driven.
    """
    model = settings.model
    if not model.is_on:
        return settings
    if model.description:
        description = RobotDescription.load(robot_source(model.description))
    idle = [name for name in description.joints if name not in world.joints]
    if not model.locked_joints:
        model = replace(model, locked_joints=",".join(idle))
    elif lacking := [name for name in idle if name not in model.locked]:
        raise SettingError(
            f"model.locked_joints lacks {', '.join(lacking)}: what is not driven is in no state"
        )
    if not model.left_wheel:
        model = _rolling(model, world)
    return with_inertia(replace(settings, model=model), str(world.robot_description))


def _rolling(model: ModelSettings, world: WorldSettings) -> ModelSettings:
    base = world.rolling_base
    if base is None or not {base.left, base.right} <= set(world.joints):
        return model
    return replace(
        model,
        left_wheel=base.left,
        right_wheel=base.right,
        wheel_radius=base.radius,
        wheel_separation=base.separation,
    )


_JOINTS = "joints"

ParameterValues = dict[str, object]


class Layer(NamedTuple):
    """Parameters that a section has, by dotted name, and its place."""

    where: str
    values: ParameterValues


_NOTHING = Layer("", {})


def controllers_from(
    root: Section, world: WorldSettings, description: RobotDescription
) -> dict[str, tuple[LoopSettings, ...]]:
    """Return the settings of each driven joint for each controller, by label.

    The robot gives the defaults, ``controllers.common`` is laid over them, then
    ``controllers.joints``, then the controller's own section of ``compare``, then its
    ``joints``.
    """
    controllers = root.section("controllers")
    common = _parameters(controllers, "common")
    own = _by_joint(controllers, world)
    controllers.finish()
    compared = root.section("compare")
    labels = compared.items()
    if not labels:
        raise ExperimentError("compare must name at least one controller")
    for label in labels:
        require_label(label, compared.where, ExperimentError)
    description.require_sound()
    joints = description.select(world.joints)
    result = {}
    for label in labels:
        changes = _parameters(compared, label, but=_JOINTS)
        own_changes = _by_joint(compared.section(label), world)
        loops = []
        for joint, counts in zip(joints, world.counts, strict=True):
            one, change = (each.get(joint.name, _NOTHING) for each in (own, own_changes))
            layers = (common, one, changes, change)
            loops.append(_settings(label, joint, counts, (world, description), layers))
        result[label] = tuple(loops)
    return result


def judged_from(root: Section, joints: tuple[str, ...]) -> tuple[str, ...]:
    """Return the joints that studies and searches look at, in the world's order."""
    judge = root.section("judge", {})
    named = judge.take(_JOINTS, list(joints))
    if not isinstance(named, list) or not named:
        raise ExperimentError(f"{judge.place(_JOINTS)} must be a list of joints, not {named!r}")
    for joint in named:
        if joint not in joints:
            place = judge.place(_JOINTS)
            raise ExperimentError(f"{place}: {unknown_name('joint', joint, joints)}")
    judge.finish()
    return tuple(joint for joint in joints if joint in named)


def _by_joint(section: Section, world: WorldSettings) -> dict[str, Layer]:
    """Return what ``joints`` in a section says of single joints, by joint."""
    each = section.section(_JOINTS, {})
    for joint in each.items():
        if joint not in world.joints:
            raise ExperimentError(f"{each.where}: {unknown_name('joint', joint, world.joints)}")
    return {joint: _parameters(each, joint) for joint in each.items()}


def _parameters(section: Section, key: str, but: str = "") -> Layer:
    """Return a section of loop parameters, nested or dotted, by dotted name, but for one key."""
    inner = section.section(key, {})
    given = flat({name: value for name, value in inner.items().items() if name != but})
    for name in given:
        if name not in PARAMETERS or name == "joint":
            known = [inner.place(each) for each in PARAMETERS if each != "joint"]
            raise ExperimentError(unknown_name("key", inner.place(name), known))
    return Layer(inner.where, given)


def flat(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return parameters that may be nested by their dotted names."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        below = value.items() if isinstance(value, Mapping) else [(None, value)]
        found |= {name if rest is None else f"{name}.{rest}": each for rest, each in below}
    return found


def nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return dotted names as nested mappings, the form that ``ros2 param dump`` gives."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        *path, last = name.split(".")
        inner = found
        for part in path:
            inner = inner.setdefault(part, {})
        inner[last] = value
    return found


def _settings(
    label: str,
    joint: JointDescription,
    counts: int,
    robot: tuple[WorldSettings, RobotDescription],
    layers: Sequence[Layer],
) -> LoopSettings:
    """Return one joint's settings; later layers win, and the robot gives the defaults."""
    values: ParameterValues = {
        "joint": joint.name,
        "control_period": robot[0].control_period_ns / NANOSECONDS,
        "encoder_resolution": math.tau / counts if counts else 0.0,
    }
    if joint.effort < LOOP_PARAMETERS["u_clamp_max"].maximum:
        values |= {"u_clamp_max": joint.effort, "u_clamp_min": -joint.effort}
    for layer in layers:
        values.update(layer.values)
    try:
        settings = with_robot(LoopSettings.from_parameters(values), *robot)
        joint.require_effort(settings)
        return settings
    except HpidError as error:
        where = f"{_place(str(error), layers)}controller {label!r}, joint {joint.name!r}"
        raise ExperimentError(f"{where}: {error}") from None


def _place(line: str, layers: Sequence[Layer]) -> str:
    """Return where the parameter stands that a line begins with, and a colon; else nothing."""
    for layer in reversed(layers):
        for name in layer.values:
            if re.match(rf"(the degree )?{re.escape(name)}(?![\w.])", line):
                return f"{layer.where}.{name}: "
    return ""


@dataclass(frozen=True)
class Experiment:
    """One robot, one reference, and the controllers to compare on them."""

    name: str  # name of the experiment
    text: str  # the file as it stands, merged with what it extends
    path: Path  # where it stands
    duration: float  # [s] stamp of the last state
    seed: int  # seed of everything that is drawn by chance
    answer_timeout: float  # [s] wall time that lock-step waits for one answer
    world: WorldSettings  # the simulated robot
    description: RobotDescription  # the same robot, with all that the file knows better
    trajectory: JointTrajectory  # the reference of every joint
    controllers: Mapping[str, tuple[LoopSettings, ...]]
    judged: tuple[str, ...]  # the joints that studies and searches look at, in the world's order
    plan: BrickPlan | None = None  # the brick task behind the reference; None for any other kind
    # the files that it was read from: its own, and those that it extends
    files: tuple[Path, ...] = ()
    # whether the file, or who read it, says who computes the physics
    is_engine_chosen: bool = True

    @property
    def baseline(self) -> str:
        """Label of the first controller, which the others are measured against."""
        return next(iter(self.controllers))

    @property
    def engine_note(self) -> str:
        """Who computes the physics, in a line, where nobody chose and it is not the usual one."""
        engine = self.world.engine
        if self.is_engine_chosen or engine == ENGINES[0]:
            return ""
        return f"{engine} computes the physics: PyBullet is not installed (pip install pybullet)"

    @property
    def periods(self) -> int:
        """Control periods of the run; it has one state more."""
        return round(self.duration * NANOSECONDS / self.world.control_period_ns)

    @property
    def end_effector(self) -> str:
        """The link that the task is about: the hand among bricks, else the robot's last link."""
        if self.world.workplace.bricks:
            return self.world.workplace.gripper.link
        return self.description.last_link

    @property
    def slides(self) -> frozenset[str]:
        """The driven joints that slide: their units are m and N."""
        return self.description.slides.intersection(self.world.joints)

    @property
    def frictions(self) -> dict[str, float]:
        """Coulomb friction of the driven joints, in [N m]."""
        joints = self.description.joints
        return {name: joints[name].friction for name in self.world.joints}

    def parameters(self) -> dict[str, dict[str, dict[str, object]]]:
        """Return the parameters of every controller's loops, by label and joint."""
        return {
            label: {each.joint: dict(each.to_parameters()) for each in loops}
            for label, loops in self.controllers.items()
        }

    def are_slides(self, joints: Sequence[str]) -> tuple[bool, ...]:
        slides = self.slides
        return tuple(joint in slides for joint in joints)

    def world_document(self) -> dict[str, Any]:
        """Return the sections of the file that are of its world, with what is planned resolved."""
        values = parse_yaml(self.path, self.text, ExperimentError)
        document = {key: values[key] for key in WORLD_SECTIONS if key in values}
        robot = document["robot"]
        folders = tuple(file.parent for file in self.files)
        source = str(robot_source(robot["description"], folders))
        document["robot"] = {**robot, "description": source, "driven": list(self.world.joints)}
        document["simulation"] = {**values.get("simulation", {}), "engine": self.world.engine}
        if self.plan is not None:
            grips = self.world.workplace.grips
            document["scene"]["grips"] = [
                {"time": each.time, "closed": each.is_closed} for each in grips
            ]
        return document

    @property
    def inputs(self) -> tuple[Path, ...]:
        """The files that a run of it reads: its own, and the robot's."""
        robot = str(self.world.robot_description)
        return self.files if robot.lstrip().startswith("<") else (*self.files, Path(robot))

    @property
    def digest(self) -> str:
        """SHA-256 of the file, of the robot's and its models' descriptions, as hexadecimal.

        Another engine than PyBullet counts, too: it need not be named in the file.
        """
        digest = hashlib.sha256(self.text.encode())
        digest.update(self.description.xml.encode())
        loops = [each for settings in self.controllers.values() for each in settings]
        models = {each.model.description for each in loops if each.model.is_on}
        for source in sorted(models - {""}):
            digest.update(robot_xml(source).encode())
        if self.world.engine != "pybullet":
            digest.update(self.world.engine.encode())
        return digest.hexdigest()


def load_experiment(path: str | Path, engine: str | None = None) -> Experiment:
    document = load_document(path, ExperimentError)
    with document.blaming(ExperimentError):
        root = Section(_with_engine(document.values, engine), "", ExperimentError)
        experiment = _experiment(document, root)
        root.finish()
    return experiment


def load_reference(path: str | Path) -> JointTrajectory:
    """Return the reference of a file: an experiment, or any file with a ``reference`` section."""
    document = load_document(path, ExperimentError)
    with document.blaming(TrajectoryError):
        return planned_reference(
            document.values,
            "reference",
            lambda section: section.load(
                lambda name: RobotDescription.load(find_resource(name, document.folders))
            ),
        ).trajectory


def _with_engine(values: Any, engine: str | None) -> Any:
    """Return a document in which ``simulation.engine`` is another one."""
    if engine is None or not isinstance(values, Mapping):
        return values
    simulation = values.get("simulation", {})
    if not isinstance(simulation, Mapping):
        return values
    return {**values, "simulation": {**simulation, "engine": engine}}


def _experiment(document: Document, root: Section) -> Experiment:
    world, control, reference, description = read_world(root, document.folders)
    if reference is None:
        raise ExperimentError("reference is missing")
    duration = _whole_periods(root.number("duration", above=0.0, most=1e5), control.rate, world)
    _require_before_end(world, reference.plan, duration)
    return Experiment(
        name=require_label(root.text("name"), root.place("name"), ExperimentError),
        text=document.text,
        path=document.files[0],
        files=document.files,
        duration=duration,
        seed=world.seed,
        answer_timeout=control.answer_timeout,
        world=world,
        description=description,
        trajectory=reference.trajectory,
        plan=reference.plan,
        controllers=controllers_from(root, world, description),
        judged=judged_from(root, world.joints),
        is_engine_chosen=root.section("simulation", {}).values.get("engine") is not None,
    )


def following_loops(
    settings: Iterable[LoopSettings], trajectory: JointTrajectory
) -> list[JointLoop]:
    """Return the loops of joints at their start, with their references."""
    loops = [JointLoop(each) for each in settings]
    for loop in loops:
        loop.follow(trajectory.column(loop.settings.joint))
    return loops


def _whole_periods(duration: float, rate: float, world: WorldSettings) -> float:
    """Return a duration as control periods have it, which are whole nanoseconds at 30 Hz, too."""
    period_ns, asked_ns = world.control_period_ns, round(duration * NANOSECONDS)
    periods = round(asked_ns / period_ns)
    rounding_ns = abs(NANOSECONDS / rate - period_ns)
    if abs(asked_ns - periods * period_ns) > periods * rounding_ns + 0.5:
        raise ExperimentError(f"duration {duration} s is not a whole number of control periods")
    return periods * period_ns / NANOSECONDS


def _require_before_end(world: WorldSettings, plan: BrickPlan | None, duration: float) -> None:
    """Refuse what would happen after the last control period has begun, which is never."""
    events = world.disturbances
    grips = () if plan is not None else world.workplace.grips
    moments = {
        **{f"disturbances.payload[{k}].time": each.time for k, each in enumerate(events.payload)},
        **{
            f"disturbances.wrenches[{k}].from": each.start
            for k, each in enumerate(events.wrenches)
        },
        **{f"scene.grips[{k}].time": each.time for k, each in enumerate(grips)},
    }
    last_ns = round(duration * NANOSECONDS) - world.control_period_ns
    for place, moment in moments.items():
        if round(moment * NANOSECONDS) > last_ns:
            raise ExperimentError(
                f"{place} {moment:g} s is not before the end: the last control period begins at "
                f"{last_ns / NANOSECONDS:g} s"
            )
    if plan is not None and plan.duration > duration:
        raise ExperimentError(
            f"duration {duration:g} s ends before the brick task, which takes {plan.duration:g} s"
        )


def initial_inertias(
    experiment: Experiment, loops: Sequence[LoopSettings] = ()
) -> dict[str, float]:
    """Return the effective inertia of every driven joint in the initial pose.

    An arm's joint has 1 / (M^-1)_jj on a base that is held, a wheel of a base that of the robot
    that rolls on it with its arm held, with the payload that the experiment begins with.
    """
    world, description = experiment.world, experiment.description
    payload = world.payload_mass, world.payload_link
    held = Dynamics(description, True, *payload)
    inertias = held.joint_inertias(world.joints, world.initial_positions)
    if (base := world.rolling_base) is not None:
        inertias |= wheel_inertias(description, base, world.initial_positions, *payload)
    return inertias | {each.joint: 1.0 for each in loops if each.model.is_decoupling}


_NEEDED = ("name", "duration", "robot", "reference", "controllers", "compare")


def experiment_schema() -> dict[str, Any]:
    """Return the schema (draft 2020-12).

    A file that extends another one may leave out whatever it likes, and remove keys by null.
    """
    parameters = parameters_schema()
    whole = _mapping(_sections("parameters"), _NEEDED)
    extending = partial_schema(
        _mapping(_sections("extending_parameters"), _NEEDED), is_nullable=True
    )
    extending["properties"][EXTENDS] = {
        "type": "string",
        "minLength": 1,
        "description": "The file whose document this one is laid over",
    }
    extending["required"] = [EXTENDS]
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Experiment of hpid_ros",
        "type": "object",
        "if": {"required": [EXTENDS]},
        "then": extending,
        "else": whole,
        "$defs": {
            "parameters": parameters,
            "extending_parameters": partial_schema(parameters, is_nullable=True),
            "joints": _joints("parameters"),
            "extending_joints": _joints("extending_parameters"),
            "compared": _compared(parameters, "joints"),
            "extending_compared": partial_schema(
                _compared(parameters, "extending_joints"), is_nullable=True
            ),
        },
    }


def _ref(name: str) -> dict[str, Any]:
    return {"$ref": f"#/$defs/{name}"}


def _joints(parameters: str) -> dict[str, Any]:
    return {"type": "object", "additionalProperties": _ref(parameters)}


def _compared(parameters: dict[str, Any], joints: str) -> dict[str, Any]:
    return {**parameters, "properties": {**parameters["properties"], "joints": _ref(joints)}}


def _sections(parameters: str) -> dict[str, Any]:
    """Return the sections, those of controllers by reference to parameters of this name."""
    prefix = parameters.removesuffix("parameters")
    return {
        "name": {"type": "string", "minLength": 1, "description": "Name of the experiment"},
        "duration": {
            "type": "number",
            "exclusiveMinimum": 0,
            "maximum": 1e5,
            "description": "Stamp of the last state [s]",
        },
        **world_schema(),
        "reference": {"description": "What the joints follow", **task_schema()},
        "controllers": _mapping({"common": _ref(parameters), "joints": _ref(f"{prefix}joints")}),
        "compare": {
            "type": "object",
            "minProperties": 1,
            "additionalProperties": _ref(f"{prefix}compared"),
            "description": "The controllers by label; the first is the baseline",
        },
        "judge": _mapping(
            {"joints": {"type": "array", "minItems": 1, "items": {"type": "string"}}}, ("joints",)
        ),
    }


def parameters_schema() -> dict[str, Any]:
    """Return the schema of a controller's parameters, whose names may be nested or dotted."""
    specs = [spec for name, spec in PARAMETERS.items() if name != "joint"]
    properties = {spec.name: field_schema(spec) for spec in specs}
    for prefix in dict.fromkeys(name.partition(".")[0] for name in properties if "." in name):
        inner = {
            name.partition(".")[2]: schema
            for name, schema in properties.items()
            if name.startswith(f"{prefix}.")
        }
        properties[prefix] = _mapping(inner)
    return _mapping(properties)


def _mapping(properties: dict[str, Any], needed: Iterable[str] = ()) -> dict[str, Any]:
    return {
        "type": "object",
        "properties": properties,
        "additionalProperties": False,
        **({"required": list(needed)} if needed else {}),
    }
