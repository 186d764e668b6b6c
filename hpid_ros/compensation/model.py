r"""What one joint's effort has to be besides its controller's: gravity, or all of the dynamics.

The paper's control action in its corrected form, with :math:`B = M^{-1}`, :math:`A = -B h`:

.. math:: u_j = B_{jj}^{-1} \left[ \ddot q^*_j + v_j - A_j - \sum_{k \ne j} B_{jk} u_k \right]

makes :math:`\ddot q_j = \ddot q^*_j + v_j` whatever the other joints do: the controller's output
:math:`v_j` acts on a unit double integrator. The other joints' efforts :math:`u_k` are measured.

Source: the paper, section "Implementation of hPID on the mobile manipulator"; there the factor
in front of the controller's term is missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
from scipy.linalg import lapack

from hpid_ros.compensation.joint_space import JointSpace

Vector = npt.NDArray[np.float64]
Matrix = npt.NDArray[np.float64]


class State(Protocol):
    """Positions [rad], velocities [rad/s] and efforts [N m] of a robot's joints."""

    @property
    def positions(self) -> Sequence[float]:
        """In [rad]."""

    @property
    def velocities(self) -> Sequence[float]:
        """In [rad/s]."""

    @property
    def efforts(self) -> Sequence[float]:
        """In [N m]."""


class _Solved(NamedTuple):
    """The equations of motion at one state, ready for every joint.

    Attributes:
        factor: Cholesky factor of the mass matrix.
        bias: In [N m].
        efforts: In [N m].
    """

    factor: Matrix
    bias: Vector
    efforts: Vector


class GravityShare:
    """Effort that holds one joint against gravity.

    Args:
        space: The robot.
        joint: One of its joints.
    """

    needs_efforts = False

    def __init__(self, space: JointSpace, joint: str) -> None:
        self.space = space
        self._row = space.joints.index(joint)

    def term(self, state: State) -> tuple[float, float]:
        """Return gain 1 and the effort in [N m] at one state."""
        return 1.0, float(self.space.gravity(state.positions)[self._row])


class RobotDynamics:
    """Solves the equations of motion once for each state, however many joints ask.

    Args:
        space: The robot.
    """

    def __init__(self, space: JointSpace) -> None:
        self.space = space
        self._state: State | None = None
        self._solved: _Solved | None = None

    def at(self, state: State) -> _Solved:
        """Return the solved equations at a state.

        Raises:
            ArithmeticError: The mass matrix is not positive definite, or not finite.
        """
        if state is self._state and self._solved is not None:
            return self._solved
        mass, bias = self.space.equations(state.positions, state.velocities)
        factor, failed = lapack.dpotrf(mass, clean=False)
        if failed:
            raise ArithmeticError("the model's mass matrix is not positive definite")
        self._solved = _Solved(factor, bias, np.array(state.efforts))
        self._state = state
        return self._solved


class DecouplingShare:
    """What decouples one joint from the others.

    Args:
        dynamics: The robot; the joints of one process may share it.
        joint: One of its joints.
    """

    needs_efforts = True

    def __init__(self, dynamics: RobotDynamics, joint: str) -> None:
        self.dynamics = dynamics
        self.space = dynamics.space
        self._row = self.space.joints.index(joint)
        self._unit = np.zeros(len(self.space.joints))
        self._unit[self._row] = 1.0

    def term(self, state: State) -> tuple[float, float]:
        """Return what one unit of acceleration costs, and what the dynamics do, at one state.

        Args:
            state: Of all joints, in the order of ``space.joints``; the joint's own effort is
                not used.

        Returns:
            :math:`1/B_{jj}` in [kg m^2], and the effort in [N m] that is added.

        Raises:
            ArithmeticError: The mass matrix is not positive definite, or not finite.
        """
        factor, bias, efforts = self.dynamics.at(state)
        row = self._row
        column, _ = lapack.dpotrs(factor, self._unit)  # of B, which is symmetric
        gain = 1.0 / float(column[row])
        load = bias - efforts
        load[row] = bias[row]
        return gain, gain * float(column @ load)
