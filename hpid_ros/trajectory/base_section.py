"""A path of the base as a configuration says it."""

from __future__ import annotations

from typing import Any

from hpid_ros.errors import TrajectoryError
from hpid_ros.sections import Section
from hpid_ros.trajectory.base_path import FORWARD, base_path
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
