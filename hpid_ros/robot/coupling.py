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
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from hpid_ros.base.errors import RobotDescriptionError, SettingError
from hpid_ros.control.model import ModelSettings
from hpid_ros.control.settings import LoopSettings
from hpid_ros.robot.description import RobotDescription, robot_xml
from hpid_ros.robot.differential_drive import DifferentialDrive
from hpid_ros.robot.dynamics import JointSpace

RANDOM_POSES, SEED = 200, 1


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


def coupling(space: JointSpace, samples: int = RANDOM_POSES, seed: int = SEED) -> Coupling:
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
                f"{coupling.radius():.2f}), over {RANDOM_POSES} poses"
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


def model_source(model: ModelSettings, robot: str) -> str:
    """Return the XML text of the model's robot."""
    source = model.description or robot
    if not source:
        raise SettingError(
            f"compensation {model.compensation} needs the robot: robot_description is empty"
        )
    return robot_xml(source)


def model_space(model: ModelSettings, xml: str) -> JointSpace:
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
    space = model_space(model, xml)
    return space.joints, coupling(space)


def require_joint(joint: str, joints: Sequence[str]) -> None:
    if joint not in joints:
        raise RobotDescriptionError(
            f"the model of joint {joint!r} lacks it; it has {', '.join(joints)}"
        )


def coupling_of(settings: LoopSettings, robot: str) -> Coupling:
    """Return the coupling of the joints of a loop's model, over the robot's poses."""
    return _coupled(settings.model, model_source(settings.model, robot))[1]


def with_inertia(settings: LoopSettings, robot: str) -> LoopSettings:
    """Return settings with the joint's inertia, where decoupling leaves it to the model.

    It decides nothing about the law, which acts on a unit double integrator, but the soft stops
    brake with it.
    """
    if not settings.model.is_decoupling or settings.inertia > 0.0:
        return settings
    joints, found = _coupled(settings.model, model_source(settings.model, robot))
    require_joint(settings.joint, joints)
    return replace(settings, inertia=found.inertia[joints.index(settings.joint)])


def settling_of(loops: Iterable[LoopSettings], robot: str) -> list[Settling]:
    """Judge loops with decoupling; those of one model and one rate are judged once."""
    different = {(each.model, each.timing.control_period): each for each in loops}
    return [Settling.of(each, coupling_of(each, robot)) for each in different.values()]
