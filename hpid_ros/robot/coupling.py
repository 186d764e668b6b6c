r"""Decoupled joints that use each other's last efforts: whether they settle.

Each joint's node computes its effort from the *last* efforts of the others. With the mass matrix
M, :math:`B = M^{-1}` and :math:`D = \mathrm{diag}\,B`, the nodes together iterate

.. math:: u^+ = D^{-1} (b - (B - D) f), \qquad f^+ = f + \alpha (u^+ - f)

once a sample: a Jacobi iteration, relaxed by the filter on the measured efforts,
:math:`\alpha = T / (\tau + T)`. Its eigenvalues are :math:`1 - \alpha\mu` with those
:math:`\mu > 0` of :math:`D^{-1} B`. Their sum is the number n of joints, so that
:math:`\alpha \le 2/n` settles for every robot; without a filter it settles where all
:math:`\mu < 2`. With :math:`\alpha = 1/\mu_{max}` no part of it alternates.

Source: Y. Saad, *Iterative Methods for Sparse Linear Systems*, section 4.2 (Jacobi iteration),
4.1 (relaxation).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio

from hpid_ros.base.errors import RobotDescriptionError, SettingError
from hpid_ros.base.units import Numbers
from hpid_ros.control.settings import LoopSettings
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.differential_drive import DifferentialDrive
from hpid_ros.robot.dynamics import PAYLOAD_LINK, build_model, velocity_index

_PLANAR = 3  # velocities of a planar root: forward, sideways, turning, in its own frame


class Equations(NamedTuple):
    r"""Equations of motion :math:`M \ddot q + h = u` at one state."""

    mass: Numbers  # [kg m^2] M, (n, n)
    bias: Numbers  # [N m] h: Coriolis, centrifugal, gravity and viscous friction, (n,)


class JointSpace:
    r"""A robot whose coordinates are its moving joints and nothing else.

    A rolling base adds none: its wheels do not slip, so that with the velocity of the root in
    the root's own frame the rates of all bodies are :math:`\nu = S \dot q` with a constant S,
    and

    .. math:: M = S' M_\nu S, \qquad h = S' h_\nu(q, S \dot q).

    Rotors and viscous friction of the URDF belong to the model, Coulomb friction does not. The
    ground is level.

    Source: R. M. Murray, Z. Li, S. S. Sastry, *A Mathematical Introduction to Robotic
    Manipulation*, section 6.1 (constraints that are linear in the velocities).
    """

    def __init__(
        self,
        description: RobotDescription,
        drive: DifferentialDrive | None = None,
        *,
        payload_mass: float = 0.0,
        payload_link: str = PAYLOAD_LINK,
        mass_scale: float = 1.0,
        locked: Iterable[str] = (),
    ) -> None:
        held = tuple(locked)
        self._model = build_model(
            description,
            None if drive is None else pinocchio.JointModelPlanar(),
            payload_mass=payload_mass,
            payload_link=payload_link,
            mass_scale=mass_scale,
            locked=held,
        )
        self._data = self._model.createData()
        self.description = description
        moving = [joint.name for joint in description.joints.values() if joint.name not in held]
        self.joints = tuple(sorted(moving, key=lambda name: velocity_index(self._model, name)))
        self._damping = np.array([description.joints[name].damping for name in self.joints])
        self._rolling = None if drive is None else self._no_slip(drive)
        self._configuration = pinocchio.neutral(self._model)
        self._places = [
            (model.idx_q, model.nq == 2)
            for model in (self._model.joints[self._model.getJointId(name)] for name in self.joints)
        ]
        self._require_mass()

    def equations(self, positions: Sequence[float], velocities: Sequence[float]) -> Equations:
        """Return the equations of motion at one state."""
        model, data, rates = self._model, self._data, np.array(velocities)
        configuration = self._at(positions)
        rolling = self._rolling
        if rolling is None:
            mass = pinocchio.crba(model, data, configuration)
            bias = pinocchio.nonLinearEffects(model, data, configuration, rates)
        else:
            mass = rolling.T @ (pinocchio.crba(model, data, configuration) @ rolling)
            bias = rolling.T @ pinocchio.nonLinearEffects(
                model, data, configuration, rolling @ rates
            )
        return Equations(mass, bias + self._damping * rates)

    def gravity(self, positions: Sequence[float]) -> Numbers:
        """Return the efforts that hold the joints against gravity, in [N m]."""
        torques = pinocchio.computeGeneralizedGravity(self._model, self._data, self._at(positions))
        return torques if self._rolling is None else self._rolling.T @ torques

    def _at(self, positions: Sequence[float]) -> Numbers:
        """Return Pinocchio's configuration; a continuous joint's is cosine and sine."""
        configuration = self._configuration
        for (place, is_turning), position in zip(self._places, positions, strict=True):
            if is_turning:
                configuration[place] = math.cos(position)
                configuration[place + 1] = math.sin(position)
            else:
                configuration[place] = position
        return configuration

    def _no_slip(self, drive: DifferentialDrive) -> Numbers:
        """Return S: the model's velocities for unit rates of the joints."""
        self.description.select(drive.joints)
        matrix = np.zeros((self._model.nv, len(self.joints)))
        for column, name in enumerate(self.joints):
            matrix[_PLANAR + column, column] = 1.0
            if name in drive.joints:
                twist = drive.twist(float(name == drive.left), float(name == drive.right))
                matrix[0, column], matrix[2, column] = twist
        return matrix

    def _require_mass(self) -> None:
        """Refuse a robot whose equations cannot be solved for the accelerations."""
        rest = (0.0,) * len(self.joints)
        least = np.linalg.eigvalsh(self.equations(rest, rest).mass)[0]
        if not least > 0.0:
            raise RobotDescriptionError(
                f"the robot's mass matrix must be positive definite: its least eigenvalue is "
                f"{least:g} kg m^2, a joint moves no mass"
            )


