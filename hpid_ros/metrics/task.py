"""Quality of a task: the end effector against its reference, and the fate of bricks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from hpid_ros.base.units import Numbers
from hpid_ros.messages.series import SeriesError

SLIP_SHARE = 0.01
"""Slip that is worth a line: more than this share of the way."""

SLIP_FLOOR = 0.005
"""And more than this, in [m]."""


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
        """Compare two paths."""
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

    def as_mapping(self) -> dict[str, object]:
        """Return all figures by name, with those of the errors nested."""
        return asdict(self)

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
    """Compute the figures of one run."""
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
        """Return the figures of deviations."""
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

    def as_mapping(self) -> dict[str, object]:
        """Return all figures by name, with those of the deviations nested."""
        return asdict(self)

    def line(self, label: str) -> str:
        """Return one line for people."""
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
        """Return one line for people."""
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
    end_effectors: Sequence[tuple[str, EndEffectorFigures]],
    bricks: Sequence[tuple[str, Sequence[BrickFigures]]],
) -> list[str]:
    """Return the lines below the table of a brick task; none where there were no bricks."""
    lines = [brick.line(label) for label, each in bricks for brick in each]
    return lines + [figures.line(label) for label, figures in end_effectors if lines]


def _deviation(deviation: PoseDeviation) -> str:
    return (
        f"RMS {_mm(deviation.rms_position)} and {_mrad(deviation.rms_orientation)}, largest "
        f"{_mm(deviation.largest_position)} and {_mrad(deviation.largest_orientation)} off"
    )


def _mrad(angle: float) -> str:
    return f"{1e3 * angle:.3g} mrad"
