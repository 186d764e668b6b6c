"""Everything that can be set on a joint loop: names, units, ranges, and the checked whole.

The table serves the node's parameters, the experiment files and the documentation alike.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from hpid_ros.control.anti_windup import STRATEGIES, AntiWindup, anti_windup
from hpid_ros.control.gains import Gains
from hpid_ros.control.homogeneity import CanonicalNorm, WeightedNorm, norm_floor, require_degree
from hpid_ros.control.homogeneous_pid import HomogeneousPid
from hpid_ros.control.pid import Pid
from hpid_ros.control.semi_implicit import SemiImplicitHomogeneousPid
from hpid_ros.control.stability import require_hurwitz
from hpid_ros.control.velocity import (
    FilteredVelocity,
    HomogeneousDifferentiator,
    MeasuredVelocity,
    VelocitySource,
)
from hpid_ros.errors import SettingError, unknown_name

LAWS = ("hpid", "pid")
NORMS = ("weighted", "canonical")
VELOCITY_SOURCES = ("measured", "filtered", "homogeneous_differentiator")
DISCRETIZATIONS = ("explicit", "semi_implicit")

_LARGEST_GAIN = 1e6
_LARGEST_EFFORT = 1e6
_LARGEST_NORM = 1e6

Value = str | float


@dataclass(frozen=True)
class ParameterSpec:
    """One parameter of a joint loop.

    Attributes:
        name: Dotted name, as in ROS.
        default: Its value when none is given; its type is the parameter's type.
        description: What it is, with the unit in brackets.
        minimum: Least allowed number.
        maximum: Largest allowed number.
        choices: Allowed texts.
    """

    name: str
    default: Value
    description: str
    minimum: float = -math.inf
    maximum: float = math.inf
    choices: tuple[str, ...] = ()

    def checked(self, value: object) -> Value:
        """Return the value in the parameter's type.

        Raises:
            SettingError: Wrong type, not finite, out of range, or not one of the choices.
        """
        if isinstance(self.default, str):
            if not isinstance(value, str) or (self.choices and value not in self.choices):
                allowed = f"one of {', '.join(self.choices)}" if self.choices else "a text"
                raise SettingError(f"{self.name} must be {allowed}, not {value!r}")
            return value
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise SettingError(f"{self.name} must be a number, not {value!r}")
        if not math.isfinite(value) or not self.minimum <= value <= self.maximum:
            raise SettingError(
                f"{self.name} must lie in [{self.minimum:g}, {self.maximum:g}], not {value}"
            )
        return float(value)


def _gain(name: str, term: str, unit: str) -> ParameterSpec:
    return ParameterSpec(
        name,
        0.0,
        f"{term} gain [{unit}]; error = reference - measurement, gains positive",
        0.0,
        _LARGEST_GAIN,
    )


_TABLE = (
    ParameterSpec("joint", "", "Name of the joint in joint_states and joint_commands"),
    ParameterSpec("law", "hpid", "Control law: homogeneous PID or linear PID", choices=LAWS),
    _gain("gains.p", "Proportional", "N m/rad"),
    _gain("gains.i", "Integral", "N m/(rad s)"),
    _gain("gains.d", "Derivative", "N m s/rad"),
    ParameterSpec(
        "mu",
        0.0,
        "Homogeneity degree, strictly inside (-0.5, 0.5); 0 is the linear PID",
        -0.5,
        0.5,
    ),
    ParameterSpec("norm.type", "weighted", "Homogeneous norm", choices=NORMS),
    ParameterSpec(
        "norm.error_scale", 1.0, "Error at rest whose norm is 1, e_max [rad]", 1e-6, _LARGEST_NORM
    ),
    ParameterSpec(
        "norm.rate_weight", 0.1, "Weight of the error rate in the norm [s/rad]", 1e-6, 1e6
    ),
    ParameterSpec(
        "norm.floor",
        -1.0,
        "Least value of the norm; 0 is the paper's law exactly, -1 computes it from "
        "encoder_resolution, velocity_filter_time_constant and control_period",
        -1.0,
        _LARGEST_NORM,
    ),
    ParameterSpec("norm.cap", _LARGEST_NORM, "Largest value of the norm", 1e-6, _LARGEST_NORM),
    ParameterSpec(
        "u_clamp_max",
        _LARGEST_EFFORT,
        "Upper effort limit [N m]",
        -_LARGEST_EFFORT,
        _LARGEST_EFFORT,
    ),
    ParameterSpec(
        "u_clamp_min",
        -_LARGEST_EFFORT,
        "Lower effort limit [N m]",
        -_LARGEST_EFFORT,
        _LARGEST_EFFORT,
    ),
    ParameterSpec(
        "i_clamp_max",
        _LARGEST_EFFORT,
        "Upper limit of the integral term [N m]",
        -_LARGEST_EFFORT,
        _LARGEST_EFFORT,
    ),
    ParameterSpec(
        "i_clamp_min",
        -_LARGEST_EFFORT,
        "Lower limit of the integral term [N m]",
        -_LARGEST_EFFORT,
        _LARGEST_EFFORT,
    ),
    ParameterSpec(
        "antiwindup_strategy",
        "conditional_integration",
        "What the integral does while the effort is limited, as in control_toolbox",
        choices=STRATEGIES,
    ),
    ParameterSpec(
        "tracking_time_constant",
        0.0,
        "Of back_calculation [s]; 0 chooses sqrt(gains.d / gains.i)",
        0.0,
        1e3,
    ),
    ParameterSpec(
        "velocity_source",
        "measured",
        "Where the velocity comes from: the message (filtered differences where it has none), "
        "always filtered differences of the position, or Levant's differentiator",
        choices=VELOCITY_SOURCES,
    ),
    ParameterSpec(
        "velocity_filter_time_constant", 0.005, "Of the first-order velocity filter [s]", 0.0, 10.0
    ),
    ParameterSpec(
        "acceleration_bound",
        50.0,
        "Acceleration that the joint does not exceed, for homogeneous_differentiator [rad/s^2]",
        1e-3,
        1e6,
    ),
    ParameterSpec(
        "discretization",
        "explicit",
        "Step of the law: explicit, or semi_implicit for periods from 5 ms on with a weak "
        "integral (needs inertia)",
        choices=DISCRETIZATIONS,
    ),
    ParameterSpec(
        "state_timeout", 0.1, "A longer time between two states is a gap [s]", 1e-6, 1e3
    ),
    ParameterSpec("control_period", 0.001, "Nominal time between two states [s]", 1e-6, 10.0),
    ParameterSpec(
        "encoder_resolution", 0.0, "Step of the measured position [rad]; 0 if unknown", 0.0, 1.0
    ),
    ParameterSpec(
        "inertia",
        0.0,
        "What one unit of effort accelerates at this joint [kg m^2]; 0 if unknown. When known, "
        "gains whose linear loop is unstable are refused",
        0.0,
        1e6,
    ),
)

LOOP_PARAMETERS: Mapping[str, ParameterSpec] = {spec.name: spec for spec in _TABLE}
"""Every parameter of a joint loop by its dotted name."""


@dataclass(frozen=True)
class LoopSettings:
    """The checked settings of one joint loop; see :data:`LOOP_PARAMETERS` for each field.

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
    norm_cap: float = _LARGEST_NORM
    u_clamp_max: float = _LARGEST_EFFORT
    u_clamp_min: float = -_LARGEST_EFFORT
    i_clamp_max: float = _LARGEST_EFFORT
    i_clamp_min: float = -_LARGEST_EFFORT
    antiwindup_strategy: str = "conditional_integration"
    tracking_time_constant: float = 0.0
    velocity_source: str = "measured"
    velocity_filter_time_constant: float = 0.005
    acceleration_bound: float = 50.0
    discretization: str = "explicit"
    state_timeout: float = 0.1
    control_period: float = 0.001
    encoder_resolution: float = 0.0
    inertia: float = 0.0

    def __post_init__(self) -> None:
        if not self.joint:
            raise SettingError("the parameter joint must name the joint to control, it is empty")
        require_degree(self.mu)
        for name in ("u_clamp", "i_clamp"):
            low, high = getattr(self, f"{name}_min"), getattr(self, f"{name}_max")
            if not low <= high:
                raise SettingError(f"{name}_min = {low} must not exceed {name}_max = {high}")
        if self.discretization == "semi_implicit" and self.inertia == 0.0:
            raise SettingError("discretization semi_implicit needs the inertia, which is unknown")
        if self.inertia > 0.0:
            require_hurwitz(self.gains, self.inertia)
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
            if name not in LOOP_PARAMETERS:
                raise SettingError(unknown_name("parameter", name, LOOP_PARAMETERS))
        checked = {
            name: spec.checked(values.get(name, spec.default))
            for name, spec in LOOP_PARAMETERS.items()
        }
        gains = Gains(*(float(checked.pop(f"gains.{term}")) for term in "pid"))
        fields = {name.replace(".", "_"): value for name, value in checked.items()}
        return cls(gains=gains, **fields)  # type: ignore[arg-type]

    def to_parameters(self) -> dict[str, Value]:
        """Return every parameter by its dotted name."""
        values: dict[str, Value] = {}
        for name in LOOP_PARAMETERS:
            if name.startswith("gains."):
                values[name] = getattr(self.gains, name[-1])
            else:
                values[name] = getattr(self, name.replace(".", "_"))
        return values

    def make_norm(self) -> WeightedNorm | CanonicalNorm:
        """Return the norm: an error of ``norm.error_scale`` at rest has norm 1 in either type."""
        if self.norm_type == "weighted":
            return WeightedNorm.scaled(self.mu, self.norm_error_scale, self.norm_rate_weight)
        shape = ((self.norm_error_scale**-2, 0.0), (0.0, self.norm_rate_weight**2))
        return CanonicalNorm(self.mu, shape)

    def make_law(self) -> Pid | HomogeneousPid:
        """Return the control law, its integral at zero."""
        if self.discretization == "semi_implicit":
            degree = 0.0 if self.law == "pid" else self.mu
            norm = replace(self, mu=degree, discretization="explicit").make_norm()
            return SemiImplicitHomogeneousPid(
                self.gains, norm, self._floor(norm), self.norm_cap, inertia=self.inertia
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
            derivative_gain=self.gains.d / (self.inertia or 1.0),
            resolution=self.encoder_resolution,
            filter_time_constant=self.velocity_filter_time_constant,
        )

    def make_velocity_source(self) -> VelocitySource:
        """Return the velocity source, without a past."""
        if self.velocity_source == "homogeneous_differentiator":
            return HomogeneousDifferentiator(self.acceleration_bound)
        if self.velocity_source == "filtered":
            return FilteredVelocity(self.velocity_filter_time_constant)
        return MeasuredVelocity(self.velocity_filter_time_constant)

    def make_anti_windup(self) -> AntiWindup:
        """Return the anti-windup strategy."""
        return anti_windup(self.antiwindup_strategy, self.gains, self.tracking_time_constant)
