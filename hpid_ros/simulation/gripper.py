"""A gripper that holds a brick by friction, and reports of its task.

When the fingers close, the brick nearest to the grasp frame is held if it fits: its centre within
the tolerance, its faces turned against the fingers by no more than the tolerance, and not wider
than the opening. Held means fixed to the hand as it lies there, by a constraint of the solver.
Two fingers that press with N each and rub with the coefficient mu hold a force of 2 mu N
(Coulomb); when the hand and the brick pull at each other with more than that, as a mean over
20 ms, the brick slips out and is lost. What is shorter, a jerk when a moving hand closes, moves
it within the fingers by less than a millimetre. Moments are held whatever they are.

The hand has no joint for its fingers and does not collide with bricks: a finger that would have
pushed a brick over is one that misses it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from itertools import permutations, product
from typing import NamedTuple

import numpy as np

from hpid_ros.base.units import Numbers
from hpid_ros.messages.reports import Status
from hpid_ros.simulation.physics import Physics, Pose
from hpid_ros.simulation.settings import Brick, GripperSettings, Workplace, WorldSettings

_ROTATIONS = [
    rotation
    for order in permutations(range(3))
    for signs in product((1.0, -1.0), repeat=3)
    if np.linalg.det(rotation := np.diag(signs)[list(order)]) > 0.0
]  # the 24 that map a box's axes onto axes


class GraspFit(NamedTuple):
    """How a brick lies in the hand."""

    brick: int
    distance: float  # [m] between its centre and the grasp frame
    angle: float  # [rad] between its faces and the fingers
    width: float  # [m] its edge between the fingers


def fit_of(index: int, size: Sequence[float], brick: Pose, hand: Pose) -> GraspFit:
    """Return how a brick lies in the hand."""
    relative = _matrix(hand.orientation).T @ _matrix(brick.orientation)
    nearest = max(_ROTATIONS, key=lambda rotation: float(np.sum(rotation * relative)))
    # The chord of an angle is exact for small ones, where the arc cosine of the trace is not.
    chord = float(np.linalg.norm(nearest - relative)) / (2.0 * math.sqrt(2.0))
    across = int(np.argmax(np.abs(nearest[1])))  # the brick's axis along the hand's y
    distance = math.dist(hand.position, brick.position)
    return GraspFit(index, distance, 2.0 * math.asin(min(chord, 1.0)), size[across])


def grasp_misfit(fit: GraspFit, gripper: GripperSettings) -> str:
    """Return why a brick cannot be held; empty when it can."""
    if fit.distance > gripper.tolerance:
        return f"{fit.distance:.4g} m away, at most {gripper.tolerance:g} m"
    if fit.angle > gripper.angle_tolerance:
        return f"turned by {fit.angle:.4g} rad, at most {gripper.angle_tolerance:g} rad"
    if fit.width > gripper.opening:
        return f"{fit.width:g} m wide, at most {gripper.opening:g} m"
    return ""


def _matrix(quaternion: Sequence[float]) -> Numbers:
    """Return a quaternion x, y, z, w as a rotation matrix."""
    from scipy.spatial.transform import Rotation  # slow to import, for a world without bricks

    matrix: Numbers = Rotation.from_quat(quaternion).as_matrix()
    return matrix


GRASPED, MISSED, RELEASED, LOST = "grasped", "missed", "released", "lost"

PULL_TIME = 0.02
"""Over which a pull is averaged, in [s]."""


class GripEvent(NamedTuple):
    """What came of closing or opening, or of holding."""

    stamp_ns: int  # [ns] when, in simulated time
    outcome: str  # grasped, missed, released or lost
    brick: str  # name of the brick; of a miss, of the nearest one
    distance: float  # [m] between the brick's centre and the grasp frame
    angle: float  # [rad] between the brick's faces and the fingers
    force: float = 0.0  # [N] between the hand and the brick when it was lost; 0 otherwise
    reason: str = ""  # why it was missed or lost; empty otherwise


class Gripper:
    """The gripper of a robot among bricks."""

    def __init__(self, physics: Physics, workplace: Workplace, step: float) -> None:
        self._physics = physics
        self._settings, self._bricks = workplace.gripper, workplace.bricks
        # The last one first, of one time as they stand.
        self._pending = sorted(workplace.grips, key=lambda each: each.time_ns)[::-1]
        self.events: list[GripEvent] = []
        self._held: int | None = None  # which brick
        steps = max(1, round(PULL_TIME / step))
        self._forces: deque[tuple[float, ...]] = deque(maxlen=steps)
        _matrix((0.0, 0.0, 0.0, 1.0))  # so that the first grasp does not wait for an import

    def poses(self) -> tuple[Pose, ...]:
        """Return where the bricks are, in the settings' order."""
        return tuple(self._physics.brick_pose(index) for index in range(len(self._bricks)))

    @property
    def held(self) -> Brick | None:
        return None if self._held is None else self._bricks[self._held]

    def actuate(self, now_ns: int) -> None:
        while self._pending and self._pending[-1].time_ns <= now_ns:
            self.move(self._pending.pop().is_closed, now_ns)

    def move(self, is_closed: bool, now_ns: int) -> GripEvent | None:
        event = self._close(now_ns) if is_closed else self._open(now_ns)
        if event is not None:
            self.events.append(event)
        return event

    def sample_contacts(self) -> None:
        """Note the force between hand and brick, after each physics step."""
        if self._held is not None:
            self._forces.append(self._physics.grip_force())

    def update(self, now_ns: int) -> None:
        """Drop the brick if it was pulled too hard, after each control period."""
        if self._held is None:
            return
        force, limit = self._force(), self._settings.holding_force
        if force <= limit:
            return
        fit = self._fit(self._held)
        self._release()
        why = f"pulled with {force:.3g} N, the grip holds {limit:.3g} N"
        self.events.append(self._event(now_ns, LOST, fit, force, why))

    def _close(self, now_ns: int) -> GripEvent | None:
        if self._held is not None or not self._bricks:
            return None
        fits = [self._fit(index) for index in range(len(self._bricks))]
        nearest = min(fits, key=lambda fit: fit.distance)
        why = grasp_misfit(nearest, self._settings)
        if why:
            return self._event(now_ns, MISSED, nearest, 0.0, why)
        self._physics.hold(nearest.brick)
        self._held = nearest.brick
        return self._event(now_ns, GRASPED, nearest)

    def _open(self, now_ns: int) -> GripEvent | None:
        if self._held is None:
            return None
        fit = self._fit(self._held)
        self._release()
        return self._event(now_ns, RELEASED, fit)

    def _event(
        self, now_ns: int, outcome: str, fit: GraspFit, force: float = 0.0, why: str = ""
    ) -> GripEvent:
        name = self._bricks[fit.brick].name
        return GripEvent(now_ns, outcome, name, fit.distance, fit.angle, force, why)

    def _fit(self, index: int) -> GraspFit:
        hand = self._physics.link_pose(self._settings.link)
        brick = self._physics.brick_pose(index)
        return fit_of(index, self._bricks[index].size, brick, hand)

    def _release(self) -> None:
        self._physics.release()
        self._held = None
        self._forces.clear()

    def _force(self) -> float:
        """Return the length of the mean force over the last while, in [N]; before, it is 0."""
        count = self._forces.maxlen or 1
        return math.hypot(*(sum(axis) / count for axis in zip(*self._forces, strict=True)))


