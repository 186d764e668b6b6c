"""Forward kinematics: poses of links at many instants.

Forward kinematics and Jacobian are Pinocchio's. The inverse is a least-squares problem with
bounds: the pose error, a twist ``log6`` of SE(3), is made zero within the joints' limits by the
trust-region reflective method of ``scipy.optimize.least_squares``, which respects the limits at
every iterate instead of cutting off a step at them. Where the first start ends in a local minimum
others are drawn from a fixed seed, so that the same question has the same answer.

Sources: M. A. Branch, T. F. Coleman, Y. Li, *A subspace, interior, and conjugate gradient method
for large-scale bound-constrained minimization problems*, SIAM J. Sci. Comput. 21 (1999), the
method; P. Beeson, B. Ames, *TRAC-IK*, Humanoids 2015, why the inverse is posed as an optimisation
with limits and started again from random poses.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pinocchio

from hpid_ros.base.errors import ReachError, RobotDescriptionError, SettingError
from hpid_ros.base.units import Numbers
from hpid_ros.robot.description import LinkPose, RobotDescription
from hpid_ros.robot.dynamics import bare_model, data_of, link_frame, velocity_index


class LinkPoses(NamedTuple):
    """A frame at n instants."""

    positions: Numbers  # [m] origins, shape (n, 3)
    rotations: Numbers  # axes as columns, shape (n, 3, 3)


class ChainJoint(NamedTuple):
    """One joint between the root and the link."""

    # of the joint's frame at position 0 in the frame of the joint before, (3, 3)
    rotation: Numbers
    origin: Numbers  # [m] of the same, (3,)
    axis: Numbers  # unit axis in the joint's frame, (3,)
    is_prismatic: bool  # it slides along the axis; otherwise it turns about it
    column: int | None  # where its position stands among the positions given
    still: float  # [rad] its position where column is None


def axis_rotations(axis: Numbers, angles: Numbers) -> Numbers:
    """Return rotations about one axis, by Rodrigues' formula.

    SciPy's rotations agree to 1e-15, and not to the last bit, which is in the numbers of a
    result.
    """
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sines, cosines = np.sin(angles)[:, None, None], np.cos(angles)[:, None, None]
    return np.asarray(np.eye(3) + sines * cross + (1.0 - cosines) * (cross @ cross))


def rotation_angles(rotations: Numbers, others: Numbers) -> Numbers:
    """Return the angles of the rotations that lead from some to others.

    Exact also for small angles, where the arc cosine of the trace is not.
    """
    # |R - S| (Frobenius) = 2 sqrt(2) sin(angle / 2)
    chord = np.linalg.norm(rotations - others, axis=(1, 2)) / (2.0 * np.sqrt(2.0))
    return np.asarray(2.0 * np.arcsin(np.minimum(chord, 1.0)))


CLOSE_ENOUGH = 1e-7  # norm of the pose error [m, rad] of a solution
STARTS = 24  # the given one, and those that are drawn
_ITERATIONS = 100  # of one start
_SEED = 2511


class Kinematics:
    """One link of a robot, moved by some of its joints; the others stand at given positions."""

    def __init__(
        self,
        description: RobotDescription,
        link: str,
        joints: Iterable[str] | None = None,
        others: Mapping[str, float] | None = None,
    ) -> None:
        self.description = description
        self.link = description.link(link)
        self._model = bare_model(description)
        self._data = data_of(self._model)
        self._frame = link_frame(self._model, link)
        chosen = description.select(self._chain() if joints is None else joints)
        if not chosen:
            raise RobotDescriptionError(f"no joint moves the link {link!r}")
        self.joints = tuple(joint.name for joint in chosen)
        self.lower = np.array([joint.lower for joint in chosen])
        self.upper = np.array([joint.upper for joint in chosen])
        self._rows = [velocity_index(self._model, name) for name in self.joints]
        self._motion = np.zeros(self._model.nv)
        for name, position in (others or {}).items():
            (joint,) = description.select([name])
            if not np.isfinite(position):
                raise SettingError(f"position {position} of joint {name!r} is not finite")
            self._motion[velocity_index(self._model, joint.name)] = position
        self._neutral = pinocchio.neutral(self._model)
        self._links = [self._chain_joint(name) for name in self._chain()]

    def pose(self, positions: npt.ArrayLike) -> LinkPose:
        placement = self._placement(self._checked(positions))
        return LinkPose(placement.translation.copy(), placement.rotation.copy())

    def jacobian(self, positions: npt.ArrayLike) -> Numbers:
        """Return the velocity of the link for each joint's velocity."""
        return self._jacobian(self._checked(positions), pinocchio.LOCAL_WORLD_ALIGNED)

    def poses(self, positions: npt.ArrayLike) -> LinkPoses:
        """Return where the link is at many instants; equal to :meth:`pose`, and much faster."""
        values = np.asarray(positions, dtype=float)
        count = len(values)
        origins = np.zeros((count, 3))
        rotations = np.broadcast_to(np.eye(3), (count, 3, 3))
        for joint in self._links:
            origins = origins + rotations @ joint.origin
            rotations = rotations @ joint.rotation
            still = joint.column is None
            angles = np.full(count, joint.still) if still else values[:, joint.column]
            if joint.is_prismatic:
                origins = origins + (rotations @ joint.axis) * angles[:, None]
            else:
                rotations = rotations @ axis_rotations(joint.axis, angles)
        tip = self._model.frames[self._frame].placement
        return LinkPoses(origins + rotations @ tip.translation, rotations @ tip.rotation)

    def solve(self, target: LinkPose, start: npt.ArrayLike) -> Numbers:
        """Return positions within the limits that put the link at a pose.

        Of several solutions it is, as a rule, one near the start.
        """
        from scipy.optimize import least_squares  # slow to import, and only needed here

        wanted = pinocchio.SE3(np.array(target.rotation), np.array(target.position))
        generator = np.random.default_rng(_SEED)
        begin = np.clip(self._checked(start), self.lower, self.upper)
        low, high = np.maximum(self.lower, -np.pi), np.minimum(self.upper, np.pi)
        best, best_error = begin, np.full(6, np.inf)
        for _ in range(STARTS):
            found = least_squares(
                self._error,
                begin,
                jac=self._error_jacobian,
                bounds=(self.lower, self.upper),
                xtol=1e-14,
                ftol=1e-14,
                gtol=1e-14,
                max_nfev=_ITERATIONS,
                args=(wanted,),
            )
            if np.linalg.norm(found.fun) < np.linalg.norm(best_error):
                best, best_error = np.clip(found.x, self.lower, self.upper), found.fun
            if np.linalg.norm(best_error) < CLOSE_ENOUGH:
                return np.asarray(best)
            begin = generator.uniform(low, high)
        metres = float(np.linalg.norm(self._placement(best).translation - wanted.translation))
        angle = float(np.linalg.norm(best_error[3:]))
        x, y, z = wanted.translation
        raise ReachError(
            f"{self.link} cannot be put at ({x:.3f}, {y:.3f}, {z:.3f}) m of "
            f"{self.description.root} within the joints' limits; the nearest pose is "
            f"{metres:.3f} m and {angle:.3f} rad away"
        )

    def _error(self, positions: Numbers, wanted: pinocchio.SE3) -> Numbers:
        """Return the twist that leads from the link to the wanted pose in one unit of time."""
        twist = pinocchio.log6(self._placement(positions).actInv(wanted)).vector
        return np.asarray(twist)

    def _error_jacobian(self, positions: Numbers, wanted: pinocchio.SE3) -> Numbers:
        columns = self._jacobian(positions, pinocchio.LOCAL)
        apart = wanted.actInv(self._placement(positions))
        return np.asarray(-pinocchio.Jlog6(apart) @ columns)

    def _placement(self, positions: Numbers) -> pinocchio.SE3:
        pinocchio.forwardKinematics(self._model, self._data, self._configuration(positions))
        return pinocchio.updateFramePlacement(self._model, self._data, self._frame)

    def _jacobian(self, positions: Numbers, frame: pinocchio.ReferenceFrame) -> Numbers:
        whole = pinocchio.computeFrameJacobian(
            self._model, self._data, self._configuration(positions), self._frame, frame
        )
        return np.asarray(whole[:, self._rows])

    def _configuration(self, positions: Numbers) -> Numbers:
        """Return Pinocchio's configuration; a continuous joint's is cosine and sine."""
        self._motion[self._rows] = positions
        return np.asarray(pinocchio.integrate(self._model, self._neutral, self._motion))

    def _checked(self, positions: npt.ArrayLike) -> Numbers:
        values = np.asarray(positions, dtype=float)
        if values.shape != (len(self.joints),) or not np.isfinite(values).all():
            raise SettingError(
                f"positions must be {len(self.joints)} finite numbers, one for each of "
                f"{', '.join(self.joints)}; not {values.tolist()}"
            )
        return values

    def _chain(self) -> list[str]:
        """Return the joints between the root and the link, from the root on."""
        parent = self._model.frames[self._frame].parentJoint
        return [self._model.names[index] for index in self._model.supports[parent] if index]

    def _chain_joint(self, name: str) -> ChainJoint:
        placement = self._model.jointPlacements[self._model.getJointId(name)]
        joint = self.description.joints[name]
        axis = np.array(joint.axis) / np.linalg.norm(joint.axis)
        column = self.joints.index(name) if name in self.joints else None
        still = float(self._motion[velocity_index(self._model, name)])
        rotation, origin = placement.rotation.copy(), placement.translation.copy()
        return ChainJoint(rotation, origin, axis, joint.is_slide, column, still)


def link_poses(
    description: RobotDescription, positions: Mapping[str, Numbers], count: int
) -> dict[str, LinkPoses]:
    """Return where each link is in the frame of the root link."""
    model = bare_model(description)
    data = data_of(model)
    frames = {name: link_frame(model, name) for name in description.links}
    motions = np.zeros((count, model.nv))
    for joint in description.select(positions):
        motions[:, velocity_index(model, joint.name)] = positions[joint.name]
    neutral = pinocchio.neutral(model)
    poses = {name: LinkPoses(np.empty((count, 3)), np.empty((count, 3, 3))) for name in frames}
    for k, motion in enumerate(motions):
        pinocchio.framesForwardKinematics(model, data, pinocchio.integrate(model, neutral, motion))
        for name, frame in frames.items():
            placement = data.oMf[frame]
            poses[name].positions[k] = placement.translation
            poses[name].rotations[k] = placement.rotation
    return poses
