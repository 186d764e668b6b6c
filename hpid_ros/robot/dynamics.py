"""Rigid-body dynamics of a robot: inertias, equations of motion, and efforts of a motion."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
import pinocchio

from hpid_ros.base.errors import RobotDescriptionError, SettingError
from hpid_ros.base.units import Numbers
from hpid_ros.robot.description import PAYLOAD_EDGE, RobotDescription, listed
from hpid_ros.robot.differential_drive import DifferentialDrive
from hpid_ros.robot.mending import MOVING_TYPES

PAYLOAD_LINK = "payload"


def bare_model(
    description: RobotDescription, root: pinocchio.JointModel | None = None
) -> pinocchio.Model:
    """Build the model that a URDF describes."""
    description.require_sound()
    xml = _with_limits(description.xml)
    try:
        return pinocchio.buildModelFromXML(xml, *(() if root is None else (root,)))
    except (ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise RobotDescriptionError(f"Pinocchio cannot read the robot: {reason}") from error


def _with_limits(xml: str) -> str:
    """Return a URDF whose joints have limits of effort and velocity, 0 where they had none.

    The parser refuses joints without, and their model's dynamics do not look at them.
    """
    robot = ElementTree.fromstring(xml)
    is_whole = True
    for joint in robot.findall("joint"):
        if joint.get("type") not in MOVING_TYPES:
            continue
        limit = joint.find("limit")
        if limit is None:
            limit = ElementTree.SubElement(joint, "limit")
        for name in ("effort", "velocity"):
            if limit.get(name) is None:
                limit.set(name, "0")
                is_whole = False
    return xml if is_whole else ElementTree.tostring(robot, encoding="unicode")


def build_model(
    description: RobotDescription,
    root: pinocchio.JointModel | None = None,
    *,
    payload_mass: float = 0.0,
    payload_link: str = PAYLOAD_LINK,
    mass_scale: float = 1.0,
    locked: Iterable[str] = (),
) -> pinocchio.Model:
    if not (math.isfinite(payload_mass) and payload_mass >= 0.0):
        raise SettingError(f"payload_mass {payload_mass!r} must be a finite number >= 0 [kg]")
    if not (math.isfinite(mass_scale) and mass_scale > 0.0):
        raise SettingError(f"mass_scale {mass_scale!r} must be a positive number")
    model = bare_model(description, root)
    held = [joint.name for joint in description.select(locked)]
    if held:
        indices = [model.getJointId(name) for name in held]
        model = pinocchio.buildReducedModel(model, indices, pinocchio.neutral(model))
    if mass_scale != 1.0:
        for index in range(model.njoints):
            body = model.inertias[index]
            scaled = pinocchio.Inertia(
                mass_scale * body.mass, body.lever, mass_scale * body.inertia
            )
            model.inertias[index] = scaled
    armature = np.zeros(model.nv)
    for joint in description.joints.values():
        if joint.name not in held:
            armature[velocity_index(model, joint.name)] = joint.reflected_inertia
    model.armature = armature
    if payload_mass:
        frame = model.frames[link_frame(model, description.link(payload_link))]
        moments = payload_mass * PAYLOAD_EDGE**2 / 6.0 * np.eye(3)
        load = pinocchio.Inertia(payload_mass, np.zeros(3), moments)
        model.appendBodyToJoint(frame.parentJoint, load, frame.placement)
    return model


MOST_COMPUTED = 150
"""Moving joints of a robot whose dynamics are computed: Pinocchio's data grow with their cube."""


def data_of(model: pinocchio.Model) -> pinocchio.Data:
    """Return what Pinocchio computes a model's dynamics in."""
    if model.njoints - 1 > MOST_COMPUTED:
        raise RobotDescriptionError(
            f"robot {model.name!r} has {model.njoints - 1} moving joints, and dynamics are "
            f"computed for {MOST_COMPUTED} at most"
        )
    return model.createData()


def velocity_index(model: pinocchio.Model, joint: str) -> int:
    """Return where a joint's velocity stands in the model's velocity vector."""
    return int(model.joints[model.getJointId(joint)].idx_v)


