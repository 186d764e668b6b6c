"""The plan of an excitation: which joint is where when, and what it must not exceed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.interpolate import BPoly

from hpid_ros.base.arrays import Numbers
from hpid_ros.base.errors import SettingError
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.excitation.bounds import Allowed, JointBounds, Wish, allowed
from hpid_ros.excitation.courses import KNOTS_A_PERIOD, Course, Peaks, multisine, steps
from hpid_ros.excitation.trials import sine, there_and_back

_LEAD = 0.5  # [s] at rest, until every controller has taken the trajectory up
_BETWEEN = 1.0  # [s] between joints that are excited one after the other
_MOST_KNOTS = 45_000  # controllers take 50 000 points
_TOLERANCE_SHARE, _LEAST_TOLERANCE = 0.5, 0.02  # of the amplitude; [rad]
_RUNAWAY, _VELOCITY_NOISE = 2.0, 0.2  # of the planned velocity; [rad/s]


Kind = Literal["multisine", "steps", "step", "minimum_jerk", "sine"]


class Design(NamedTuple):
    """What kind of excitation it shall be."""

    kind: Kind = "multisine"  # sums of sines, or steps, as large as they may be
    duration: float = 20.0  # [s] of each joint, or of all that move together
    band: tuple[float, float] = (0.1, 2.5)  # [Hz] of the sines
    fade: float = 2.0  # [s] of their soft start and soft end
    are_together: bool = False  # whether all joints move at once
    tolerance: float = 0.0  # [rad] how far a joint may be from its reference
    seed: int = 0  # of the phases; the joints have different ones
    frequency: float = 0.5  # [Hz] of the one sine


@dataclass(frozen=True)
class PlannedJoint:
    """What one joint is told; "rad" reads "m" where it slides."""

    bounds: JointBounds  # its limits
    begin: float  # [s] when it begins to move
    end: float  # [s] when it has stopped
    peaks: Peaks  # what its reference reaches
    effort: float  # [N m] what that needs beside the load, by its inertia
    crest_factor: float  # of its velocity
    tolerance: float  # [rad] how far it may be from its reference
    velocity_stop: float  # [rad/s] it is stopped when it is faster
    notes: tuple[str, ...] = ()  # what was assumed, in words


@dataclass(frozen=True, eq=False)
class ExcitationPlan:
    """A plan; the reference begins and ends where the joints are told to stand."""

    joints: tuple[PlannedJoint, ...]  # in the order of the columns
    times: Numbers  # [s] of the knots since the start, shape (knots,)
    positions: Numbers  # [rad] away from where each joint stands, shape (knots, joints)
    velocities: Numbers  # [rad/s] likewise
    accelerations: Numbers  # [rad/s^2] likewise

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the joints."""
        return tuple(each.bounds.joint for each in self.joints)

    @property
    def duration(self) -> float:
        """In [s]."""
        return float(self.times[-1])

    def as_mapping(self) -> dict[str, Any]:
        """Return it as what JSON can hold."""
        arrays = ("times", "positions", "velocities", "accelerations")
        return {
            "joints": [asdict(each) for each in self.joints],
            **{name: getattr(self, name).tolist() for name in arrays},
        }

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> ExcitationPlan:
        """Return the plan of :meth:`as_mapping`."""
        try:
            joints = tuple(_planned(each) for each in values["joints"])
            names = ("times", "positions", "velocities", "accelerations")
            return cls(joints, *(np.array(values[name], dtype=float) for name in names))
        except (KeyError, TypeError, ValueError) as error:
            raise SettingError(f"this is no plan of an excitation: {error!r}") from None


def _planned(values: Mapping[str, Any]) -> PlannedJoint:
    bounds = JointBounds(**{**values["bounds"], "efforts": tuple(values["bounds"]["efforts"])})
    kept = {**values, "bounds": bounds, "peaks": Peaks(*values["peaks"])}
    return PlannedJoint(**{**kept, "notes": tuple(values["notes"])})


def plan(bounds: Sequence[JointBounds], wish: Wish, design: Design) -> ExcitationPlan:
    """Return the largest excitation of joints within shares of their limits."""
    wish.require()
    fastest = {"multisine": design.band[1], "sine": design.frequency}.get(design.kind, 0.0)
    turns = 1 if design.are_together else len(bounds)
    _require_few(KNOTS_A_PERIOD * design.duration * fastest * turns)
    limits = [allowed(each, wish) for each in bounds]
    courses = [_course(each, design, number) for number, each in enumerate(limits)]
    begins, begin = [], _LEAD
    for course in courses:
        begins.append(begin)
        if not design.are_together:
            begin += float(course.times[-1]) + _BETWEEN
    joints = [
        _planned_joint(*each, design.tolerance)
        for each in zip(bounds, limits, courses, begins, strict=True)
    ]
    return _laid_out(joints, courses, begins)


def _require_few(knots: float) -> None:
    if knots > _MOST_KNOTS:
        raise SettingError(
            f"this excitation has {knots:.0f} knots, {_MOST_KNOTS} are allowed: shorten it, "
            f"lower its highest frequency, or take fewer joints at a time"
        )


def _course(limits: Allowed, design: Design, number: int) -> Course:
    duration, peaks = design.duration, limits.peaks
    match design.kind:
        case "steps":
            return steps(duration, peaks)
        case "step" | "minimum_jerk":
            return there_and_back(duration, peaks, is_fast=design.kind == "step")
        case "sine":
            return sine(duration, design.frequency, design.fade, peaks)
    return multisine(duration, design.band, design.fade, peaks, design.seed + number)


def _planned_joint(
    bounds: JointBounds, limits: Allowed, course: Course, begin: float, tolerance: float
) -> PlannedJoint:
    peaks = course.peaks
    chosen = tolerance or max(_TOLERANCE_SHARE * peaks.position, _LEAST_TOLERANCE)
    return PlannedJoint(
        bounds,
        begin,
        begin + float(course.times[-1]),
        peaks,
        bounds.inertia * peaks.acceleration,
        course.crest_factor,
        chosen,
        min(bounds.velocity, _RUNAWAY * peaks.velocity + _VELOCITY_NOISE),
        limits.notes,
    )


def _laid_out(
    joints: Sequence[PlannedJoint], courses: Sequence[Course], begins: Sequence[float]
) -> ExcitationPlan:
    """Put all courses onto one grid of whole nanoseconds, on which they are the same quintics."""
    knots = [begin + each.times for begin, each in zip(begins, courses, strict=True)]
    grid = np.unique(np.rint(np.concatenate([np.zeros(1), *knots]) * NANOSECONDS)) / NANOSECONDS
    _require_few(len(grid))
    columns = []
    for begin, each in zip(begins, courses, strict=True):
        spline = BPoly.from_derivatives(each.times, np.stack(each[1:], axis=1))
        at = np.clip(grid - begin, 0.0, each.times[-1])
        columns.append([spline(at), spline.derivative()(at), spline.derivative(2)(at)])
    arrays = (np.stack(each, axis=1) for each in zip(*columns, strict=True))
    return ExcitationPlan(tuple(joints), grid, *arrays)
