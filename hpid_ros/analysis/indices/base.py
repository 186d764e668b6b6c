"""Driving of a base: against its reference, against its own odometry, and its slip."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from hpid_ros.base.arrays import Numbers

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
