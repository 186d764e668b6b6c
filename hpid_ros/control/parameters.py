"""Every parameter of a joint loop and of its model: name, unit, range, default.

The tables serve the node's parameters, the experiment files and the documentation alike.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

from hpid_ros.base.errors import SettingError
from hpid_ros.control.velocity import LARGEST_DEGREE, LEAST_DEGREE

LawName = Literal["hpid", "pid"]
"""The homogeneous PID, or the linear one."""

NormType = Literal["weighted", "canonical"]
"""Homogeneous norms, see :mod:`hpid_ros.control.norms`."""

Discretization = Literal["explicit", "semi_implicit"]
"""Steps of the law, see :mod:`hpid_ros.control.homogeneous_pid`."""

AntiWindupStrategy = Literal["none", "conditional_integration", "back_calculation"]
"""What the integral does while the effort is limited, as in control_toolbox."""

VelocitySourceName = Literal["measured", "filtered", "homogeneous_differentiator", "observer"]
"""Where a velocity comes from, see :mod:`hpid_ros.control.estimation`."""

StateClock = Literal["wall", "simulated"]
"""What stamps the states; a simulated clock can be paused."""

Compensation = Literal["none", "gravity", "decoupling"]
"""What of a model of the robot a loop's effort takes into account."""


_LARGEST_GAIN = 1e6
LARGEST_EFFORT = 1e6
LARGEST_NORM = 1e6
LARGEST_MOTION = 1e6
"""A position or velocity limit of this size is none."""

LONGEST_TIMEOUT = 1.0
"""No watchdog may be patient for longer than this, in [s]."""

Value = str | float | bool


