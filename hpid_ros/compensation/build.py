r"""The model that a loop's settings ask for, built and checked before the loop begins.

The paper's control action in its corrected form, with :math:`B = M^{-1}`, :math:`A = -B h`:

.. math:: u_j = B_{jj}^{-1} \left[ \ddot q^*_j + v_j - A_j - \sum_{k \ne j} B_{jk} u_k \right]

makes :math:`\ddot q_j = \ddot q^*_j + v_j` whatever the other joints do: the controller's output
:math:`v_j` acts on a unit double integrator. The other joints' efforts :math:`u_k` are measured.

Source: the paper, section "Implementation of hPID on the mobile manipulator"; there the factor
in front of the controller's term is missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple, Protocol

import numpy as np
from scipy.linalg import lapack

from hpid_ros.base.arrays import Numbers
from hpid_ros.base.errors import RobotDescriptionError, SettingError
from hpid_ros.base.resources import find_resource
from hpid_ros.compensation.coupling import Coupling, Settling, coupling
from hpid_ros.compensation.joint_space import JointSpace
from hpid_ros.compensation.loops import Compensator
from hpid_ros.compensation.states import RobotStates
from hpid_ros.control import LoopSettings
from hpid_ros.control.settings.model import ModelSettings
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.differential_drive import DifferentialDrive


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
    """The equations of motion at one state, ready for every joint."""

    factor: Numbers  # cholesky factor of the mass matrix
    bias: Numbers  # [N m]
    efforts: Numbers  # [N m]


class GravityShare:
    """Effort that holds one joint against gravity."""

    needs_efforts = False

    def __init__(self, space: JointSpace, joint: str) -> None:
        self.space = space
        self._row = space.joints.index(joint)

    def term(self, state: State) -> tuple[float, float]:
        """Return gain 1 and the effort in [N m] at one state."""
        return 1.0, float(self.space.gravity(state.positions)[self._row])


class RobotDynamics:
    """Solves the equations of motion once for each state, however many joints ask."""

    def __init__(self, space: JointSpace) -> None:
        self.space = space
        self._state: State | None = None
        self._solved: _Solved | None = None

    def at(self, state: State) -> _Solved:
        """Return the solved equations at a state."""
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
    """What decouples one joint from the others."""

    needs_efforts = True

    def __init__(self, dynamics: RobotDynamics, joint: str) -> None:
        self.dynamics = dynamics
        self.space = dynamics.space
        self._row = self.space.joints.index(joint)
        self._unit = np.zeros(len(self.space.joints))
        self._unit[self._row] = 1.0

    def term(self, state: State) -> tuple[float, float]:
        """Return what one unit of acceleration costs, and what the dynamics do, at one state."""
        factor, bias, efforts = self.dynamics.at(state)
        row = self._row
        column, _ = lapack.dpotrs(factor, self._unit)  # of B, which is symmetric
        gain = 1.0 / float(column[row])
        load = bias - efforts
        load[row] = bias[row]
        return gain, gain * float(column @ load)


class LoopModel(NamedTuple):
    """One joint's model, ready to run."""

    compensator: Compensator  # gives the term of each state
    text: str  # what it is, in one line for people


def loop_model(settings: LoopSettings, robot: str) -> LoopModel | None:
    """Build the model of one joint's loop."""
    if not settings.model.is_on:
        return None
    dynamics, states = _of_the_robot(settings, robot)
    return LoopModel(_of_the_joint(settings, dynamics, states), _text(settings, robot, dynamics))


def compensators(loops: Sequence[LoopSettings], robot: str) -> list[Compensator | None]:
    """Build the models of the loops of one process; what they have in common they share."""
    shared: dict[tuple[object, ...], tuple[RobotDynamics, RobotStates]] = {}
    found: list[Compensator | None] = []
    for settings in loops:
        if not settings.model.is_on:
            found.append(None)
            continue
        timing = settings.timing
        key = (settings.model, timing.control_period, timing.state_timeout, settings.velocity)
        if key not in shared:
            shared[key] = _of_the_robot(settings, robot)
        found.append(_of_the_joint(settings, *shared[key]))
    return found


