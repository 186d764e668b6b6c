"""A reference as a configuration says it: ``kind`` and the numbers of that kind."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hpid_ros.base.errors import TrajectoryError, unknown_name
from hpid_ros.documents.sections import Section
from hpid_ros.trajectory.base_path import FORWARD, base_path
from hpid_ros.trajectory.combining import combined
from hpid_ros.trajectory.generators import minimum_jerk, sine, step
from hpid_ros.trajectory.joint_trajectory import JointTrajectory


def base_path_from(section: Section) -> JointTrajectory:
    """Return the wheels' trajectories that a section of ``kind: base_path`` describes.

    ``base`` names the wheels as ``robot.base`` of an experiment does (``left_wheel``,
    ``right_wheel``, ``wheel_radius`` [m], ``wheel_separation`` [m]); ``times`` [s] and ``poses``
    (x [m], y [m], heading [rad]) are the path. Optional: ``directions`` (``forward`` or
    ``backward``, one for all legs or a list), ``passes``, ``velocity_limit`` of a wheel [rad/s]
    and ``curvature_limit`` [1/m].

    Args:
        section: The section, whose ``kind`` is taken.

    Raises:
        TrajectoryError: A key is missing or unknown, or the numbers make no path.
    """
    base = section.section("base")
    left, right = base.text("left_wheel"), base.text("right_wheel")
    radius = base.number("wheel_radius", above=0.0)
    separation = base.number("wheel_separation", above=0.0)
    base.finish()
    times = number_list(section.take("times"), section.place("times"))
    place = section.place("poses")
    rows = section.take("poses")
    if not isinstance(rows, list):
        raise TrajectoryError(f"{place} must be a list of poses, not {rows!r}")
    poses = [number_list(row, f"{place}[{index}]") for index, row in enumerate(rows)]
    directions = section.take("directions", FORWARD)
    if isinstance(directions, str):
        directions = [directions] * (len(poses) - 1)
    if not isinstance(directions, list):
        raise TrajectoryError(f"{section.place('directions')} must be a list of texts or a text")
    options: dict[str, Any] = {
        name: section.number(name, above=0.0)
        for name in ("velocity_limit", "curvature_limit")
        if name in section
    }
    options["passes"] = section.flag("passes", False)
    section.finish()
    try:
        return base_path(
            times, poses, left, right, radius, separation, directions=directions, **options
        )
    except TrajectoryError as error:
        raise TrajectoryError(f"{section.where}: {error}") from None


def number_list(values: Any, where: str) -> list[float]:
    """Return a list of numbers as a configuration gives it.

    Args:
        values: What came.
        where: Its place in the document, for the messages.

    Raises:
        TrajectoryError: It is no list, empty, or holds something else.
    """
    if not isinstance(values, list) or not values:
        raise TrajectoryError(f"{where} must be a list of numbers, not {values!r}")
    for value in values:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise TrajectoryError(f"{where} must be a list of numbers, it holds {value!r}")
    return [float(value) for value in values]


KINDS = ("minimum_jerk", "step", "sine", "base_path", "combined")


def reference_from(values: object, where: str = "reference") -> JointTrajectory:
    """Return the trajectory that a ``reference`` section describes.

    ``kind: minimum_jerk`` and ``kind: step`` have ``times`` [s] and ``positions`` (for each
    joint one per time, [rad]); ``kind: sine`` has ``duration`` [s] and ``joints`` (for each
    ``amplitude``, ``period`` and, if wanted, ``offset`` and ``phase``). ``kind: base_path`` is
    for the wheels of a base, see :func:`~hpid_ros.trajectory.configuration.base_path_from`;
    ``kind: combined`` has ``parts``, a list of such sections for different joints.

    Args:
        values: The section.
        where: Its place in the document, for the messages.

    Raises:
        TrajectoryError: A key is missing or unknown, or the numbers make no trajectory.
    """
    section = Section(values, where, TrajectoryError)
    kind = section.text("kind")
    if kind not in KINDS:
        raise TrajectoryError(f"{section.place('kind')}: {unknown_name('kind', kind, KINDS)}")
    if kind == "base_path":
        return base_path_from(section)
    if kind == "combined":
        return _combined(section)
    if kind == "sine":
        duration = section.number("duration", above=0.0)
        signals = {
            joint: _signal(section.section("joints").section(joint))
            for joint in section.section("joints").items()
        }
        section.finish()
        return sine(duration, signals)
    times = number_list(section.take("times"), section.place("times"))
    positions = {
        joint: number_list(row, f"{section.place('positions')}.{joint}")
        for joint, row in section.section("positions").items().items()
    }
    section.finish()
    return (minimum_jerk if kind == "minimum_jerk" else step)(times, positions)


def _combined(section: Section) -> JointTrajectory:
    parts = section.take("parts")
    section.finish()
    if not isinstance(parts, list) or not parts:
        raise TrajectoryError(f"{section.place('parts')} must be a list of references")
    place = section.place("parts")
    if any(isinstance(part, Mapping) and part.get("kind") == "combined" for part in parts):
        raise TrajectoryError(f"{place} must not hold a combined reference again")
    each = [reference_from(part, f"{place}[{index}]") for index, part in enumerate(parts)]
    try:
        return combined(each)
    except TrajectoryError as error:
        raise TrajectoryError(f"{section.where}: {error}") from None


def _signal(section: Section) -> Mapping[str, float]:
    signal = {
        "amplitude": section.number("amplitude"),
        "period": section.number("period", above=0.0),
        "offset": section.number("offset", 0.0),
        "phase": section.number("phase", 0.0),
    }
    section.finish()
    return signal