END_EFFECTOR, BRICK_POSES, GRIP_EVENTS = "ee_pose", "brick_poses", "grip_events"
DISTANCE, ANGLE, FORCE = "distance [m]", "angle [rad]", "force [N]"

_OK, _WARN, _ERROR = range(3)  # of diagnostic_msgs/DiagnosticStatus
_LEVELS = {MISSED: _WARN, LOST: _ERROR}


def grip_status(event: GripEvent) -> Status:
    """Return an event as it is published: by brick, with figures that give back their numbers."""
    message = f"{event.outcome}: {event.reason}" if event.reason else event.outcome
    figures = {DISTANCE: event.distance, ANGLE: event.angle, FORCE: event.force}
    values = {name: repr(float(value)) for name, value in figures.items()}
    level = _LEVELS.get(event.outcome, _OK)
    return Status(event.stamp_ns, level, event.brick, message, values)


def task_topics(settings: WorldSettings) -> tuple[str, ...]:
    """Return the topics of the task that a recorder must have.

    ``ee_pose`` is among them where the robot moves about or has bricks: where its root stands
    still, the joints tell everything.
    """
    has_bricks = bool(settings.workplace.bricks)
    of_bricks = (BRICK_POSES, GRIP_EVENTS) if has_bricks else ()
    return (END_EFFECTOR, *of_bricks) if has_bricks or settings.base is not None else ()
