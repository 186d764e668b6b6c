"""Quality of a task: the end effector against its reference, and the fate of bricks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from hpid_ros.base.arrays import Numbers
from hpid_ros.recordings.series import SeriesError


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
    reason: str = ""  # why it was missed or lost first, in words; empty if it was neither

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


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.3g} mm"


def _mrad(angle: float) -> str:
    return f"{1e3 * angle:.3g} mrad"