def coupling_of(settings: LoopSettings, robot: str) -> Coupling:
    """Return the coupling of the joints of a loop's model, over the robot's poses."""
    return _coupled(settings.model, _source(settings.model, robot))[1]


def with_inertia(settings: LoopSettings, robot: str) -> LoopSettings:
    """Return settings with the joint's inertia, where decoupling leaves it to the model.

    It decides nothing about the law, which acts on a unit double integrator, but the soft stops
    brake with it.
    """
    if not settings.model.is_decoupling or settings.inertia > 0.0:
        return settings
    joints, found = _coupled(settings.model, _source(settings.model, robot))
    _require(settings.joint, joints)
    return replace(settings, inertia=found.inertia[joints.index(settings.joint)])


def robot_xml(source: str) -> str:
    """Return the text of a URDF."""
    if source.lstrip().startswith("<"):
        return source
    return RobotDescription.load(find_resource(source)).xml


def _of_the_robot(settings: LoopSettings, robot: str) -> tuple[RobotDynamics, RobotStates]:
    """Return the dynamics, and what completes the states for them."""
    model = settings.model
    space = _space(model, _source(model, robot))
    time_constant = 0.0
    if model.is_decoupling:
        found = Settling.of(settings, coupling_of(settings, robot))
        if not found.is_settling:
            raise SettingError(found.text)
        time_constant = found.time_constant
    described = space.description.joints
    endless = [name for name in space.joints if described[name].type == "continuous"]
    states = RobotStates(settings, space.joints, model.is_decoupling, time_constant, endless)
    return RobotDynamics(space), states


def _of_the_joint(
    settings: LoopSettings, dynamics: RobotDynamics, states: RobotStates
) -> Compensator:
    """Return one joint's share of the robot's dynamics."""
    _require(settings.joint, states.joints)
    if settings.model.is_decoupling:
        return Compensator(DecouplingShare(dynamics, settings.joint), states)
    return Compensator(GravityShare(dynamics.space, settings.joint), states)


def _text(settings: LoopSettings, robot: str, dynamics: RobotDynamics) -> str:
    """Say in one line what a model is."""
    model = settings.model
    base = (
        f"rolling on {model.left_wheel} and {model.right_wheel}"
        if model.left_wheel
        else "its root held fixed (no model.left_wheel is named)"
    )
    count = len(dynamics.space.joints)
    text = f"compensation {model.compensation}: model of {count} joints, {base}"
    if not model.is_decoupling:
        return text
    return f"{text}; {Settling.of(settings, coupling_of(settings, robot)).text}"


def _source(model: ModelSettings, robot: str) -> str:
    """Return the XML text of the model's robot."""
    source = model.description or robot
    if not source:
        raise SettingError(
            f"compensation {model.compensation} needs the robot: robot_description is empty"
        )
    return robot_xml(source)


def _space(model: ModelSettings, xml: str) -> JointSpace:
    description = RobotDescription.load(xml)
    drive = None
    if model.left_wheel:
        drive = DifferentialDrive.of(
            description,
            model.left_wheel,
            model.right_wheel,
            model.wheel_radius or None,
            model.wheel_separation or None,
        )
    return JointSpace(
        description,
        drive,
        payload_mass=model.payload,
        payload_link=model.payload_link,
        mass_scale=model.mass_scale,
        locked=model.locked,
    )


@lru_cache(maxsize=64)
def _coupled(model: ModelSettings, xml: str) -> tuple[tuple[str, ...], Coupling]:
    """Return the joints of a model and their coupling."""
    space = _space(model, xml)
    return space.joints, coupling(space)


def _require(joint: str, joints: Sequence[str]) -> None:
    if joint not in joints:
        raise RobotDescriptionError(
            f"the model of joint {joint!r} lacks it; it has {', '.join(joints)}"
        )
