"""The end effector of a recorded run in the task frame, by forward kinematics.

The task frame is ``odom``: where the base stood at the first state. Reference and run both come
from the recorded joint series: the arm's by forward kinematics, the wheels' by the arcs of
:func:`~hpid_ros.robot.differential_drive.integrated`, both from the wheels' first measured
positions on. So any bag with a URDF gives it. Without a base the frame is the root link.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from hpid_ros.base.errors import BagError, RobotDescriptionError
from hpid_ros.base.units import Numbers
from hpid_ros.messages.messages import PoseColumns
from hpid_ros.messages.series import JointSeries, RunSeries
from hpid_ros.metrics.task import EndEffectorFigures, EndEffectorPath, PoseDeviation
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.differential_drive import DifferentialDrive, integrated
from hpid_ros.robot.kinematics import Kinematics, LinkPoses, axis_rotations, rotation_angles

_BLOCK = 50_000  # instants at a time: memory stays small for recordings of hours
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class TaskFrame:
    """A robot and the link whose pose counts."""

    description: RobotDescription  # the robot
    link: str  # name of the link
    base: DifferentialDrive | None = None  # its base
    others: Mapping[str, float] = field(default_factory=dict)
    # whether a recording in which the link cannot be followed is an error
    is_required: bool = True


def moving_joints(description: RobotDescription, link: str) -> frozenset[str]:
    """Return the joints that move a link against the root."""
    try:
        return frozenset(Kinematics(description, link).joints)
    except RobotDescriptionError:
        return frozenset()


class EndEffector:
    """The end effector of one run, at the states of its first joint."""

    def __init__(self, frame: TaskFrame, run: RunSeries) -> None:
        self._frame = frame
        self._series = {each.joint: each for each in run.joints}
        chain = Kinematics(frame.description, frame.link).joints
        recorded = [joint for joint in chain if joint in self._series]
        if not recorded:
            raise BagError(
                f"run {run.label!r} has no joint that moves {frame.link!r}: it has "
                f"{', '.join(self._series)}, but the link moves with {', '.join(chain)}"
            )
        unknown = [joint for joint in recorded if not self._series[joint].has_reference]
        if unknown:
            raise BagError(
                f"run {run.label!r}: how far {frame.link!r} was from its reference is not known: "
                f"no reference of {', '.join(unknown)} was recorded (--reference gives one)"
            )
        others = {
            name: position
            for name, position in frame.others.items()
            if name not in recorded and name in frame.description.joints
        }
        self._arm = Kinematics(frame.description, frame.link, recorded, others)
        self._label = run.label
        self._stamps_ns = self._series[recorded[0]].state_stamps_ns
        self._bases = self._base_poses()

    @property
    def frame(self) -> str:
        """Name of the task frame."""
        return "odom" if self._bases is not None else self._frame.description.root

    def figures(self, truth: PoseColumns | None = None) -> EndEffectorFigures:
        """Return the deviations of the whole run."""
        blocks = [
            _deviations(self._poses("reference", block), self._poses("position", block))
            for block in self._blocks()
        ]
        distances, angles = (np.concatenate(each) for each in zip(*blocks, strict=True))
        tracking = PoseDeviation.of(distances, angles)
        true = None if truth is None else self._against(truth)
        return EndEffectorFigures(self._frame.link, self.frame, tracking, true)

    def path(self, points: int) -> EndEffectorPath:
        """Return the paths for a figure."""
        every = np.arange(0, len(self._stamps_ns), max(1, len(self._stamps_ns) // points))
        reference, position = (self._poses(what, every) for what in ("reference", "position"))
        return EndEffectorPath(self._label, reference.positions, position.positions)

    def _against(self, truth: PoseColumns) -> PoseDeviation | None:
        """Compare the reference with true poses at the states that they belong to."""
        _, here, there = np.intersect1d(
            self._stamps_ns, truth.stamps_ns, assume_unique=True, return_indices=True
        )
        if not len(here):
            return None
        true = LinkPoses(truth.positions[there, 0], _matrices(truth.orientations[there, 0]))
        return PoseDeviation.of(*_deviations(self._poses("reference", here), true))

    def _blocks(self) -> Iterator[npt.NDArray[np.int64]]:
        count = len(self._stamps_ns)
        for begin in range(0, count, _BLOCK):
            yield np.arange(begin, min(begin + _BLOCK, count))

    def _poses(self, what: str, at: npt.NDArray[np.int64]) -> LinkPoses:
        """Return the link in the task frame."""
        columns = [self._column(self._series[joint], what)[at] for joint in self._arm.joints]
        poses = self._arm.poses(np.column_stack(columns))
        if self._bases is None:
            return poses
        x, y, heading = self._bases[what][at].T
        turns = axis_rotations(_UP, heading)
        origins = np.column_stack([x, y, np.zeros_like(x)])
        positions = origins + np.einsum("nij,nj->ni", turns, poses.positions)
        return LinkPoses(positions, turns @ poses.rotations)

    def _base_poses(self) -> dict[str, Numbers] | None:
        """Return x, y and heading of the base at the states, wanted and by its odometry."""
        base = self._frame.base
        if base is None:
            return None
        missing = [wheel for wheel in base.joints if wheel not in self._series]
        if len(missing) == 1:
            raise BagError(f"run {self._label!r} lacks the wheel {missing[0]!r}")
        if missing:
            return None
        wheels = [self._series[wheel] for wheel in base.joints]
        found = {}
        for what in ("reference", "position"):
            left, right = (
                np.concatenate((each.position[:1], self._column(each, what))) for each in wheels
            )
            found[what] = integrated(base, left, right)[1:]
        return found

    def _column(self, series: JointSeries, what: str) -> Numbers:
        """Return a joint's numbers at the common stamps."""
        values: Numbers = getattr(series, what)
        own = series.state_stamps_ns
        if own is self._stamps_ns or np.array_equal(own, self._stamps_ns):
            return values
        origin = own[0]  # differences of stamps are exact as doubles, stamps are not
        between: Numbers = np.interp(
            (self._stamps_ns - origin).astype(float), (own - origin).astype(float), values
        )
        return between


def _deviations(one: LinkPoses, other: LinkPoses) -> tuple[Numbers, Numbers]:
    distances = np.linalg.norm(one.positions - other.positions, axis=1)
    return distances, rotation_angles(one.rotations, other.rotations)


def _matrices(quaternions: Numbers) -> Numbers:
    """Return quaternions x, y, z, w, (N, 4), as rotation matrices, (N, 3, 3).

    SciPy's agree to 1e-15, and not to the last bit, which is in the numbers of a result.
    """
    x, y, z, w = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)
