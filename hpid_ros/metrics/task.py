"""Quality of a task: the end effector against its reference, the base's slip, the fate of bricks.

An end effector is followed by forward kinematics in the task frame, which is ``odom``: where the
base stood at the first state. Reference and run both come from the recorded joint series: the
arm's by forward kinematics, the wheels' by the arcs of
:func:`~hpid_ros.robot.differential_drive.integrated`, both from the wheels' first measured
positions on. So any bag with a URDF gives it. Without a base the frame is the root link.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field

import numpy as np
import numpy.typing as npt

from hpid_ros.base.errors import BagError, RobotDescriptionError
from hpid_ros.base.units import Numbers
from hpid_ros.messages.messages import PoseColumns
from hpid_ros.messages.series import JointSeries, RunSeries, SeriesError
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.differential_drive import DifferentialDrive, integrated
from hpid_ros.robot.kinematics import Kinematics, LinkPoses, axis_rotations, rotation_angles

SLIP_SHARE = 0.01  # slip that is worth a line: more than this share of the way

SLIP_FLOOR = 0.005  # and more than this, in [m]


@dataclass(frozen=True)
class PoseErrors:
    """Distances between two paths at equal times."""

    final_position: float  # [m] at the end
    final_heading: float  # [rad] at the end, absolute
    largest_position: float  # [m]
    largest_heading: float  # [rad] absolute
    rms_position: float  # [m] root of the mean square over the times
    rms_heading: float  # [rad] likewise

    @classmethod
    def between(cls, one: Numbers, other: Numbers) -> PoseErrors:
        away = np.hypot(*(one - other)[:, :2].T)
        turned = np.abs(np.remainder(one[:, 2] - other[:, 2] + np.pi, 2.0 * np.pi) - np.pi)
        return cls(
            final_position=float(away[-1]),
            final_heading=float(turned[-1]),
            largest_position=float(away.max()),
            largest_heading=float(turned.max()),
            rms_position=float(np.sqrt(np.mean(away**2))),
            rms_heading=float(np.sqrt(np.mean(turned**2))),
        )


@dataclass(frozen=True)
class BaseFigures:
    """What became of a base in one run."""

    path_length: float  # [m] way that the base truly went, there and back both counted
    odometry: PoseErrors  # of the wheels' odometry against the truth
    # of the true base against the path that the wheels' reference describes
    tracking: PoseErrors | None
    slip_left: float  # [m] how far the left wheel slid along its track
    slip_right: float  # [m] how far the right wheel slid along its track
    slip_lateral: float  # [m] how far the axle slid sideways

    @property
    def has_slipped(self) -> bool:
        """Whether slip is worth a line: above 1 % of the way and above 5 mm."""
        slip = max(self.slip_left, self.slip_right, self.slip_lateral)
        return slip > max(SLIP_FLOOR, SLIP_SHARE * self.path_length)

    def line(self, label: str) -> str:
        """Return one line that says what the slip did."""
        return (
            f"{label}: the base slipped: left wheel {_mm(self.slip_left)}, right wheel "
            f"{_mm(self.slip_right)}, sideways {_mm(self.slip_lateral)} on "
            f"{self.path_length:.3g} m; odometry ends {_mm(self.odometry.final_position)} and "
            f"{1e3 * self.odometry.final_heading:.3g} mrad off"
        )


def base_figures(
    odometry: Numbers, truth: Numbers, reference: Numbers | None, slip: tuple[float, float, float]
) -> BaseFigures:
    driven = relative(truth)
    steps = np.hypot(*np.diff(driven[:, :2], axis=0).T)
    return BaseFigures(
        path_length=float(steps.sum()),
        odometry=PoseErrors.between(relative(odometry), driven),
        tracking=None if reference is None else PoseErrors.between(driven, reference),
        slip_left=slip[0],
        slip_right=slip[1],
        slip_lateral=slip[2],
    )


def relative(poses: Numbers) -> Numbers:
    """Return poses as seen from the first of them, (N, 3)."""
    x, y, heading = poses[0]
    c, s = np.cos(heading), np.sin(heading)
    dx, dy = poses[:, 0] - x, poses[:, 1] - y
    return np.column_stack([c * dx + s * dy, c * dy - s * dx, poses[:, 2] - heading])


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.3g} mm"


@dataclass(frozen=True)
class PoseDeviation:
    """Deviation of a frame from another over N instants."""

    rms_position: float  # [m] root of the mean squared distance
    largest_position: float  # [m]
    rms_orientation: float  # [rad] root of the mean squared angle
    largest_orientation: float  # [rad]

    @classmethod
    def of(cls, distances: Numbers, angles: Numbers) -> PoseDeviation:
        if not len(distances) or len(distances) != len(angles):
            raise SeriesError(
                f"a deviation needs one distance and one angle for each instant, got "
                f"{len(distances)} and {len(angles)}"
            )
        return cls(
            float(np.sqrt(np.mean(distances**2))),
            float(distances.max()),
            float(np.sqrt(np.mean(angles**2))),
            float(angles.max()),
        )


@dataclass(frozen=True)
class EndEffectorFigures:
    """The end effector of one run in the task frame."""

    link: str  # its name
    frame: str  # the task frame: odom, or the root link where the base is unknown
    # by the measured joints and the wheels' odometry, against the reference
    tracking: PoseDeviation
    truth: PoseDeviation | None = None  # by its true pose, against the reference

    def line(self, label: str) -> str:
        text = f"{label}: {self.link} in {self.frame}: {_deviation(self.tracking)}"
        return text if self.truth is None else f"{text}; in truth {_deviation(self.truth)}"


@dataclass(frozen=True, eq=False)
class EndEffectorPath:
    """Where an end effector was to be and where it was, for the figure."""

    label: str  # name of the run
    reference: Numbers  # [m] (N, 3)
    position: Numbers  # [m] at the same instants, (N, 3)


@dataclass(frozen=True)
class BrickFigures:
    """What became of one brick in one run."""

    name: str  # name of the brick
    grasped: bool  # whether it was ever held
    # [m] between the brick and the hand at the first closing that was for it
    distance: float | None
    angle: float | None  # [rad] between its faces and the fingers then
    lost: bool  # whether it was ever pulled out of the grip
    position_error: float | None  # [m] from where it lies at the end to its place
    orientation_error: float | None  # [rad] likewise
    reason: str = ""  # why it was missed or lost first; empty if it was neither

    def as_mapping(self) -> dict[str, object]:
        """Return all figures by name but the name itself."""
        mapping = asdict(self)
        del mapping["name"]
        return mapping

    def line(self, label: str) -> str:
        outcome = "lost" if self.lost else "carried" if self.grasped else "not grasped"
        text = f"{label}: brick {self.name} {outcome}"
        if self.reason:
            text += f" ({self.reason})"
        if self.distance is not None and self.angle is not None:
            text += f", {_mm(self.distance)} and {_mrad(self.angle)} off at closing"
        if self.position_error is not None and self.orientation_error is not None:
            text += (
                f", lies {_mm(self.position_error)} and {_mrad(self.orientation_error)} from its "
                "place"
            )
        return text


def task_notes(
    end_effectors: Mapping[str, EndEffectorFigures], bricks: Mapping[str, Sequence[BrickFigures]]
) -> list[str]:
    """Return the lines below the table of a brick task; none where there were no bricks."""
    lines = [brick.line(label) for label, each in bricks.items() for brick in each]
    return lines + [each.line(label) for label, each in end_effectors.items() if lines]


def _deviation(deviation: PoseDeviation) -> str:
    return (
        f"RMS {_mm(deviation.rms_position)} and {_mrad(deviation.rms_orientation)}, largest "
        f"{_mm(deviation.largest_position)} and {_mrad(deviation.largest_orientation)} off"
    )


def _mrad(angle: float) -> str:
    return f"{1e3 * angle:.3g} mrad"


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
        wheels = frame.base.joints if frame.base else ()
        moving = [joint for joint in (*recorded, *wheels) if joint in self._series]
        unknown = [joint for joint in moving if not self._series[joint].has_reference]
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
        self._known = self._known_at(moving)
        if not len(self._known):
            raise BagError(
                f"run {run.label!r}: how far {frame.link!r} was from its reference is not known: "
                f"the references of {', '.join(moving)} are never known at one time"
            )
        self._bases = self._base_poses()

    @property
    def frame(self) -> str:
        return "odom" if self._bases is not None else self._frame.description.root

    def figures(self, truth: PoseColumns | None = None) -> EndEffectorFigures:
        """Return the deviations at all states at which every reference is known."""
        blocks = [
            _deviations(self._poses("reference", block), self._poses("position", block))
            for block in self._blocks()
        ]
        distances, angles = (np.concatenate(each) for each in zip(*blocks, strict=True))
        tracking = PoseDeviation.of(distances, angles)
        true = None if truth is None else self._against(truth)
        return EndEffectorFigures(self._frame.link, self.frame, tracking, true)

    def path(self, points: int) -> EndEffectorPath:
        every = self._known[:: max(1, len(self._known) // points)]
        reference, position = (self._poses(what, every) for what in ("reference", "position"))
        return EndEffectorPath(self._label, reference.positions, position.positions)

    def _against(self, truth: PoseColumns) -> PoseDeviation | None:
        """Compare the reference with true poses at the states that they belong to."""
        _, here, there = np.intersect1d(
            self._stamps_ns[self._known],
            truth.stamps_ns,
            assume_unique=True,
            return_indices=True,
        )
        if not len(here):
            return None
        here = self._known[here]
        true = LinkPoses(truth.positions[there, 0], _matrices(truth.orientations[there, 0]))
        return PoseDeviation.of(*_deviations(self._poses("reference", here), true))

    def _blocks(self) -> Iterator[npt.NDArray[np.int64]]:
        for begin in range(0, len(self._known), _BLOCK):
            yield self._known[begin : begin + _BLOCK]

    def _known_at(self, joints: Sequence[str]) -> npt.NDArray[np.int64]:
        """Return the common stamps at which the references of all joints are known."""
        known = np.ones(len(self._stamps_ns), dtype=np.bool_)
        for series in (self._series[joint] for joint in joints):
            if series.known is None:
                continue
            own = series.state_stamps_ns
            following = np.searchsorted(own, self._stamps_ns)
            before = np.searchsorted(own, self._stamps_ns, "right") - 1
            known &= series.known[np.minimum(following, len(own) - 1)]
            known &= series.known[np.maximum(before, 0)]
        return np.flatnonzero(known)

    def _poses(self, what: str, at: npt.NDArray[np.int64]) -> LinkPoses:
        """Return the link in the task frame."""
        columns = [self._column(self._series[joint], what)[at] for joint in self._arm.joints]
        poses = self._arm.poses(np.column_stack(columns))
        base = self._frame.base
        if self._bases is None or base is None:
            return poses
        x, y, heading = self._bases[what][at].T
        turns = axis_rotations(_UP, heading)
        origins = np.column_stack([x, y, np.full_like(x, base.height)])
        positions = origins + np.einsum("nij,nj->ni", turns, poses.positions)
        return LinkPoses(positions, turns @ poses.rotations)

    def _base_poses(self) -> dict[str, Numbers] | None:
        """Return x, y and heading of the base at the states, wanted and by its odometry.

        While the reference of a wheel is not known the base is wanted to go as it goes.
        """
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
        if what == "reference" and series.known is not None:
            values = np.where(series.known, values, series.position)
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
