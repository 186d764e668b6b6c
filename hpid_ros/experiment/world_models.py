"""The sections of an experiment file that say how real the simulated robot is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields
from typing import Any, TypeVar

from hpid_ros.errors import ExperimentError, SettingError, unknown_name
from hpid_ros.sections import Section
from hpid_ros.simulation.disturbances import Disturbances, PayloadChange, WrenchPulse, vector
from hpid_ros.simulation.drives import LONGEST_DELAY, DriveSettings
from hpid_ros.simulation.hall import Homing
from hpid_ros.simulation.motor import Motor
from hpid_ros.simulation.pwm import Pwm

Model = TypeVar("Model", Motor, Pwm, Homing)

_NANOSECONDS = 1_000_000_000


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
        duration_ns=max(1, round(entry.number("duration", above=0.0, most=1e5) * _NANOSECONDS)),
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
    return round(moment * _NANOSECONDS)


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
