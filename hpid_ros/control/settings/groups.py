"""The groups of a loop's parameters: small records, each of one idea, that check themselves."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from hpid_ros.base.errors import SettingError
from hpid_ros.control.norms import NormFamily
from hpid_ros.control.settings.choices import (
    AntiWindupStrategy,
    NormType,
    StateClock,
    VelocitySourceName,
)
from hpid_ros.control.settings.records import ParameterRecord, parameter
from hpid_ros.control.settings.table import LARGEST_MOTION, PARAMETERS

_LEAST_PERIODS = 1.5  # of control_period in state_timeout: one state may be late


LEAST_WRAP = 1e-6
"""No encoder begins anew after less, in [rad]: positions have too many such turns for a number."""


@dataclass(frozen=True)
class NormSettings(ParameterRecord):
    """The homogeneous norm: what it is, and between which bounds it is used."""

    type: NormType = parameter("norm.type")
    error_scale: float = parameter("norm.error_scale")
    rate_weight: float = parameter("norm.rate_weight")
    effort_scale: float = parameter("norm.effort_scale")
    floor: float = parameter("norm.floor")
    cap: float = parameter("norm.cap")

    def __post_init__(self) -> None:
        super().__post_init__()
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
class EffortLimits(ParameterRecord):
    """The efforts that may be given."""

    u_clamp_max: float = parameter("u_clamp_max")
    u_clamp_min: float = parameter("u_clamp_min")
    effort_rate_max: float = parameter("effort_rate_max")
    fallback_effort: float = parameter("fallback_effort")

    def __post_init__(self) -> None:
        super().__post_init__()
        _require_order("u_clamp", self.u_clamp_min, self.u_clamp_max)

    def within(self, effort: float) -> float:
        """Return the nearest effort within the limits, in [N m]."""
        return min(max(effort, self.u_clamp_min), self.u_clamp_max)

    @property
    def fallback(self) -> float:
        """The effort while there is no usable state, within the limits, in [N m]."""
        return self.within(self.fallback_effort)


@dataclass(frozen=True)
class IntegralLimits(ParameterRecord):
    """What keeps the integral term from winding up."""

    i_clamp_max: float = parameter("i_clamp_max")
    i_clamp_min: float = parameter("i_clamp_min")
    antiwindup_strategy: AntiWindupStrategy = parameter("antiwindup_strategy")
    tracking_time_constant: float = parameter("tracking_time_constant")

    def __post_init__(self) -> None:
        super().__post_init__()
        _require_order("i_clamp", self.i_clamp_min, self.i_clamp_max)


@dataclass(frozen=True)
class VelocitySettings(ParameterRecord):
    """Where the velocity comes from."""

    source: VelocitySourceName = parameter("velocity_source")
    filter_time_constant: float = parameter("velocity_filter_time_constant")
    acceleration_bound: float = parameter("acceleration_bound")

    @property
    def is_measured(self) -> bool:
        """Whether measured velocities are used."""
        return self.source == "measured"

    @property
    def in_use(self) -> tuple[object, ...]:
        """The source, and the parameters that it uses."""
        if self.source == "homogeneous_differentiator":
            return self.source, self.acceleration_bound
        return self.source, self.filter_time_constant


@dataclass(frozen=True)
class ObserverSettings(ParameterRecord):
    """The observer, where the velocity comes from one."""

    bandwidth: float = parameter("observer.bandwidth")
    degree: float = parameter("observer.degree")
    innovation_scale: float = parameter("observer.innovation_scale")
    feed_disturbance: bool = parameter("observer.feed_disturbance")


@dataclass(frozen=True)
class FeedforwardSettings(ParameterRecord):
    """What is added to the law's effort for the reference's sake."""

    inertia: float = parameter("feedforward.inertia")
    viscous_friction: float = parameter("feedforward.viscous_friction")
    coulomb_friction: float = parameter("feedforward.coulomb_friction")
    friction_velocity: float = parameter("feedforward.friction_velocity")
    trajectory_effort: bool = parameter("feedforward.trajectory_effort")


@dataclass(frozen=True)
class EncoderSettings(ParameterRecord):
    """What is known of the encoder, and which of its positions are believed."""

    wrap: float = parameter("encoder_wrap")
    resolution: float = parameter("encoder_resolution")
    step_max: float = parameter("position_step_max")

    def __post_init__(self) -> None:
        super().__post_init__()
        if 0.0 < self.wrap < LEAST_WRAP:
            raise SettingError(
                f"encoder_wrap must be 0, -1 or at least {LEAST_WRAP:g}, not {self.wrap:g}"
            )


@dataclass(frozen=True)
class SoftStop(ParameterRecord):
    """How a stop is approached."""

    margin: float = parameter("soft_stop.margin")
    k_position: float = parameter("soft_stop.k_position")
    k_velocity: float = parameter("soft_stop.k_velocity")


@dataclass(frozen=True)
class MotionSettings(ParameterRecord):
    """How far and how fast the joint may move."""

    position_max: float = parameter("position_max")
    position_min: float = parameter("position_min")
    velocity_max: float = parameter("velocity_max")
    soft_stop: SoftStop = field(default_factory=SoftStop)
    angle_wraparound: bool = parameter("angle_wraparound")
    multi_turn: bool = parameter("multi_turn")

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
class Timing(ParameterRecord):
    """The times between states, and what follows when one stays away."""

    control_period: float = parameter("control_period")
    state_timeout: float = parameter("state_timeout")
    state_clock: StateClock = parameter("state_clock")
    takeover_time: float = parameter("takeover_time")

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


def _require_order(name: str, low: float, high: float) -> None:
    if not low <= high:
        raise SettingError(f"{name}_min = {low} must not exceed {name}_max = {high}")
