"""A reference as a configuration says it: ``kind`` and the numbers of that kind."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hpid_ros.errors import TrajectoryError, unknown_name
from hpid_ros.sections import Section
from hpid_ros.trajectory.generators import minimum_jerk, sine, step
from hpid_ros.trajectory.joint_trajectory import JointTrajectory

KINDS = ("minimum_jerk", "step", "sine")


def reference_from(values: object, where: str = "reference") -> JointTrajectory:
    """Return the trajectory that a ``reference`` section describes.

    ``kind: minimum_jerk`` and ``kind: step`` have ``times`` [s] and ``positions`` (for each
    joint one per time, [rad]); ``kind: sine`` has ``duration`` [s] and ``joints`` (for each
    ``amplitude``, ``period`` and, if wanted, ``offset`` and ``phase``).

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
    if kind == "sine":
        duration = section.number("duration", above=0.0)
        signals = {
            joint: _signal(section.section("joints").section(joint))
            for joint in section.section("joints").items()
        }
        section.finish()
        return sine(duration, signals)
    times = _numbers(section.take("times"), section.place("times"))
    positions = {
        joint: _numbers(row, f"{section.place('positions')}.{joint}")
        for joint, row in section.section("positions").items().items()
    }
    section.finish()
    return (minimum_jerk if kind == "minimum_jerk" else step)(times, positions)


def _signal(section: Section) -> Mapping[str, float]:
    signal = {
        "amplitude": section.number("amplitude"),
        "period": section.number("period", above=0.0),
        "offset": section.number("offset", 0.0),
        "phase": section.number("phase", 0.0),
    }
    section.finish()
    return signal


def _numbers(values: Any, where: str) -> list[float]:
    if not isinstance(values, list) or not values:
        raise TrajectoryError(f"{where} must be a list of numbers, not {values!r}")
    for value in values:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise TrajectoryError(f"{where} must be a list of numbers, it holds {value!r}")
    return [float(value) for value in values]
