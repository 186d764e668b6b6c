"""The section of an experiment file that puts bricks and supports around the robot."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from hpid_ros.errors import ExperimentError, SettingError
from hpid_ros.planning import BrickPlan
from hpid_ros.sections import Section
from hpid_ros.simulation.bricks import Brick, GripCommand, GripperSettings, Support, Workplace
from hpid_ros.simulation.disturbances import vector

Made = TypeVar("Made")

_NANOSECONDS = 1_000_000_000
_OF_GRIPPER = ("opening", "tolerance", "angle_tolerance", "grip_force", "friction")


def workplace_from(root: Section, plan: BrickPlan | None, duration: float) -> Workplace:
    """Return what stands about the robot; nothing where the file has no ``scene``.

    ``scene.bricks`` and ``scene.supports`` name boxes with ``size`` (edges x, y, z [m]),
    ``position`` (of the centre [m]), ``yaw`` [rad] and ``friction``; a brick has a ``mass``
    [kg], too. ``scene.gripper`` is described at
    :class:`~hpid_ros.simulation.bricks.GripperSettings`. The gripper closes and opens when the
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
        time_ns = round(entry.number("time", least=0.0, most=1e5) * _NANOSECONDS)
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