POSES, SEED = 200, 1


class Coupling(NamedTuple):
    """How strongly the joints of a robot are coupled, over its poses."""

    least: float  # least eigenvalue of D^-1 B met; 1 for joints that do not feel each other
    largest: float  # largest eigenvalue met
    inertia: tuple[float, ...]  # [kg m^2]

    def radius(self, relaxation: float = 1.0) -> float:
        """Return the factor by which the iteration's error shrinks in each sample."""
        return max(abs(1.0 - relaxation * self.least), abs(1.0 - relaxation * self.largest))

    def filter_time_constant(self, period: float) -> float:
        """Return the shortest filter with which no part of the iteration alternates, in [s]."""
        return period * max(self.largest - 1.0, 0.0)


def coupling(space: JointSpace, samples: int = POSES, seed: int = SEED) -> Coupling:
    """Return the coupling over the zero pose and poses drawn evenly within the joints' limits."""
    if samples < 1:
        raise SettingError(f"samples {samples} must be >= 1")
    joints = [space.description.joints[name] for name in space.joints]
    low = [max(joint.lower, -math.pi) for joint in joints]
    high = [min(joint.upper, math.pi) for joint in joints]
    draw = np.random.default_rng(seed).uniform(low, high, (samples, len(joints)))
    rest = (0.0,) * len(joints)
    least, largest, inertia = 1.0, 1.0, np.full(len(joints), np.inf)
    for pose in (np.zeros(len(joints)), *draw):
        mobility = np.linalg.inv(space.equations(pose.tolist(), rest).mass)
        own = np.diagonal(mobility)
        scale = 1.0 / np.sqrt(own)
        values = np.linalg.eigvalsh(mobility * np.outer(scale, scale))
        least, largest = min(least, float(values[0])), max(largest, float(values[-1]))
        inertia = np.minimum(inertia, 1.0 / own)
    return Coupling(least, largest, tuple(inertia.tolist()))


def relaxation(time_constant: float, period: float) -> float:
    """Return alpha of a first-order filter by backward Euler."""
    return period / (time_constant + period)


class Settling(NamedTuple):
    """What is known of the joints' efforts."""

    time_constant: float  # [s] of the low-pass on the other joints' efforts
    radius: float  # factor by which the efforts' errors shrink in each sample, at the worst pose
    text: str  # the finding in one line, for people

    @property
    def is_settling(self) -> bool:
        """Whether the errors shrink."""
        return self.radius < 1.0

    @classmethod
    def of(cls, settings: LoopSettings, coupling: Coupling) -> Settling:
        period = settings.timing.control_period
        time_constant = settings.model.effort_filter_time_constant
        if time_constant < 0.0:
            time_constant = coupling.filter_time_constant(period)
        radius = coupling.radius(relaxation(time_constant, period))
        if radius < 1.0:
            text = (
                f"efforts of the other joints, filtered by {1e3 * time_constant:.3g} ms, settle "
                f"by a factor {radius:.2f} in each sample (without a filter "
                f"{coupling.radius():.2f}), over {POSES} poses"
            )
        else:
            shortest = period * (0.5 * coupling.largest - 1.0)
            text = (
                f"decoupled joints would not settle: in each sample their last efforts change "
                f"the next ones by a factor of up to {radius:.3g}; "
                f"model.effort_filter_time_constant must exceed {shortest:.3g} s, "
                f"not {time_constant:g} s (-1 chooses it)"
            )
        return cls(time_constant, radius, text)


def settling_of(loops: Iterable[LoopSettings], robot: str) -> list[Settling]:
    """Judge loops with decoupling; those of one model and one rate are judged once."""
    from hpid_ros.robot.compensation import coupling_of

    different = {(each.model, each.timing.control_period): each for each in loops}
    return [Settling.of(each, coupling_of(each, robot)) for each in different.values()]