def link_frame(model: pinocchio.Model, link: str) -> int:
    """Return the index of a link's frame; a joint may have the same name."""
    return int(model.getFrameId(link, pinocchio.FrameType.BODY))


class InertiaRange(NamedTuple):
    """What one joint's motor has to accelerate, over the poses of a robot, in [kg m^2]."""

    minimum: float  # least effective inertia met
    nominal: float  # effective inertia in the nominal pose
    maximum: float  # greatest effective inertia met


class Dynamics:
    """Mass matrix and gravity of a robot in free space.

    Contact with the ground is not part of it: on a fixed base a wheel turns freely, on a
    floating one the robot flies.
    """

    def __init__(
        self,
        description: RobotDescription,
        fixed_base: bool = True,
        payload_mass: float = 0.0,
        payload_link: str = PAYLOAD_LINK,
    ) -> None:
        self.description = description
        self._model = build_model(
            description,
            None if fixed_base else pinocchio.JointModelFreeFlyer(),
            payload_mass=payload_mass,
            payload_link=payload_link,
        )
        self._data = data_of(self._model)

    def mass_matrix(self, names: Iterable[str], positions: Mapping[str, float]) -> Numbers:
        """Return the joints' block of the mass matrix, rotors included, in [kg m^2]."""
        rows = self._rows(names)
        return self._mass(positions)[np.ix_(rows, rows)]

    def joint_inertias(
        self, names: Iterable[str], positions: Mapping[str, float]
    ) -> dict[str, float]:
        """Return what each joint's motor has to accelerate while the others are free to move.

        .. math:: m_j = 1 / (M^{-1})_{jj}

        with :math:`J_r N^2` of each rotor on the diagonal of M.

        Source: the paper, section "Implementation of hPID on the mobile manipulator", B = M^{-1}.
        """
        wanted = tuple(names)
        rows = self._rows(wanted)
        mass = self._mass(positions)
        try:
            mobility = np.diagonal(np.linalg.inv(mass))
        except np.linalg.LinAlgError:
            raise self._massless(mass) from None
        return {name: float(1.0 / mobility[row]) for name, row in zip(wanted, rows, strict=True)}

    def inertia_range(
        self,
        names: Iterable[str],
        samples: int,
        seed: int,
        nominal: Mapping[str, float] | None = None,
    ) -> dict[str, InertiaRange]:
        """Return the effective inertias over poses drawn evenly within the joints' limits."""
        if samples < 1:
            raise SettingError(f"samples {samples} must be >= 1")
        wanted = tuple(names)
        generator = np.random.default_rng(seed)
        centre = self.joint_inertias(wanted, nominal or {})
        poses = [self._draw(generator) for _ in range(samples)]
        met = [centre, *(self.joint_inertias(wanted, pose) for pose in poses)]
        return {
            name: InertiaRange(
                min(one[name] for one in met), centre[name], max(one[name] for one in met)
            )
            for name in wanted
        }

    def gravity_torques(
        self, names: Iterable[str], positions: Mapping[str, float]
    ) -> dict[str, float]:
        """Return the efforts that hold a pose against gravity, in [N m]."""
        wanted = tuple(names)
        rows = self._rows(wanted)
        configuration = self._configuration(positions)
        torques = pinocchio.computeGeneralizedGravity(self._model, self._data, configuration)
        return {name: float(torques[row]) for name, row in zip(wanted, rows, strict=True)}

    def _mass(self, positions: Mapping[str, float]) -> Numbers:
        """Return the whole mass matrix; Pinocchio fills the upper triangle only."""
        mass = pinocchio.crba(self._model, self._data, self._configuration(positions))
        upper = np.triu(mass)
        return upper + np.triu(mass, 1).T

    def _massless(self, mass: Numbers) -> RobotDescriptionError:
        joints = self.description.joints
        names = tuple(name for name in joints if not mass[self._velocity_index(name)].any())
        what = f"{listed(names)} moves" if len(names) == 1 else "joints move"
        what = f"{listed(names)} move" if len(names) > 1 else what
        return RobotDescriptionError(
            f"the mass matrix of {self.description.name!r} cannot be inverted: {what} nothing "
            "that has mass: hold it (robot.held), or say what its link weighs (robot.links)"
        )

    def _configuration(self, positions: Mapping[str, float]) -> Numbers:
        """Return Pinocchio's configuration; a continuous joint's is cosine and sine."""
        motion = np.zeros(self._model.nv)
        for name, position in positions.items():
            row = self._velocity_index(name)
            if not np.isfinite(position):
                raise SettingError(f"position {position} of joint {name!r} is not finite")
            motion[row] = position
        return pinocchio.integrate(self._model, pinocchio.neutral(self._model), motion)

    def _rows(self, names: Iterable[str]) -> list[int]:
        return [self._velocity_index(name) for name in names]

    def _velocity_index(self, name: str) -> int:
        (joint,) = self.description.named([name])
        return velocity_index(self._model, joint.name)

    def _draw(self, generator: np.random.Generator) -> dict[str, float]:
        """Return a pose within the limits; a joint without limits turns all the way round."""
        return {
            joint.name: float(generator.uniform(max(joint.lower, -np.pi), min(joint.upper, np.pi)))
            for joint in self.description.joints.values()
        }


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
        self._data = data_of(self._model)
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


