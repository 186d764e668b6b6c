"""The sections of an experiment that say what the simulated world is made of."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields
from typing import Any, TypeVar

from hpid_ros.base.errors import ExperimentError, RobotDescriptionError, SettingError, unknown_name
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.documents.sections import Section
from hpid_ros.planning import BrickPlan
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.differential_drive import DifferentialDrive
from hpid_ros.simulation.drives import LONGEST_DELAY, DriveSettings, Motor, Pwm
from hpid_ros.simulation.sensors import Homing
from hpid_ros.simulation.world.disturbances import Disturbances, PayloadChange, WrenchPulse, vector
from hpid_ros.simulation.world.workpieces import (
    Brick,
    GripCommand,
    GripperSettings,
    Support,
    Workplace,
)


def base_from(robot: Section, description: RobotDescription) -> DifferentialDrive | None:
    """Return the base of a robot; None where the section names none.

    Args:
        robot: The section ``robot``, of which ``base`` is taken: ``left_wheel`` and
            ``right_wheel``, and, where the URDF is not to be asked, ``wheel_radius`` [m] and
            ``wheel_separation`` [m].
        description: The robot.

    Raises:
        ExperimentError: An entry is unknown, missing or out of range, or the robot's wheels are
            not a pair on one axle.
    """
    if "base" not in robot:
        return None
    base = robot.section("base")
    left, right = base.text("left_wheel"), base.text("right_wheel")
    radius, separation = (
        base.number(key, above=0.0) if key in base else None
        for key in ("wheel_radius", "wheel_separation")
    )
    base.finish()
    try:
        return DifferentialDrive.of(description, left, right, radius, separation)
    except (RobotDescriptionError, SettingError) as error:
        raise ExperimentError(f"{base.where}: {error}") from None


Model = TypeVar("Model", Motor, Pwm, Homing)


class Layers:
    """A section whose entries hold for all joints, but for what its ``joints`` say otherwise.

    Args:
        section: The section; its other entries stay for the caller.
        joints: The driven joints.

    Raises:
        ExperimentError: ``joints`` names one that there is not.
    """

    def __init__(self, section: Section, joints: tuple[str, ...]) -> None:
        self._common = section
        each = section.section("joints", {})
        for name in each.items():
            if name not in joints:
                raise ExperimentError(f"{each.where}: {unknown_name('joint', name, joints)}")
        self._own = {name: each.section(name) for name in each.items()}

    def model(self, key: str, joint: str, kind: type[Model]) -> Model | None:
        """Return a joint's model; None where there is none, or where it is ``off``.

        Args:
            key: Name of the model in the section.
            joint: Name of the joint.
            kind: What it is.

        Raises:
            ExperimentError: A value is missing, unknown or out of range.
        """
        raw = self._common.take(key, False)
        values: dict[str, Any] | None = None
        place = self._common.place(key)
        if raw is not False:
            values = self._common.section(key).items()
        own = self._own.get(joint)
        if own is not None and key in own:
            place = own.place(key)
            is_off = own.take(key) is False
            values = None if is_off else (values or {}) | own.section(key).items()
        return None if values is None else _model(Section(values, place, ExperimentError), kind)

    def whole(self, key: str, joint: str, most: int) -> int:
        """Return a joint's whole number from 0 on; 0 where there is none.

        Raises:
            ExperimentError: It is none, or out of range.
        """
        number = self._common.whole(key, 0, least=0, most=most)
        own = self._own.get(joint)
        return number if own is None else own.whole(key, number, least=0, most=most)

    def finish(self) -> None:
        """Refuse what nobody took.

        Raises:
            ExperimentError: There is an entry that nothing asked for.
        """
        for section in (self._common, *self._own.values()):
            section.finish()


def drives_from(root: Section, joints: tuple[str, ...]) -> tuple[DriveSettings, ...]:
    """Return the drive of each joint; empty when every one is ideal.

    Args:
        root: The experiment file, of which ``actuators`` is taken.
        joints: The driven joints.

    Raises:
        ExperimentError: An entry is unknown, missing or out of range.
    """
    layers = Layers(root.section("actuators", {}), joints)
    drives = tuple(
        DriveSettings(
            layers.model("motor", joint, Motor),
            layers.model("pwm", joint, Pwm),
            layers.whole("delay", joint, LONGEST_DELAY),
        )
        for joint in joints
    )
    layers.finish()
    return () if all(drive.is_ideal for drive in drives) else drives


def homing_from(layers: Layers, joints: tuple[str, ...]) -> tuple[Homing | None, ...]:
    """Return the homing run of each joint; empty when the start is known of all.

    Args:
        layers: The section ``sensors``.
        joints: The driven joints.

    Raises:
        ExperimentError: An entry is unknown, missing or out of range.
    """
    homing = tuple(layers.model("homing", joint, Homing) for joint in joints)
    return () if all(each is None for each in homing) else homing


def noise_from(sensors: Section, joints: tuple[str, ...]) -> float | tuple[float, ...]:
    """Return the positions' noise in [rad]: one number for all, or one for each joint by name.

    Args:
        sensors: The section ``sensors``.
        joints: The driven joints.

    Raises:
        ExperimentError: It is missing for a joint, or out of range.
    """
    if not isinstance(sensors.take("noise", 0.0), Mapping):
        return sensors.number("noise", 0.0, least=0.0)
    each = sensors.section("noise")
    along = tuple(each.number(joint, least=0.0) for joint in joints)
    each.finish()
    return along


def disturbances_from(root: Section, duration: float) -> Disturbances:
    """Return what happens to the robot while it runs.

    Args:
        root: The experiment file, of which ``disturbances`` is taken.
        duration: Of the experiment, in [s].

    Raises:
        ExperimentError: An entry is unknown, missing or out of range, or would happen after the
            end.
    """
    section = root.section("disturbances", {})
    payload = [_payload(entry, duration) for entry in _entries(section, "payload")]
    wrenches = [_wrench(entry, duration) for entry in _entries(section, "wrenches")]
    section.finish()
    return Disturbances(tuple(payload), tuple(wrenches))


def _payload(entry: Section, duration: float) -> PayloadChange:
    change = PayloadChange(_moment(entry, "time", duration), entry.number("mass", least=0.0))
    entry.finish()
    return change


def _wrench(entry: Section, duration: float) -> WrenchPulse:
    pulse = WrenchPulse(
        link=entry.text("link"),
        force=_vector(entry, "force"),
        torque=_vector(entry, "torque"),
        start_ns=_moment(entry, "from", duration),
        duration_ns=max(1, round(entry.number("duration", above=0.0, most=1e5) * NANOSECONDS)),
    )
    entry.finish()
    return pulse


def _moment(entry: Section, key: str, duration: float) -> int:
    """Return a moment of the experiment, in [ns]."""
    moment = entry.number(key, least=0.0)
    if moment >= duration:
        raise ExperimentError(
            f"{entry.place(key)} {moment:g} s is not before the end, {duration:g} s"
        )
    return round(moment * NANOSECONDS)


def _vector(entry: Section, key: str) -> tuple[float, float, float]:
    values = entry.take(key, [0.0, 0.0, 0.0])
    if not isinstance(values, list) or not all(
        isinstance(value, int | float) and not isinstance(value, bool) for value in values
    ):
        raise ExperimentError(f"{entry.place(key)} must be three numbers, not {values!r}")
    try:
        return vector(entry.place(key), values)
    except SettingError as error:
        raise ExperimentError(str(error)) from None


def _entries(section: Section, key: str) -> list[Section]:
    """Return a list of mappings as sections."""
    entries = section.take(key, [])
    if not isinstance(entries, list):
        raise ExperimentError(f"{section.place(key)} must be a list, not {entries!r}")
    return [
        Section(entry, f"{section.place(key)}[{index}]", ExperimentError)
        for index, entry in enumerate(entries)
    ]


def _model(section: Section, kind: type[Model]) -> Model:
    """Return the model that a section says, field by field."""
    values: dict[str, Any] = {}
    for field in fields(kind):
        default = () if field.default is MISSING else (field.default,)
        if field.type == "str":
            values[field.name] = section.text(field.name, *default)
        elif field.type == "int":
            values[field.name] = section.whole(field.name, *default, least=0)
        else:
            values[field.name] = section.number(field.name, *default)
    section.finish()
    try:
        return kind(**values)
    except SettingError as error:
        raise ExperimentError(f"{section.where}: {error}") from None


Made = TypeVar("Made")

_OF_GRIPPER = ("opening", "tolerance", "angle_tolerance", "grip_force", "friction")


def workplace_from(root: Section, plan: BrickPlan | None, duration: float) -> Workplace:
    """Return what stands about the robot; nothing where the file has no ``scene``.

    ``scene.bricks`` and ``scene.supports`` name boxes with ``size`` (edges x, y, z [m]),
    ``position`` (of the centre [m]), ``yaw`` [rad] and ``friction``; a brick has a ``mass``
    [kg], too. ``scene.gripper`` is described at
    :class:`.GripperSettings`. The gripper closes and opens when the
    plan of the reference says so; without one ``scene.grips`` lists ``time`` [s] and ``closed``.

    Args:
        root: The experiment file, of which ``scene`` is taken.
        plan: The plan of the reference; None where it has none.
        duration: Of the experiment, in [s].

    Raises:
        ExperimentError: An entry is unknown, missing or out of range, or the experiment ends
            before the plan.
    """
    section = root.section("scene", {})
    bricks = tuple(_brick(name, entry) for name, entry in _named(section, "bricks"))
    supports = tuple(_support(name, entry) for name, entry in _named(section, "supports"))
    gripper = _gripper(section.section("gripper", {}))
    schedule = tuple(_grips(section))
    section.finish()
    if plan is not None:
        if schedule:
            raise ExperimentError(f"{section.place('grips')}: the reference plans them already")
        if plan.duration > duration:
            raise ExperimentError(
                f"duration {duration:g} s ends before the brick task, which takes "
                f"{plan.duration:g} s"
            )
        schedule = tuple(GripCommand(grip.time_ns, grip.is_closed) for grip in plan.grips)
    try:
        return Workplace(bricks, supports, gripper, schedule)
    except SettingError as error:
        raise ExperimentError(f"{section.where}: {error}") from None


def _named(section: Section, key: str) -> list[tuple[str, Section]]:
    boxes = section.section(key, {})
    return [(name, boxes.section(name)) for name in boxes.items()]


def _brick(name: str, entry: Section) -> Brick:
    mass = entry.number("mass", above=0.0)
    return _made(entry, lambda: Brick(name, **_box(entry), mass=mass))


def _support(name: str, entry: Section) -> Support:
    return _made(entry, lambda: Support(name, **_box(entry)))


def _box(entry: Section) -> dict[str, Any]:
    return {
        "size": _triple(entry, "size"),
        "position": _triple(entry, "position"),
        "yaw": entry.number("yaw", 0.0),
        "friction": entry.number("friction", 1.0, least=0.0),
    }


def _gripper(entry: Section) -> GripperSettings:
    values: dict[str, Any] = {name: entry.number(name) for name in _OF_GRIPPER if name in entry}
    if "link" in entry:
        values["link"] = entry.text("link")
    return _made(entry, lambda: GripperSettings(**values))


def _grips(section: Section) -> list[GripCommand]:
    entries, place = section.take("grips", []), section.place("grips")
    if not isinstance(entries, list):
        raise ExperimentError(f"{place} must be a list, not {entries!r}")
    grips = []
    for index, values in enumerate(entries):
        entry = Section(values, f"{place}[{index}]", ExperimentError)
        time_ns = round(entry.number("time", least=0.0, most=1e5) * NANOSECONDS)
        is_closed = entry.flag("closed")
        entry.finish()
        grips.append(GripCommand(time_ns, is_closed))
    return grips


def _made(entry: Section, make: Callable[[], Made]) -> Made:
    """Return what an entry describes, all of whose keys are known."""
    try:
        made = make()
    except SettingError as error:
        raise ExperimentError(f"{entry.where}: {error}") from None
    entry.finish()
    return made


def _triple(entry: Section, key: str) -> tuple[float, float, float]:
    values = entry.take(key)
    if not isinstance(values, list) or not all(
        isinstance(value, int | float) and not isinstance(value, bool) for value in values
    ):
        raise ExperimentError(f"{entry.place(key)} must be three numbers [m], not {values!r}")
    try:
        return vector(entry.place(key), values)
    except SettingError as error:
        raise ExperimentError(str(error)) from None
