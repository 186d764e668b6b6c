"""What is told of a brick task: texts and figures, the same on the graph and without it."""

from __future__ import annotations

from typing import NamedTuple

from hpid_ros.simulation.gripper import LOST, MISSED, GripEvent
from hpid_ros.simulation.settings import WorldSettings

END_EFFECTOR, BRICK_POSES, GRIP_EVENTS = "ee_pose", "brick_poses", "grip_events"
DISTANCE, ANGLE, FORCE = "distance [m]", "angle [rad]", "force [N]"

_OK, _WARN, _ERROR = range(3)  # of diagnostic_msgs/DiagnosticStatus
_LEVELS = {MISSED: _WARN, LOST: _ERROR}


class GripStatus(NamedTuple):
    """An event of the gripper as a ``diagnostic_msgs/DiagnosticStatus``.

    Attributes:
        level: 0 good, 1 missed, 2 lost.
        name: Name of the brick.
        message: The outcome and, after a colon, the reason if there is one.
        values: Figures as texts that give back the same numbers.
    """

    level: int
    name: str
    message: str
    values: dict[str, str]


def grip_status(event: GripEvent) -> GripStatus:
    """Return an event as it is published."""
    message = f"{event.outcome}: {event.reason}" if event.reason else event.outcome
    figures = {DISTANCE: event.distance, ANGLE: event.angle, FORCE: event.force}
    values = {name: repr(float(value)) for name, value in figures.items()}
    return GripStatus(_LEVELS.get(event.outcome, _OK), event.brick, message, values)


def task_topics(settings: WorldSettings) -> tuple[str, ...]:
    """Return the topics of the task that a recorder must have.

    ``ee_pose`` is among them where the robot moves about or has bricks: where its root stands
    still, the joints tell everything.
    """
    has_bricks = bool(settings.workplace.bricks)
    of_bricks = (BRICK_POSES, GRIP_EVENTS) if has_bricks else ()
    return (END_EFFECTOR, *of_bricks) if has_bricks or settings.base is not None else ()