_FORWARD, _YAW = 0, 5  # of the twist of the root link, in its own axes


def wheel_inertias(
    description: RobotDescription,
    drive: DifferentialDrive,
    positions: Mapping[str, float],
    payload_mass: float = 0.0,
    payload_link: str = PAYLOAD_LINK,
) -> dict[str, float]:
    r"""Return what each wheel's motor has to accelerate while the robot rolls on the ground.

    With J the motion of the robot for the two wheel rates, no slip and the other joints held,

    .. math:: m_j = 1 / ((J^T M J)^{-1})_{jj}

    so the other wheel is free to roll. Supporting balls are taken to have no drag and no mass
    of their own.
    """
    robot = Dynamics(description, False, payload_mass, payload_link)
    mass = robot._mass(positions)
    motions = np.zeros((mass.shape[0], 2))
    for column, rates in enumerate(((1.0, 0.0), (0.0, 1.0))):
        motions[_FORWARD, column], motions[_YAW, column] = drive.twist(*rates)
        motions[robot._velocity_index(drive.joints[column]), column] = 1.0
    mobility = np.diagonal(np.linalg.inv(motions.T @ mass @ motions))
    return {joint: float(1.0 / each) for joint, each in zip(drive.joints, mobility, strict=True)}


_RATIO = 100.0  # of a gear of which nothing is said


