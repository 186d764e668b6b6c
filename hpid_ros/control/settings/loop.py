"""The settings of a joint loop, checked as a whole, and the parts that are made of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from hpid_ros.base.errors import SettingError, unknown_name
from hpid_ros.control.gains import Gains, require_hurwitz
from hpid_ros.control.homogeneous_pid import HomogeneousPid, SemiImplicitHomogeneousPid
from hpid_ros.control.limits import AntiWindup, LimitFigures, MotionLimits, anti_windup
from hpid_ros.control.norms import (
    CanonicalNorm,
    WeightedNorm,
    norm_floor,
    require_degree,
    scaled_norm,
)
from hpid_ros.control.pid import Pid
from hpid_ros.control.settings.model import MODEL_PARAMETERS, ModelSettings
from hpid_ros.control.settings.table import (
    LARGEST_EFFORT,
    LARGEST_MOTION,
    LARGEST_NORM,
    LOOP_PARAMETERS,
    Value,
)
from hpid_ros.control.velocity import (
    FilteredVelocity,
    HomogeneousDifferentiator,
    MeasuredVelocity,
    Unwrapper,
    VelocitySource,
)

_ALLOWANCE = 0.1  # [rad], for noise and coarse encoders
_LEAST_PERIODS = 1.5  # of control_period in state_timeout: one state may be late
_K_POSITION = 10.0  # [1/s], of a soft stop where the gains say nothing


@dataclass(frozen=True)
class LoopSettings:
    """The checked settings of one joint loop; see :data:`LOOP_PARAMETERS` for each field.

    ``model`` is the model of the robot that the effort takes into account, if any.

    Raises:
        SettingError: Limits the wrong way round, or a joint without a name.
        GainError: Gains that are not a PID's, or an unstable loop where the inertia is known.
        NormError: A degree or norm that the law does not allow.
    """

    joint: str
    gains: Gains
    law: str = "hpid"
    mu: float = 0.0
    norm_type: str = "weighted"
    norm_error_scale: float = 1.0
    norm_rate_weight: float = 0.1
    norm_floor: float = -1.0
    norm_cap: float = LARGEST_NORM
    u_clamp_max: float = LARGEST_EFFORT
    u_clamp_min: float = -LARGEST_EFFORT
    i_clamp_max: float = LARGEST_EFFORT
    i_clamp_min: float = -LARGEST_EFFORT
    antiwindup_strategy: str = "conditional_integration"
    tracking_time_constant: float = 0.0
    velocity_source: str = "measured"
    velocity_filter_time_constant: float = 0.005
    acceleration_bound: float = 50.0
    discretization: str = "explicit"
    encoder_wrap: float = -1.0
    angle_wraparound: bool = False
    position_step_max: float = 0.0
    effort_rate_max: float = 0.0
    position_max: float = LARGEST_MOTION
    position_min: float = -LARGEST_MOTION
    velocity_max: float = LARGEST_MOTION
    soft_stop_margin: float = 0.05
    soft_stop_k_position: float = 0.0
    soft_stop_k_velocity: float = 0.0
    takeover_time: float = 0.5
    fallback_effort: float = 0.0
    state_timeout: float = 0.1
    state_clock: str = "wall"
    control_period: float = 0.001
    encoder_resolution: float = 0.0
    inertia: float = 0.0
    model: ModelSettings = field(default_factory=ModelSettings)

    def __post_init__(self) -> None:
        if not self.joint:
            raise SettingError("the parameter joint must name the joint to control, it is empty")
        require_degree(self.mu)
        for name in ("u_clamp", "i_clamp", "position"):
            low, high = getattr(self, f"{name}_min"), getattr(self, f"{name}_max")
            if not low <= high:
                raise SettingError(f"{name}_min = {low} must not exceed {name}_max = {high}")
        if self.state_timeout < _LEAST_PERIODS * self.control_period:
            raise SettingError(
                f"state_timeout = {self.state_timeout:g} s must be at least {_LEAST_PERIODS:g} "
                f"times control_period = {self.control_period:g} s: every state would be a gap"
            )
        if self.angle_wraparound and self._has_stops:
            raise SettingError(
                "angle_wraparound takes the shorter way round, and that may lead through a stop: "
                "it is not for joints with position_min or position_max"
            )
        if self.discretization == "semi_implicit" and self.plant_inertia == 0.0:
            raise SettingError("discretization semi_implicit needs the inertia, which is unknown")
        if self.plant_inertia > 0.0:
            require_hurwitz(self.gains, self.plant_inertia)
        self.make_law()
        self.make_anti_windup()

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
        for name in values:
            if name not in LOOP_PARAMETERS and name not in MODEL_PARAMETERS:
                known = [*LOOP_PARAMETERS, *MODEL_PARAMETERS]
                raise SettingError(unknown_name("parameter", name, known))
        checked = {
            name: spec.checked(values.get(name, spec.default))
            for name, spec in LOOP_PARAMETERS.items()
        }
        gains = Gains(*(float(checked.pop(f"gains.{term}")) for term in "pid"))
        fields = {name.replace(".", "_"): value for name, value in checked.items()}
        model = ModelSettings.from_parameters(values)
        return cls(gains=gains, model=model, **fields)  # type: ignore[arg-type]

    def to_parameters(self) -> dict[str, Value]:
        """Return every parameter by its dotted name; those of a model only if there is one."""
        values: dict[str, Value] = {}
        for name in LOOP_PARAMETERS:
            if name.startswith("gains."):
                values[name] = getattr(self.gains, name[-1])
            else:
                values[name] = getattr(self, name.replace(".", "_"))
        return values | self.model.to_parameters()

    @property
    def plant_inertia(self) -> float:
        """What one unit of the law's output accelerates, in [kg m^2]; 0 if unknown.

        With decoupling it is 1: the law acts on a unit double integrator.
        """
        return 1.0 if self.model.is_decoupling else self.inertia

    def make_norm(self) -> WeightedNorm | CanonicalNorm:
        """Return the norm: an error of ``norm.error_scale`` at rest has norm 1 in either type."""
        return scaled_norm(self.norm_type, self.mu, self.norm_error_scale, self.norm_rate_weight)

    def make_law(self) -> Pid | HomogeneousPid:
        """Return the control law, its integral at zero."""
        if self.discretization == "semi_implicit":
            degree = 0.0 if self.law == "pid" else self.mu
            norm = scaled_norm(
                self.norm_type, degree, self.norm_error_scale, self.norm_rate_weight
            )
            return SemiImplicitHomogeneousPid(
                self.gains, norm, self._floor(norm), self.norm_cap, inertia=self.plant_inertia
            )
        if self.law == "pid":
            return Pid(self.gains)
        norm = self.make_norm()
        return HomogeneousPid(self.gains, norm, self._floor(norm), self.norm_cap)

    def _floor(self, norm: WeightedNorm | CanonicalNorm) -> float:
        if self.norm_floor >= 0.0:
            return self.norm_floor
        return norm_floor(
            norm,
            period=self.control_period,
            derivative_gain=self.gains.d / (self.plant_inertia or 1.0),
            resolution=self.encoder_resolution,
            filter_time_constant=self.velocity_filter_time_constant,
            cap=self.norm_cap,
        )

    def make_velocity_source(self) -> VelocitySource:
        """Return the velocity source, without a past."""
        if self.velocity_source == "homogeneous_differentiator":
            return HomogeneousDifferentiator(self.acceleration_bound)
        if self.velocity_source == "filtered":
            return FilteredVelocity(self.velocity_filter_time_constant)
        return MeasuredVelocity(self.velocity_filter_time_constant)

    @property
    def hears_velocity(self) -> bool:
        """Whether measured velocities are used."""
        return self.velocity_source == "measured"

    @property
    def velocity_parameters(self) -> tuple[object, ...]:
        """The velocity source, and the parameters that it uses."""
        if self.velocity_source == "homogeneous_differentiator":
            return self.velocity_source, self.acceleration_bound
        return self.velocity_source, self.velocity_filter_time_constant

    def make_unwrapper(self) -> Unwrapper | None:
        """Return what makes the positions continuous; None where the encoder does not wrap."""
        return Unwrapper(self.encoder_wrap) if self.encoder_wrap > 0.0 else None

    @property
    def largest_step(self) -> tuple[float, float]:
        """What a position may differ from the last one: in [rad], and in [rad/s] of the time.

        A load may drive a joint beyond its velocity limit, and a stamp may be a period late:
        twice ``velocity_max`` is allowed over one period more than the stamps tell.
        """
        has_limit = self.velocity_max < LARGEST_MOTION
        allowance = self.position_step_max or (_ALLOWANCE if has_limit else math.pi)
        if allowance >= LARGEST_MOTION:
            return math.inf, 0.0
        fastest = 2.0 * self.velocity_max if has_limit else 0.0
        return allowance + fastest * self.control_period, fastest

    @property
    def is_simulated(self) -> bool:
        """Whether the control clock is a simulation's, which can be paused."""
        return self.state_clock == "simulated"

    @property
    def _has_stops(self) -> bool:
        return self.position_min > -LARGEST_MOTION or self.position_max < LARGEST_MOTION

    def make_anti_windup(self) -> AntiWindup:
        """Return the anti-windup strategy."""
        return anti_windup(self.antiwindup_strategy, self.gains, self.tracking_time_constant)

    def make_motion_limits(self) -> MotionLimits | None:
        """Return the limits of position, velocity and effort rate; None where there are none."""
        lower = self.position_min if self.position_min > -LARGEST_MOTION else -math.inf
        upper = self.position_max if self.position_max < LARGEST_MOTION else math.inf
        velocity = self.velocity_max if self.velocity_max < LARGEST_MOTION else math.inf
        rate = self.effort_rate_max or math.inf
        if max(-lower, upper, velocity, rate) == min(-lower, upper, velocity, rate) == math.inf:
            return None
        k_position, k_velocity = self._soft_stop()
        return MotionLimits(
            LimitFigures(
                lower,
                upper,
                velocity,
                self.soft_stop_margin,
                k_position,
                k_velocity,
                rate,
                self.u_clamp_min,
                self.u_clamp_max,
            )
        )

    def _soft_stop(self) -> tuple[float, float]:
        """Return the gains of the soft stops in [1/s] and [N m s/rad].

        Three equal poles at -w mean p = 3 w^2 m and d = 3 w m: then 0.75 p / d is d / (4 m),
        where a stop is just overdamped. A known inertia says it itself, and keeps the braking
        within what sampling allows.
        """
        scale = self.inertia if self.model.is_decoupling and self.inertia else 1.0
        p, d = scale * self.gains.p, scale * self.gains.d
        k_position = self.soft_stop_k_position or (0.75 * p / d if p and d else _K_POSITION)
        k_velocity = self.soft_stop_k_velocity or d or p / k_position
        if self.inertia > 0.0:
            if not self.soft_stop_k_velocity:
                k_velocity = min(k_velocity, 0.5 * self.inertia / self.control_period)
            if not self.soft_stop_k_position and k_velocity:
                k_position = min(k_position, k_velocity / (4.0 * self.inertia))
        return k_position, k_velocity

    @property
    def fallback(self) -> float:
        """The effort while there is no usable state, within the effort limits, in [N m]."""
        return min(max(self.fallback_effort, self.u_clamp_min), self.u_clamp_max)
