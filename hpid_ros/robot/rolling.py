"""What the wheels of a base have to accelerate: the robot that rolls on them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.differential_drive import DifferentialDrive
from hpid_ros.robot.dynamics import Dynamics

_FORWARD, _YAW = 0, 5  # of the twist of the root link, in its own axes


class _RollingRobot(Dynamics):
    """The robot with a free root, seen through wheels that roll and do not slip."""

    def wheel_mass(
        self, drive: DifferentialDrive, positions: Mapping[str, float]
    ) -> dict[str, float]:
        """Return each wheel's effective inertia in [kg m^2]."""
        mass = self._mass(positions)
        motions = np.zeros((mass.shape[0], 2))
        for column, rates in enumerate(((1.0, 0.0), (0.0, 1.0))):
            motions[_FORWARD, column], motions[_YAW, column] = drive.twist(*rates)
            motions[self._velocity_index(drive.joints[column]), column] = 1.0
        mobility = np.diagonal(np.linalg.inv(motions.T @ mass @ motions))
        return {
            joint: float(1.0 / each) for joint, each in zip(drive.joints, mobility, strict=True)
        }


def wheel_inertias(
    description: RobotDescription,
    drive: DifferentialDrive,
    positions: Mapping[str, float],
    payload_mass: float = 0.0,
    payload_link: str = "payload",
) -> dict[str, float]:
    r"""Return what each wheel's motor has to accelerate while the robot rolls on the ground.

    With J the motion of the robot for the two wheel rates, no slip and the other joints held,

    .. math:: m_j = 1 / ((J^T M J)^{-1})_{jj}

    so the other wheel is free to roll. Supporting balls are taken to have no drag and no mass
    of their own.

    Args:
        description: The robot, its root's origin between the wheels.
        drive: The wheels.
        positions: Position of each joint, in [rad]; joints left out are at 0.
        payload_mass: Point mass at the payload link, in [kg].
        payload_link: Link that carries the payload.

    Returns:
        Effective inertia by wheel joint, in [kg m^2].

    Raises:
        RobotDescriptionError: The robot lacks a joint or the payload's link.
        SettingError: A position or the payload is impossible.
    """
    robot = _RollingRobot(description, False, payload_mass, payload_link)
    return robot.wheel_mass(drive, positions)