class InverseDynamics:
    """The links of a robot on a fixed base: neither rotors nor friction."""

    def __init__(
        self,
        description: RobotDescription,
        joints: Sequence[str],
        others: Mapping[str, float] | None = None,
    ) -> None:
        for name in (*joints, *(others or {})):
            description.named([name])
        self._model = build_model(description)
        self._model.armature = np.zeros(self._model.nv)
        self._data = data_of(self._model)
        model = self._model
        self._rows = [velocity_index(model, name) for name in joints]
        rest = np.zeros(model.nv)
        for name, position in (others or {}).items():
            rest[velocity_index(model, name)] = position
        self._rest = rest
        self._rotors = [_Rotor.of(model, description, name) for name in joints]

    def efforts(self, positions: Numbers, velocities: Numbers, accelerations: Numbers) -> Numbers:
        """Return the efforts, (K, R), in [N m]; in [N] where a joint slides."""
        found = np.empty_like(positions)
        for k, state in enumerate(self._states(positions, velocities, accelerations)):
            found[:, k] = pinocchio.rnea(self._model, self._data, *state)[self._rows]
        return found

    def spin(
        self, positions: Numbers, velocities: Numbers, accelerations: Numbers, rotors: Numbers
    ) -> Numbers:
        r"""Return the efforts, (K, R), that rotors need besides their reflected inertia, in [N m].

        A rotor behind a gear of ratio N that spins about its joint's axis z, on the link before
        the joint, has the angular momentum :math:`h = m/N\,\dot q\,z` in that link. The link must
        turn it, and the joint feels :math:`m/N\,\alpha\cdot z` of the link's acceleration.
        """
        model, data = self._model, self._data
        momenta = [
            (each, rotor / each.ratio)
            for each, rotor in zip(self._rotors, rotors, strict=True)
            if each.ratio and rotor
        ]
        found = np.empty_like(positions)
        for k, state in enumerate(self._states(positions, velocities, accelerations)):
            _, velocity, acceleration = state
            plain = pinocchio.rnea(model, data, *state).copy()
            forces = pinocchio.StdVec_Force([pinocchio.Force.Zero()] * model.njoints)
            own = np.zeros(model.nv)
            for each, size in momenta:
                turn, swing = data.v[each.parent].angular, data.a_gf[each.parent].angular
                own[each.row] += size * float(swing @ each.axis)
                rate, change = velocity[each.row], acceleration[each.row]
                torque = size * (change * each.axis + rate * np.cross(turn, each.axis))
                forces[each.parent] -= pinocchio.Force(np.zeros(3), torque)
            pulled = pinocchio.rnea(model, data, *state, forces)
            found[:, k] = (pulled - plain + own)[self._rows]
        return found

    def _states(
        self, positions: Numbers, velocities: Numbers, accelerations: Numbers
    ) -> Iterator[tuple[Numbers, Numbers, Numbers]]:
        """Yield configuration, velocity and acceleration of the model at each instant."""
        model, rows = self._model, self._rows
        neutral = pinocchio.neutral(model)
        motion, velocity, acceleration = self._rest.copy(), *np.zeros((2, model.nv))
        for k in range(positions.shape[1]):
            motion[rows] = positions[:, k]
            velocity[rows] = velocities[:, k]
            acceleration[rows] = accelerations[:, k]
            yield pinocchio.integrate(model, neutral, motion), velocity, acceleration


class _Rotor(NamedTuple):
    """Where a joint's rotor is: on the link before it, about the joint's axis."""

    row: int  # of the joint's velocity
    parent: int  # the joint that moves that link
    axis: Numbers  # in that joint's frame
    ratio: float  # of the gear; 0 of a joint that slides, whose rotor may be anywhere

    @classmethod
    def of(cls, model: pinocchio.Model, description: RobotDescription, name: str) -> _Rotor:
        joint, index = description.joints[name], model.getJointId(name)
        axis = model.jointPlacements[index].rotation @ np.asarray(joint.axis)
        ratio = joint.gear_ratio if abs(joint.gear_ratio) > 1.0 else _RATIO
        return cls(
            velocity_index(model, name),
            int(model.parents[index]),
            axis / np.linalg.norm(axis),
            0.0 if joint.is_slide else ratio,
        )


_SEED = 1  # of the poses over which inertias are sampled


def inertia_ranges(
    description: RobotDescription,
    joints: Sequence[str],
    payload: float,
    poses: int | Sequence[Mapping[str, float]],
) -> dict[str, tuple[float, float]]:
    """Return the least and the largest inertia that each joint's motor has to accelerate.

    It is 1 / (M^-1)_jj on a fixed base, rotors included; a wheel on the ground accelerates the
    robot as well, which is not in it.
    """
    names = list(dict.fromkeys(joints))
    found: dict[str, list[float]] = {name: [] for name in names}
    for mass in sorted({0.0, payload}):
        dynamics = Dynamics(description, payload_mass=mass)
        if isinstance(poses, int):
            for name, each in dynamics.inertia_range(names, poses, _SEED).items():
                found[name] += [each.minimum, each.maximum]
        else:
            for pose in poses:
                known = {name: at for name, at in pose.items() if name in description.joints}
                for name, inertia in dynamics.joint_inertias(names, known).items():
                    found[name].append(inertia)
    return {name: (min(each), max(each)) for name, each in found.items()}
