"""The settings of a joint loop and of its model: each parameter declared once, checked as a whole.

A set of parameters by dotted name and a record of records are one thing in two shapes. From these
records come a node's parameters, the keys of files, the JSON Schema and the tables of the docs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

from hpid_ros.base.errors import SettingError
from hpid_ros.base.records import (
    ParameterSpec,
    Record,
    from_parameters,
    group,
    parameters_of,
    quantity,
    to_parameters,
)
from hpid_ros.control.homogeneous_pid import Gains, require_hurwitz
from hpid_ros.control.laws import LAWS, LawName
from hpid_ros.control.limits import AntiWindupStrategy
from hpid_ros.control.model import ModelSettings
from hpid_ros.control.norms import (
    NORMS,
    NormFamily,
    require_degree,
    require_floor,
    sampling_floor,
)
from hpid_ros.control.velocity import LARGEST_OBSERVER_DEGREE, LEAST_OBSERVER_DEGREE

Discretization = Literal["explicit", "semi_implicit"]
"""Steps of the law, see :mod:`hpid_ros.control.homogeneous_pid`."""

VelocitySourceName = Literal["measured", "filtered", "homogeneous_differentiator", "observer"]
"""Where a velocity comes from, see :mod:`hpid_ros.control.estimation`."""

StateClock = Literal["wall", "simulated"]
"""What stamps the states; a simulated clock can be paused."""

LARGEST_EFFORT = 1e6
LARGEST_NORM = 1e6
LARGEST_MOTION = 1e6
"""A position or velocity limit of this size is none."""

LONGEST_TIMEOUT = 1.0
"""No watchdog may be patient for longer than this, in [s]."""

Value = str | float | bool


def _signed(meaning: str, unit: str = "", *, default: float, largest: float) -> Any:
    return quantity(meaning, unit, default=default, least=-largest, most=largest)


def _up_to(most: float, meaning: str, unit: str = "", *, default: float = 0.0, **how: Any) -> Any:
    return quantity(meaning, unit, default=default, least=0.0, most=most, **how)


def _require_order(name: str, low: float, high: float) -> None:
    if not low <= high:
        raise SettingError(f"{name}_min = {low} must not exceed {name}_max = {high}")


_LEAST_PERIODS = 1.5  # of control_period in state_timeout: one state may be late


LEAST_WRAP = 1e-6
"""No encoder wraps after less, in [rad]: in less, a position is too many turns to count."""


@dataclass(frozen=True)
class NormSettings(Record, prefix="norm."):
    """The homogeneous norm: what it is, and between which bounds it is used."""

    type: str = quantity("Homogeneous norm", default="weighted", choices=tuple(NORMS))
    error_scale: float = quantity(
        "Error at rest whose norm is 1, e_max", "rad", default=1.0, least=1e-6, most=LARGEST_NORM
    )
    rate_weight: float = quantity(
        "Weight of the error rate in the norm", "s/rad", default=0.1, least=1e-6, most=1e6
    )
    effort_scale: float = _up_to(
        LARGEST_EFFORT,
        "u0 [N m]: the norm is 1 where the PID's p e or d de is u0, that is error_scale = "
        "u0/p and rate_weight = d/u0, which are not given then; 0 is off",
    )
    floor: float = quantity(
        "Least value of the norm; 0 is the paper's law exactly, -1 computes it from "
        "encoder_resolution, velocity_filter_time_constant and control_period, and for mu < 0 "
        "from gains.d, mu and inertia (while that is unknown, 1 kg m^2: too low a floor for less)",
        default=-1.0,
        least=-1.0,
        most=LARGEST_NORM,
    )
    cap: float = quantity(
        "Largest value of the norm", default=LARGEST_NORM, least=1e-6, most=LARGEST_NORM
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.floor < 0.0 and self.floor != -1.0:
            raise SettingError(f"norm.floor must be -1 or at least 0, not {self.floor:g}")
        for name in ("error_scale", "rate_weight") if self.effort_scale else ():
            value, default = getattr(self, name), PARAMETERS[f"norm.{name}"].default
            if value != default:
                raise SettingError(
                    f"norm.effort_scale = {self.effort_scale:g} N m takes the place of "
                    f"norm.{name}, which must stay at its default {default:g}, not {value:g}"
                )

    def family(self, p: float, d: float) -> NormFamily:
        """Return the norm for every degree."""
        scale = self.effort_scale
        if not scale:
            return NormFamily(self.type, self.error_scale, self.rate_weight)
        if p <= 0.0 or d <= 0.0:
            raise SettingError(
                f"norm.effort_scale weighs the error by gains.p and its rate by gains.d: neither "
                f"may be 0, as of {p:g} and {d:g}"
            )
        return NormFamily(self.type, scale / p, d / scale)


@dataclass(frozen=True)
class EffortLimits(Record):
    """The efforts that may be given."""

    u_clamp_max: float = _signed(
        "Upper effort limit", "N m", default=LARGEST_EFFORT, largest=LARGEST_EFFORT
    )
    u_clamp_min: float = _signed(
        "Lower effort limit", "N m", default=-LARGEST_EFFORT, largest=LARGEST_EFFORT
    )
    effort_rate_max: float = _up_to(
        1e9,
        "Largest change of the effort [N m/s]; 0 is none. Faults go to fallback_effort at once",
    )
    fallback_effort: float = _signed(
        "Effort while there is no usable state [N m], within the effort limits",
        default=0.0,
        largest=LARGEST_EFFORT,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        _require_order("u_clamp", self.u_clamp_min, self.u_clamp_max)

    @property
    def largest(self) -> float:
        """Largest absolute effort that may be given, either way, in [N m]."""
        return max(self.u_clamp_max, -self.u_clamp_min)

    def within(self, effort: float) -> float:
        """Return the nearest effort within the limits, in [N m]."""
        return min(max(effort, self.u_clamp_min), self.u_clamp_max)

    @property
    def fallback(self) -> float:
        """The effort while there is no usable state, within the limits, in [N m]."""
        return self.within(self.fallback_effort)


@dataclass(frozen=True)
class IntegralLimits(Record):
    """What keeps the integral term from winding up."""

    i_clamp_max: float = _signed(
        "Upper limit of the integral term; not applied while gains.i is 0",
        "N m",
        default=LARGEST_EFFORT,
        largest=LARGEST_EFFORT,
    )
    i_clamp_min: float = _signed(
        "Lower limit of the integral term; not applied while gains.i is 0",
        "N m",
        default=-LARGEST_EFFORT,
        largest=LARGEST_EFFORT,
    )
    antiwindup_strategy: AntiWindupStrategy = quantity(
        "What the integral does while the effort is limited, as in control_toolbox",
        default="conditional_integration",
    )
    tracking_time_constant: float = _up_to(
        1000.0,
        "Time constant of back_calculation [s]; 0 chooses sqrt(gains.d / gains.i), or gains.p / "
        "gains.i where gains.d is 0",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        _require_order("i_clamp", self.i_clamp_min, self.i_clamp_max)


@dataclass(frozen=True)
class VelocitySettings(Record):
    """Where the velocity comes from."""

    velocity_source: VelocitySourceName = quantity(
        "Where the velocity comes from: the message (filtered differences where it has none),"
        " always filtered differences of the position, Levant's differentiator, or an "
        "observer (needs inertia), which gives the position, too",
        default="measured",
    )
    velocity_filter_time_constant: float = _up_to(
        10.0,
        "Time constant of the first-order velocity filter",
        "s",
        default=0.005,
    )
    acceleration_bound: float = quantity(
        "Acceleration that the joint does not exceed, for homogeneous_differentiator",
        "rad/s^2",
        default=50.0,
        least=0.001,
        most=1e6,
    )

    @property
    def is_measured(self) -> bool:
        """Whether measured velocities are used."""
        return self.velocity_source == "measured"

    @property
    def in_use(self) -> tuple[object, ...]:
        """The source, and the parameters that it uses."""
        if self.velocity_source == "homogeneous_differentiator":
            return self.velocity_source, self.acceleration_bound
        return self.velocity_source, self.velocity_filter_time_constant


@dataclass(frozen=True)
class ObserverSettings(Record, prefix="observer."):
    """The observer, where the velocity comes from one."""

    bandwidth: float = _up_to(1e4, "Observer bandwidth [1/s]; 0 chooses 4 gains.d / inertia")
    degree: float = quantity(
        "Homogeneity degree of the observer: 0 is linear, negative is tighter at small "
        "innovations, positive calmer",
        default=0.0,
        least=LEAST_OBSERVER_DEGREE,
        most=LARGEST_OBSERVER_DEGREE,
        slider=(LEAST_OBSERVER_DEGREE, LARGEST_OBSERVER_DEGREE),
    )
    innovation_scale: float = _up_to(
        1000.0,
        "Innovation at which the degree leaves the bandwidth as it is [rad]; 0 chooses "
        "encoder_resolution, or 0.001 where that is unknown",
    )
    feed_disturbance: bool = quantity(
        "Add the effort against the disturbance that the observer estimates", default=False
    )


@dataclass(frozen=True)
class FeedforwardSettings(Record, prefix="feedforward."):
    """What is added to the law's effort for the reference's sake."""

    inertia: float = quantity(
        "Effort for the reference's acceleration [kg m^2]; -1 takes inertia",
        default=0.0,
        least=-1.0,
        most=LARGEST_EFFORT,
    )
    viscous_friction: float = quantity(
        "Effort for the reference's velocity [N m s/rad]; -1 takes the damping in "
        "robot_description",
        default=0.0,
        least=-1.0,
        most=LARGEST_EFFORT,
    )
    coulomb_friction: float = quantity(
        "Effort in the direction in which the reference moves [N m]; -1 takes the "
        "friction in robot_description",
        default=0.0,
        least=-1.0,
        most=LARGEST_EFFORT,
    )
    friction_velocity: float = quantity(
        "Velocity of the reference from which on feedforward.coulomb_friction is given whole",
        "rad/s",
        default=0.01,
        least=1e-6,
        most=10.0,
    )
    trajectory_effort: bool = quantity(
        "Add the efforts of trajectories that have one in every point; not with a "
        "compensation, which knows the robot's weight itself",
        default=True,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("inertia", "viscous_friction", "coulomb_friction"):
            value = getattr(self, name)
            if value < 0.0 and value != -1.0:
                raise SettingError(f"feedforward.{name} must be -1 or at least 0, not {value:g}")


@dataclass(frozen=True)
class EncoderSettings(Record):
    """What is known of the encoder, and which of its positions are believed."""

    encoder_wrap: float = quantity(
        "Range after which the reported position wraps [rad], such as 2 pi for (-pi, pi] or "
        "[0, 2 pi); 0 never; -1 after 2 pi where robot_description has the joint as continuous",
        default=-1.0,
        least=-1.0,
        most=1000.0,
    )
    encoder_resolution: float = _up_to(1.0, "Step of the measured position [rad]; 0 if unknown")
    position_step_max: float = _up_to(
        LARGEST_MOTION,
        "A position that differs from the last one by more than this [rad] plus twice "
        "velocity_max times the time between and one control_period, is a fault; 0 chooses 0.1, "
        "or pi where there is no velocity_max; 1e6 is none",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.encoder_wrap < LEAST_WRAP and self.encoder_wrap not in (0.0, -1.0):
            raise SettingError(
                f"encoder_wrap must be 0, -1 or at least {LEAST_WRAP:g}, not {self.encoder_wrap:g}"
            )


@dataclass(frozen=True)
class SoftStop(Record, prefix="soft_stop."):
    """How a stop is approached."""

    margin: float = quantity(
        "Effort towards a stop begins to fade this far before it",
        "rad",
        default=0.05,
        least=1e-6,
        most=10.0,
    )
    k_position: float = _up_to(
        1e6,
        "Velocity allowed towards a stop for each rad of distance [1/s]; 0 chooses 0.75 "
        "gains.p / gains.d (10 where one is 0), with inertia at most k_velocity / (4 inertia)",
    )
    k_velocity: float = _up_to(
        1e6,
        "Braking for each rad/s beyond the velocity allowed [N m s/rad]; 0 chooses gains.d "
        "(gains.p / k_position where it is 0), with inertia at most inertia / (2 control_period)",
    )


@dataclass(frozen=True)
class MotionSettings(Record):
    """How far and how fast the joint may move."""

    position_max: float = _signed(
        "Upper soft stop [rad]; 1e6 is none", default=LARGEST_MOTION, largest=LARGEST_MOTION
    )
    position_min: float = _signed(
        "Lower soft stop [rad]; -1e6 is none", default=-LARGEST_MOTION, largest=LARGEST_MOTION
    )
    velocity_max: float = quantity(
        "Velocity limit [rad/s]; 1e6 is none",
        default=LARGEST_MOTION,
        least=1e-6,
        most=LARGEST_MOTION,
    )
    soft_stop: SoftStop = group(SoftStop)
    angle_wraparound: bool = quantity(
        "Take the shorter way round to each new reference, also where the encoder counts its "
        "turns; for joints that turn without end",
        default=False,
    )
    multi_turn: bool = quantity(
        "References mean what they say, whole turns included; otherwise, where the encoder "
        "begins anew (encoder_wrap) and there is no stop, the shorter way round leads to each"
        " new one",
        default=False,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        _require_order("position", self.position_min, self.position_max)
        if self.angle_wraparound and self.multi_turn:
            raise SettingError(
                "angle_wraparound takes the shorter way round to every reference, and multi_turn "
                "to none: set one of them"
            )
        if self.angle_wraparound and self.has_stop:
            raise SettingError(
                "angle_wraparound takes the shorter way round, and that may lead through a stop: "
                "it is not for joints with position_min or position_max"
            )

    @property
    def lower(self) -> float:
        """Lowest position in [rad]; -inf for none."""
        return self.position_min if self.position_min > -LARGEST_MOTION else -math.inf

    @property
    def upper(self) -> float:
        """Highest position in [rad]; inf for none."""
        return self.position_max if self.position_max < LARGEST_MOTION else math.inf

    @property
    def has_stop(self) -> bool:
        """Whether the joint must not pass some position."""
        return self.lower > -math.inf or self.upper < math.inf

    @property
    def fastest(self) -> float:
        """Largest absolute velocity in [rad/s]; inf for none."""
        return self.velocity_max if self.velocity_max < LARGEST_MOTION else math.inf


@dataclass(frozen=True)
class Timing(Record):
    """The times between states, and what follows when one stays away."""

    control_period: float = quantity(
        "Nominal time between two states", "s", default=0.001, least=1e-6, most=0.5
    )
    state_timeout: float = quantity(
        "Longest time between two states; after a longer one the loop takes over anew",
        "s",
        default=0.1,
        least=1e-6,
        most=LONGEST_TIMEOUT,
    )
    state_clock: StateClock = quantity(
        "What stamps the states: wall, or simulated, which can be paused without a takeover",
        default="wall",
    )
    takeover_time: float = _up_to(
        100.0,
        "The reference glides for so long from where the joint is onto a motion that is under"
        " way [s]; 0 jumps",
        default=0.5,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.state_timeout < _LEAST_PERIODS * self.control_period:
            raise SettingError(
                f"state_timeout = {self.state_timeout:g} s must be at least {_LEAST_PERIODS:g} "
                f"times control_period = {self.control_period:g} s: every state would be a gap"
            )

    @property
    def is_simulated(self) -> bool:
        """Whether the control clock is a simulation's, which can be paused."""
        return self.state_clock == "simulated"