@dataclass(frozen=True)
class ParameterSpec:
    """One parameter of a joint loop."""

    name: str  # dotted name, as in ROS
    default: Value  # its value when none is given; its type is the parameter's type
    description: str  # what it is, with the unit in brackets
    minimum: float = -math.inf  # least allowed number
    maximum: float = math.inf  # largest allowed number
    choices: tuple[str, ...] = ()  # allowed texts
    # the ends of a slider in a parameter client, each of them allowed and sensible
    slider: tuple[float, float] | None = None

    def checked(self, value: object) -> Value:
        """Return the value in the parameter's type."""
        if not isinstance(self.default, float):
            return self._flag_or_text(value)
        if type(value) is not float and (
            isinstance(value, bool) or not isinstance(value, int | float)
        ):
            raise SettingError(f"{self.name} must be a number, not {value!r}")
        is_finite = abs(value) <= sys.float_info.max  # also of an integer that is no float
        if not (is_finite and self.minimum <= value <= self.maximum):
            raise SettingError(
                f"{self.name} must lie in [{self.minimum:g}, {self.maximum:g}], not {value}"
            )
        return float(value)

    def _flag_or_text(self, value: object) -> Value:
        if isinstance(self.default, bool):
            if not isinstance(value, bool):
                raise SettingError(f"{self.name} must be true or false, not {value!r}")
            return value
        if not isinstance(value, str) or (self.choices and value not in self.choices):
            allowed = f"one of {', '.join(self.choices)}" if self.choices else "a text"
            raise SettingError(f"{self.name} must be {allowed}, not {value!r}")
        return value


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
    ParameterSpec(
        "law", "hpid", "Control law: homogeneous PID or linear PID", choices=get_args(LawName)
    ),
    _gain("gains.p", "Proportional", "N m/rad"),
    _gain("gains.i", "Integral", "N m/(rad s)"),
    _gain("gains.d", "Derivative", "N m s/rad"),
    ParameterSpec(
        "mu",
        0.0,
        "Homogeneity degree, strictly inside (-0.5, 0.5); 0 is the linear PID",
        -0.5,
        0.5,
        slider=(-0.4999, 0.4999),
    ),
    ParameterSpec("norm.type", "weighted", "Homogeneous norm", choices=get_args(NormType)),
    ParameterSpec(
        "norm.error_scale", 1.0, "Error at rest whose norm is 1, e_max [rad]", 1e-6, LARGEST_NORM
    ),
    ParameterSpec(
        "norm.rate_weight", 0.1, "Weight of the error rate in the norm [s/rad]", 1e-6, 1e6
    ),
    ParameterSpec(
        "norm.effort_scale",
        0.0,
        "u0 [N m]: the norm is 1 where the PID's p e or d de is u0, that is error_scale = u0/p "
        "and rate_weight = d/u0, which are not given then; 0 is off",
        0.0,
        LARGEST_EFFORT,
    ),
    ParameterSpec(
        "norm.floor",
        -1.0,
        "Least value of the norm; 0 is the paper's law exactly, -1 computes it from "
        "encoder_resolution, velocity_filter_time_constant and control_period",
        -1.0,
        LARGEST_NORM,
    ),
    ParameterSpec("norm.cap", LARGEST_NORM, "Largest value of the norm", 1e-6, LARGEST_NORM),
    ParameterSpec(
        "u_clamp_max",
        LARGEST_EFFORT,
        "Upper effort limit [N m]",
        -LARGEST_EFFORT,
        LARGEST_EFFORT,
    ),
    ParameterSpec(
        "u_clamp_min",
        -LARGEST_EFFORT,
        "Lower effort limit [N m]",
        -LARGEST_EFFORT,
        LARGEST_EFFORT,
    ),
    ParameterSpec(
        "i_clamp_max",
        LARGEST_EFFORT,
        "Upper limit of the integral term [N m]",
        -LARGEST_EFFORT,
        LARGEST_EFFORT,
    ),
    ParameterSpec(
        "i_clamp_min",
        -LARGEST_EFFORT,
        "Lower limit of the integral term [N m]",
        -LARGEST_EFFORT,
        LARGEST_EFFORT,
    ),
    ParameterSpec(
        "antiwindup_strategy",
        "conditional_integration",
        "What the integral does while the effort is limited, as in control_toolbox",
        choices=get_args(AntiWindupStrategy),
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
        "always filtered differences of the position, Levant's differentiator, or an observer "
        "(needs inertia), which gives the position, too",
        choices=get_args(VelocitySourceName),
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
        "observer.bandwidth",
        0.0,
        "Of the observer [1/s]; 0 chooses 4 gains.d / inertia",
        0.0,
        1e4,
    ),
    ParameterSpec(
        "observer.degree",
        0.0,
        "Homogeneity degree of the observer: 0 is linear, negative is tighter at small "
        "innovations, positive calmer",
        LEAST_DEGREE,
        LARGEST_DEGREE,
        slider=(LEAST_DEGREE, LARGEST_DEGREE),
    ),
    ParameterSpec(
        "observer.innovation_scale",
        0.0,
        "Innovation at which the degree leaves the bandwidth as it is [rad]; 0 chooses "
        "encoder_resolution, or 0.001 where that is unknown",
        0.0,
        1e3,
    ),
    ParameterSpec(
        "observer.feed_disturbance",
        False,
        "Add the effort against the disturbance that the observer estimates",
    ),
    ParameterSpec(
        "feedforward.inertia",
        0.0,
        "Effort for the reference's acceleration [kg m^2]; negative takes inertia",
        -1.0,
        LARGEST_EFFORT,
    ),
    ParameterSpec(
        "feedforward.viscous_friction",
        0.0,
        "Effort for the reference's velocity [N m s/rad]; negative takes the damping in "
        "robot_description",
        -1.0,
        LARGEST_EFFORT,
    ),
    ParameterSpec(
        "feedforward.coulomb_friction",
        0.0,
        "Effort in the direction in which the reference moves [N m]; negative takes the friction "
        "in robot_description",
        -1.0,
        LARGEST_EFFORT,
    ),
    ParameterSpec(
        "feedforward.friction_velocity",
        0.01,
        "Velocity of the reference from which on feedforward.coulomb_friction is given whole "
        "[rad/s]",
        1e-6,
        10.0,
    ),
    ParameterSpec(
        "feedforward.trajectory_effort",
        True,
        "Add the efforts of trajectories that have one in every point; not with a compensation, "
        "which knows the robot's weight itself",
    ),
    ParameterSpec(
        "discretization",
        "explicit",
        "Step of the law: explicit, or semi_implicit for periods from 5 ms on with a weak "
        "integral (needs inertia)",
        choices=get_args(Discretization),
    ),
    ParameterSpec(
        "encoder_wrap",
        -1.0,
        "The encoder begins anew after so much [rad], as a driver does that reports (-pi, pi] or "
        "[0, 2 pi); 0 never; -1 after 2 pi where robot_description has the joint as continuous",
        -1.0,
        1e3,
    ),
    ParameterSpec(
        "angle_wraparound",
        False,
        "Take the shorter way round to each new reference, also where the encoder counts its "
        "turns; for joints that turn without end",
    ),
    ParameterSpec(
        "multi_turn",
        False,
        "References mean what they say, whole turns included; otherwise, where the encoder begins "
        "anew (encoder_wrap) and there is no stop, the shorter way round leads to each new one",
    ),
    ParameterSpec(
        "position_step_max",
        0.0,
        "A position that differs from the last one by more than this [rad], and twice "
        "velocity_max times the time between, is a fault; 0 chooses 0.1, or pi where there is "
        "no velocity_max; 1e6 is none",
        0.0,
        LARGEST_MOTION,
    ),
    ParameterSpec(
        "effort_rate_max",
        0.0,
        "Largest change of the effort [N m/s]; 0 is none. Faults go to fallback_effort at once",
        0.0,
        1e9,
    ),
    ParameterSpec(
        "position_max",
        LARGEST_MOTION,
        "Upper soft stop [rad]; 1e6 is none",
        -LARGEST_MOTION,
        LARGEST_MOTION,
    ),
    ParameterSpec(
        "position_min",
        -LARGEST_MOTION,
        "Lower soft stop [rad]; -1e6 is none",
        -LARGEST_MOTION,
        LARGEST_MOTION,
    ),
    ParameterSpec(
        "velocity_max", LARGEST_MOTION, "Velocity limit [rad/s]; 1e6 is none", 1e-6, LARGEST_MOTION
    ),
    ParameterSpec(
        "soft_stop.margin",
        0.05,
        "Effort towards a stop begins to fade this far before it [rad]",
        1e-6,
        10.0,
    ),
    ParameterSpec(
        "soft_stop.k_position",
        0.0,
        "Velocity allowed towards a stop for each rad of distance [1/s]; 0 chooses "
        "0.75 gains.p / gains.d",
        0.0,
        1e6,
    ),
    ParameterSpec(
        "soft_stop.k_velocity",
        0.0,
        "Braking for each rad/s beyond the velocity allowed [N m s/rad]; 0 chooses gains.d",
        0.0,
        1e6,
    ),
    ParameterSpec(
        "takeover_time",
        0.5,
        "The reference glides for so long from where the joint is onto a motion that is under "
        "way [s]; 0 jumps",
        0.0,
        100.0,
    ),
    ParameterSpec(
        "fallback_effort",
        0.0,
        "Effort while there is no usable state [N m], within the effort limits",
        -LARGEST_EFFORT,
        LARGEST_EFFORT,
    ),
    ParameterSpec(
        "state_timeout",
        0.1,
        "A longer time between two states is a gap, after which the loop takes over anew [s]",
        1e-6,
        LONGEST_TIMEOUT,
    ),
    ParameterSpec(
        "state_clock",
        "wall",
        "What stamps the states: wall, or simulated, which can be paused without a takeover",
        choices=get_args(StateClock),
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

_MODEL_TABLE = (
    ParameterSpec(
        "compensation",
        "none",
        "Model-based term: none, gravity, or decoupling, with which gains and i_clamp are those "
        "of a unit double integrator (per kg m^2)",
        choices=get_args(Compensation),
    ),
    ParameterSpec(
        "model.description",
        "",
        "URDF of the model, XML text or path, where it is not robot_description",
    ),
    ParameterSpec("model.payload", 0.0, "Payload that the model carries [kg]", 0.0, 1e4),
    ParameterSpec("model.payload_link", "payload", "Link that carries the model's payload"),
    ParameterSpec(
        "model.mass_scale",
        1.0,
        "Factor on the mass and inertia of every link of the model, rotors not",
        1e-3,
        1e3,
    ),
    ParameterSpec(
        "model.locked_joints",
        "",
        "Joints that joint_states do not have, separated by commas: the model holds them at 0",
    ),
    ParameterSpec(
        "model.left_wheel", "", "Joint of the left wheel of a rolling base; empty for a fixed base"
    ),
    ParameterSpec("model.right_wheel", "", "Joint of its right wheel; empty for a fixed base"),
    ParameterSpec(
        "model.wheel_radius", 0.0, "Of both wheels [m]; 0 is that of the URDF", 0.0, 1e6
    ),
    ParameterSpec(
        "model.wheel_separation",
        0.0,
        "Distance of the wheels' contact points [m]; 0 is that of the URDF",
        0.0,
        1e6,
    ),
    ParameterSpec(
        "model.effort_filter_time_constant",
        -1.0,
        "Of the low-pass on the measured efforts of the other joints [s]; 0 is none, -1 chooses "
        "it from the model",
        -1.0,
        10.0,
    ),
)

LOOP_PARAMETERS: Mapping[str, ParameterSpec] = {spec.name: spec for spec in _TABLE}
"""Every parameter of a joint loop by its dotted name."""

MODEL_PARAMETERS: Mapping[str, ParameterSpec] = {spec.name: spec for spec in _MODEL_TABLE}
"""Every parameter of a loop's model by its dotted name; all are fixed when a node starts."""

PARAMETERS: Mapping[str, ParameterSpec] = {**LOOP_PARAMETERS, **MODEL_PARAMETERS}
"""Both."""
