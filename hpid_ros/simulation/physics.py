"""Poses, and the protocol of physics engines."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol
from xml.etree import ElementTree

from hpid_ros.base.errors import RobotDescriptionError, SettingError
from hpid_ros.base.units import Vector
from hpid_ros.robot.description import RobotDescription, find_mesh, mesh_places
from hpid_ros.simulation.settings import Brick

_logger = logging.getLogger(__name__)


class Pose(NamedTuple):
    """A frame in the world."""

    position: tuple[float, float, float]  # [m] origin x, y, z
    # unit quaternion x, y, z, w, as in geometry_msgs/Quaternion
    orientation: tuple[float, float, float, float]


class Twist(NamedTuple):
    """Velocity of a frame, expressed in that frame, as ``nav_msgs/Odometry`` has it."""

    linear: tuple[float, float, float]  # [m/s] velocity of the frame's origin
    angular: tuple[float, float, float]  # [rad/s] angular velocity


BRICK_SETTLING_TIME = 0.25  # [s]
NEGLIGIBLE_MASS = 1e-6  # [kg] of a link that is a mere frame
NEGLIGIBLE_INERTIA = 1e-9  # [kg m^2]
GROUND_FRICTION = 1.0  # of two surfaces the product counts: the robot's decides
_STAYING = 0.005  # [m], how far a brick may be from where it is put when it has settled


def require_meshes(description: RobotDescription, is_touched: bool) -> None:
    """Refuse a robot without its collision meshes, or warn where nothing touches it."""
    missing = [
        f"{name} of link {link.get('name')!r} ({mesh_places(name, description.folder)})"
        for link in ElementTree.fromstring(description.xml).findall("link")
        for mesh in link.findall("collision/geometry/mesh")
        if find_mesh(name := mesh.get("filename", ""), description.folder) is None
    ]
    if missing:
        what = f"{len(missing)} collision mesh(es) missing: {missing[0]}"
        if is_touched:
            raise RobotDescriptionError(f"{what}; only on a fixed base the robot can do without")
        _logger.warning("%s; nothing touches the robot, it goes without", what)


def require_staying(brick: Brick, settled: Pose) -> None:
    """Refuse a brick that fell or was pushed while everything settled."""
    moved = math.dist(settled.position, brick.position)
    if not moved <= _STAYING:
        raise SettingError(
            f"brick {brick.name!r} does not stay at {list(brick.position)} m: it moves by "
            f"{moved:.3g} m in {BRICK_SETTLING_TIME:g} s; put it on a support, where it overlaps "
            "nothing"
        )


class Physics(Protocol):
    """A robot, the ground, bricks and supports in an engine, one physics step at a time.

    At time 0 the robot rests: its lowest point is put on the ground, it sinks into its elastic
    tyres for 0.25 s with every joint locked, then all speeds are set to zero and the joints to
    their initial positions. The same calls give the same numbers to the last bit, in any process.
    """

    def joint_states(self) -> Sequence[Sequence[float]]:
        """Return position [rad] and velocity [rad/s], first of all, of each driven joint."""

    def advance(self, torques: Sequence[float], steps: int = 1) -> None:
        """Take physics steps with these torques at the driven joints, in [N m]."""

    def set_damping(self, damping: Sequence[float]) -> None:
        """Set the viscous friction of each driven joint, in [N m s/rad]."""

    def brake(self, forces: Sequence[float]) -> None:
        """Set the Coulomb friction of each driven joint, in [N m]."""

    def push(self, link: str, force: Vector, torque: Vector) -> None:
        """Push a link in the next step, at its frame's origin, in world axes, in [N] and [N m]."""

    def load(self, mass: float) -> None:
        """Put a solid cube of this mass at the payload link's centre of mass, in [kg]."""

    def link_pose(self, link: str) -> Pose:
        """Return the pose of a link's frame."""

    def root_pose(self) -> Pose:
        """Return the pose of the root link's frame."""

    def root_twist(self) -> Twist:
        """Return the velocity of the root link's frame, in that frame."""

    def brick_pose(self, index: int) -> Pose:
        """Return the pose of a brick's centre."""

    def hold(self, index: int) -> None:
        """Fix a brick to the hand as it lies there."""

    def release(self) -> None:
        """Let go of the brick that is held."""

    def grip_force(self) -> Vector:
        """Return the force between hand and held brick in the last step, in [N]."""

    def keep(self) -> None:
        """Take the present state as the one at time 0."""

    def restart(self) -> None:
        """Go back to time 0, with the payload of the settings."""

    def close(self) -> None:
        """Free the engine; a second call does nothing."""