@dataclass(frozen=True)
class LoopSettings(Record):
    """The checked settings of one joint loop; their parameters are in :data:`.LOOP_PARAMETERS`.

    Attributes:
        joint: Name of the joint.
        gains: Of the PID.
        law: The homogeneous PID, or the linear one.
        mu: Homogeneity degree.
        norm: The homogeneous norm.
        discretization: Step of the law.
        inertia: What one unit of effort accelerates, in [kg m^2]; 0 if unknown.
        effort: The efforts that may be given.
        integral: What keeps the integral from winding up.
        velocity: Where the velocity comes from.
        observer: The observer, where it comes from one.
        feedforward: What is added for the reference's sake.
        encoder: What is known of the encoder.
        motion: How far and how fast the joint may move.
        timing: The times between states.
        model: The model of the robot that the effort takes into account, if any.

    Raises:
        SettingError: A value that is none of its parameter's, or a joint without a name.
        GainError: Gains that are not a PID's, or an unstable loop where the inertia is known.
        NormError: A degree that the law does not allow, or a norm without room below its cap.
    """

    joint: str = quantity("Name of the joint in joint_states and joint_commands", default="")
    gains: Gains = group(Gains)
    law: LawName = quantity("Control law: homogeneous PID or linear PID", default="hpid")
    mu: float = quantity(
        "Homogeneity degree, strictly inside (-0.5, 0.5); 0 is the linear PID",
        default=0.0,
        least=-0.5,
        most=0.5,
        slider=(-0.4999, 0.4999),
    )
    norm: NormSettings = group(NormSettings)
    discretization: Discretization = quantity(
        "Step of the law: explicit, or semi_implicit for periods from 5 ms on with a weak "
        "integral (needs inertia)",
        default="explicit",
    )
    inertia: float = _up_to(
        1e6,
        "What one unit of effort accelerates at this joint [kg m^2]; 0 if unknown. When "
        "known, gains whose linear loop is unstable are refused",
    )
    effort: EffortLimits = group(EffortLimits)
    integral: IntegralLimits = group(IntegralLimits)
    velocity: VelocitySettings = group(VelocitySettings)
    observer: ObserverSettings = group(ObserverSettings)
    feedforward: FeedforwardSettings = group(FeedforwardSettings)
    encoder: EncoderSettings = group(EncoderSettings)
    motion: MotionSettings = group(MotionSettings)
    timing: Timing = group(Timing)
    model: ModelSettings = group(ModelSettings)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.joint:
            raise SettingError("the parameter joint must name the joint to control, it is empty")
        require_degree(self.mu)
        is_implicit = self.discretization == "semi_implicit"
        if is_implicit and self.plant_inertia == 0.0:
            raise SettingError("discretization semi_implicit needs the inertia, which is unknown")
        self._require_feedforward()
        if self.plant_inertia > 0.0:
            require_hurwitz(self.gains, self.plant_inertia)
        if self._lacks_inertia:  # a model gives it later
            return
        self.norm_family(self.degree)
        if LAWS[self.law].needs_norm or is_implicit:
            require_floor(self.norm_floor, self.norm.cap)

    def _require_feedforward(self) -> None:
        inertia = self.feedforward.inertia
        if inertia and self.model.is_decoupling:
            raise SettingError(
                f"compensation decoupling feeds the inertia forward by itself: "
                f"feedforward.inertia must be 0 with it, not {inertia:g}"
            )
        if inertia < 0.0 and self.inertia == 0.0:
            raise SettingError(
                f"feedforward.inertia = {inertia:g} takes the parameter inertia, which is unknown"
            )

    @classmethod
    def from_parameters(cls, values: Mapping[str, object]) -> LoopSettings:
        """Check a set of parameters as a whole.

        Args:
            values: By dotted name; what is left out has its default.

        Raises:
            SettingError: An unknown name, a wrong type, a value out of range.
            GainError: As for the class.
            NormError: As for the class.
        """
        return from_parameters(cls, values)

    def to_parameters(self) -> dict[str, Value]:
        """Return every parameter by its dotted name; those of a model only if there is one."""
        values = to_parameters(self)
        if self.model.is_on:
            return values
        return {name: value for name, value in values.items() if name in LOOP_PARAMETERS}

    def with_parameters(self, changes: Mapping[str, object]) -> LoopSettings:
        """Return the settings with some parameters changed, checked again as a whole.

        Args:
            changes: By dotted name.

        Raises:
            SettingError: As for :meth:`from_parameters`.
            GainError: As for the class.
            NormError: As for the class.
        """
        return from_parameters(type(self), {**to_parameters(self), **changes})

    @property
    def is_homogeneous(self) -> bool:
        """Whether the law is a homogeneous one; otherwise it is linear."""
        return LAWS[self.law].is_homogeneous

    @property
    def degree(self) -> float:
        """The degree of the law: ``mu``, or 0 where the law is linear."""
        return self.mu if self.is_homogeneous else 0.0

    @property
    def plant_inertia(self) -> float:
        """What one unit of the law's output accelerates, in [kg m^2]; 0 if unknown.

        With decoupling it is 1: the law acts on a unit double integrator.
        """
        return 1.0 if self.model.is_decoupling else self.inertia

    @property
    def _lacks_inertia(self) -> bool:
        return self.norm.effort_scale > 0.0 and self.model.is_decoupling and not self.inertia

    @cached_property
    def norm_family(self) -> NormFamily:
        """The norm for every degree.

        With decoupling the gains are accelerations; the inertia makes efforts of them.

        Raises:
            SettingError: ``norm.effort_scale`` is given with decoupling, and no inertia yet.
        """
        if self._lacks_inertia:
            raise SettingError("norm.effort_scale with decoupling needs the inertia")
        unit = self.inertia if self.model.is_decoupling else 1.0
        return self.norm.family(unit * self.gains.p, unit * self.gains.d)

    @cached_property
    def norm_floor(self) -> float:
        """The least value of the active norm: ``norm.floor``, or what sampling can bear.

        Raises:
            NormError: That is not below ``norm.cap``.
        """
        if self.norm.floor >= 0.0:
            return self.norm.floor
        return sampling_floor(
            self.norm_family(self.degree),
            period=self.timing.control_period,
            damping_rate=self.gains.d / (self.plant_inertia or 1.0),
            resolution=self.encoder.encoder_resolution,
            filter_time_constant=self.velocity.velocity_filter_time_constant,
            cap=self.norm.cap,
        )

    @property
    def floor_warning(self) -> str:
        """What speaks against the norm's automatic floor; empty if nothing does."""
        if self.degree >= 0.0 or self.norm.floor >= 0.0 or self.plant_inertia or not self.gains.d:
            return ""
        return (
            f"the inertia is unknown: the norm's floor for mu = {self.mu:g} is that of 1 kg m^2, "
            "and a lighter joint may chatter near its target; give inertia, or norm.floor"
        )


PARAMETERS: Mapping[str, ParameterSpec] = parameters_of(LoopSettings)
"""Every parameter of a joint loop and of its model by its dotted name."""

MODEL_PARAMETERS: Mapping[str, ParameterSpec] = parameters_of(ModelSettings)
"""Those of the model; all are fixed when a node starts."""

LOOP_PARAMETERS: Mapping[str, ParameterSpec] = {
    name: spec for name, spec in PARAMETERS.items() if name not in MODEL_PARAMETERS
}
"""Those of the loop."""
