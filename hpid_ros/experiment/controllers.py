"""The section of an experiment that says which controllers are compared, and with which models."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from hpid_ros.base.errors import ExperimentError, HpidError, unknown_name
from hpid_ros.base.names import require_label
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.compensation.build import robot_xml, with_inertia
from hpid_ros.control import LOOP_PARAMETERS, LoopSettings
from hpid_ros.control.settings.model import ModelSettings
from hpid_ros.control.settings.table import PARAMETERS
from hpid_ros.documents.sections import Section
from hpid_ros.robot.description import JointDescription, RobotDescription
from hpid_ros.simulation.settings import WorldSettings


def with_robot(settings: LoopSettings, world: WorldSettings) -> LoopSettings:
    """Return settings whose model has what the experiment's robot says.

    A model rolls where the robot does, and holds the joints that are not driven.
    """
    model = settings.model
    if not model.is_on:
        return settings
    if not model.locked_joints:
        robot = RobotDescription.load(world.robot_description)
        idle = [name for name in robot.joints if name not in world.joints]
        model = replace(model, locked_joints=",".join(idle))
    if not model.left_wheel and not world.fixed_base:
        model = _rolling(model, world)
    return with_inertia(replace(settings, model=model), str(world.robot_description))


def models_of(controllers: Mapping[str, Sequence[LoopSettings]]) -> list[str]:
    """Return the URDF texts of models that are not the experiment's own robot."""
    loops = [each for settings in controllers.values() for each in settings]
    sources = {each.model.description for each in loops if each.model.is_on}
    return [robot_xml(source) for source in sorted(sources - {""})]


def _rolling(model: ModelSettings, world: WorldSettings) -> ModelSettings:
    base = world.base
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

Parameters = dict[str, object]


class Layer(NamedTuple):
    """Parameters that a section has, by dotted name, and its place."""

    where: str
    values: Parameters


_NOTHING = Layer("", {})


def controllers_from(root: Section, world: WorldSettings) -> dict[str, tuple[LoopSettings, ...]]:
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
    joints = RobotDescription.load(world.robot_description).select(world.joints)
    result = {}
    for label in labels:
        changes = _parameters(compared, label, but=_JOINTS)
        own_changes = _by_joint(compared.section(label), world)
        loops = []
        for joint, counts in zip(joints, world.counts, strict=True):
            one, change = own.get(joint.name), own_changes.get(joint.name)
            layers = (common, one or _NOTHING, changes, change or _NOTHING)
            loops.append(_settings(label, joint, counts, world, layers))
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
    flat: Parameters = {}
    inner = section.section(key, {})
    for name, value in inner.items().items():
        if name == but:
            continue
        nested = value.items() if isinstance(value, Mapping) else [(None, value)]
        for rest, entry in nested:
            dotted = name if rest is None else f"{name}.{rest}"
            if dotted not in PARAMETERS or dotted == "joint":
                place = inner.place(dotted)
                known = [inner.place(p) for p in PARAMETERS if p != "joint"]
                raise ExperimentError(unknown_name("key", place, known))
            flat[dotted] = entry
    return Layer(inner.where, flat)


def _settings(
    label: str,
    joint: JointDescription,
    counts: int,
    world: WorldSettings,
    layers: Sequence[Layer],
) -> LoopSettings:
    """Return one joint's settings; later layers win, and the robot gives the defaults."""
    values: Parameters = {
        "joint": joint.name,
        "control_period": world.control_period_ns / NANOSECONDS,
        "encoder_resolution": math.tau / counts if counts else 0.0,
    }
    if joint.effort < LOOP_PARAMETERS["u_clamp_max"].maximum:
        values |= {"u_clamp_max": joint.effort, "u_clamp_min": -joint.effort}
    for layer in layers:
        values.update(layer.values)
    try:
        return with_robot(LoopSettings.from_parameters(values), world)
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
