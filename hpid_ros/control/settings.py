"""The settings of a joint loop, checked as a whole.

A set of parameters by dotted name and a record of records are one thing in two shapes; the
functions here turn one into the other without knowing a single parameter.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cache, cached_property
from operator import attrgetter
from typing import Any, NamedTuple, TypeVar, cast, get_type_hints

from hpid_ros.base.errors import SettingError, unknown_name
from hpid_ros.control.homogeneous_pid import Gains, require_hurwitz
from hpid_ros.control.norms import NormFamily, norm_floor, require_degree, require_floor
from hpid_ros.control.parameters import (
    LARGEST_MOTION,
    PARAMETERS,
    AntiWindupStrategy,
    Compensation,
    Discretization,
    LawName,
    NormType,
    ParameterSpec,
    StateClock,
    Value,
    VelocitySourceName,
)

_KEY = "parameter"

AnyRecord = TypeVar("AnyRecord")


def parameter(name: str) -> Any:
    """Declare the field of a record that holds a parameter; its default is the table's."""
    return field(default=PARAMETERS[name].default, metadata={_KEY: name})


class ParameterRecord:
    """A frozen dataclass whose fields are declared by :func:`parameter`, or are records."""

    def __post_init__(self) -> None:
        for name, spec in _layout(cast(Any, type(self))).leaves:
            value = getattr(self, name)
            checked = spec.checked(value)
            if checked is not value:  # a whole number becomes a float
                object.__setattr__(self, name, checked)


def from_values(kind: type[AnyRecord], values: Mapping[str, object]) -> AnyRecord:
    """Return the record that holds a set of parameters."""
    return cast(AnyRecord, _assembled(_layout(cast(Any, kind)), values))


def to_values(record: object) -> dict[str, Value]:
    """Return the parameters that a record holds, by dotted name, in the order of the tables."""
    return {name: get(record) for name, get in _getters(cast(Any, type(record)))}


def with_values(record: AnyRecord, changes: Mapping[str, object]) -> AnyRecord:
    """Return a record with some of its parameters changed, checked again."""
    paths = _paths(cast(Any, type(record)))
    for name in changes:
        if name not in paths:
            raise SettingError(unknown_name("parameter", name, paths))
    return _replaced(record, [(paths[name], value) for name, value in changes.items()])


_Path = tuple[str, ...]  # names of fields, from a record to a value


class _Layout(NamedTuple):
    """The fields of a record."""

    kind: type  # the record
    is_checking: bool  # whether it checks its parameters itself
    # its fields that hold a parameter, and the parameter
    leaves: tuple[tuple[str, ParameterSpec], ...]
    groups: tuple[tuple[str, _Layout], ...]  # its fields that hold records, and their layout

    def paths(self) -> Iterator[tuple[str, _Path]]:
        """Yield each parameter and where it is."""
        yield from ((spec.name, (own,)) for own, spec in self.leaves)
        for group, layout in self.groups:
            yield from ((name, (group, *path)) for name, path in layout.paths())


@cache
def _layout(kind: type, group: str = "") -> _Layout:
    """Return the layout of a record; a field that names no parameter holds its namesake."""
    prefix = f"{group}." if group else ""
    hints = get_type_hints(kind)
    leaves, groups = [], []
    for each in fields(cast(Any, kind)):
        if is_dataclass(hints[each.name]):
            groups.append((each.name, _layout(hints[each.name], each.name)))
        else:
            name = each.metadata.get(_KEY, f"{prefix}{each.name}")
            leaves.append((each.name, PARAMETERS[name]))
    return _Layout(kind, issubclass(kind, ParameterRecord), tuple(leaves), tuple(groups))


@cache
def _paths(kind: type) -> Mapping[str, _Path]:
    """Return where a record holds each of its parameters, in the order of the tables."""
    found = dict(_layout(kind).paths())
    return {name: found[name] for name in PARAMETERS if name in found}


@cache
def _getters(kind: type) -> Sequence[tuple[str, Callable[[object], Value]]]:
    return [(name, attrgetter(".".join(path))) for name, path in _paths(kind).items()]


def _assembled(layout: _Layout, values: Mapping[str, object]) -> object:
    arguments: dict[str, object] = {
        own: values.get(spec.name, spec.default) for own, spec in layout.leaves
    }
    if not layout.is_checking:
        arguments = {own: spec.checked(arguments[own]) for own, spec in layout.leaves}
    for group, inner in layout.groups:
        arguments[group] = _assembled(inner, values)
    return layout.kind(**arguments)


def _replaced(record: AnyRecord, changes: Sequence[tuple[_Path, object]]) -> AnyRecord:
    own = {path[0]: value for path, value in changes if len(path) == 1}
    for group in {path[0] for path, _ in changes if len(path) > 1}:
        within = [(path[1:], value) for path, value in changes if path[0] == group]
        own[group] = _replaced(getattr(record, group), within)
    return cast(AnyRecord, replace(cast(Any, record), **own))


_LEAST_PERIODS = 1.5  # of control_period in state_timeout: one state may be late


LEAST_WRAP = 1e-6
"""No encoder wraps after less, in [rad]: positions have too many such turns for a number."""


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


@dataclass(frozen=True)
class ModelSettings(ParameterRecord):
    """The model that a loop's effort takes into account; see :data:`.MODEL_PARAMETERS`."""

    compensation: Compensation = parameter("compensation")
    description: str = parameter("model.description")
    payload: float = parameter("model.payload")
    payload_link: str = parameter("model.payload_link")
    mass_scale: float = parameter("model.mass_scale")
    locked_joints: str = parameter("model.locked_joints")
    left_wheel: str = parameter("model.left_wheel")
    right_wheel: str = parameter("model.right_wheel")
    wheel_radius: float = parameter("model.wheel_radius")
    wheel_separation: float = parameter("model.wheel_separation")
    effort_filter_time_constant: float = parameter("model.effort_filter_time_constant")

    def __post_init__(self) -> None:
        super().__post_init__()
        if bool(self.left_wheel) != bool(self.right_wheel):
            raise SettingError(
                f"a rolling base needs model.left_wheel and model.right_wheel, "
                f"not {self.left_wheel!r} and {self.right_wheel!r}"
            )

    @property
    def is_on(self) -> bool:
        """Whether there is a model."""
        return self.compensation != "none"

    @property
    def is_decoupling(self) -> bool:
        """Whether the law acts on a unit double integrator."""
        return self.compensation == "decoupling"

    @property
    def locked(self) -> tuple[str, ...]:
        """The names of the locked joints."""
        return tuple(name.strip() for name in self.locked_joints.split(",") if name.strip())


@dataclass(frozen=True)
class LoopSettings(ParameterRecord):
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

    joint: str
    gains: Gains
    law: LawName = parameter("law")
    mu: float = parameter("mu")
    norm: NormSettings = field(default_factory=NormSettings)
    discretization: Discretization = parameter("discretization")
    inertia: float = parameter("inertia")
    effort: EffortLimits = field(default_factory=EffortLimits)
    integral: IntegralLimits = field(default_factory=IntegralLimits)
    velocity: VelocitySettings = field(default_factory=VelocitySettings)
    observer: ObserverSettings = field(default_factory=ObserverSettings)
    feedforward: FeedforwardSettings = field(default_factory=FeedforwardSettings)
    encoder: EncoderSettings = field(default_factory=EncoderSettings)
    motion: MotionSettings = field(default_factory=MotionSettings)
    timing: Timing = field(default_factory=Timing)
    model: ModelSettings = field(default_factory=ModelSettings)

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
        if self.law == "hpid" or is_implicit:
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
        for name in values:
            if name not in PARAMETERS:
                raise SettingError(unknown_name("parameter", name, PARAMETERS))
        return from_values(cls, values)

    def to_parameters(self) -> dict[str, Value]:
        """Return every parameter by its dotted name; those of a model only if there is one."""
        values = to_values(self)
        if not self.model.is_on:
            for name in to_values(self.model):
                del values[name]
        return values

    def with_parameters(self, changes: Mapping[str, object]) -> LoopSettings:
        """Return the settings with some parameters changed, checked again as a whole.

        Args:
            changes: By dotted name.

        Raises:
            SettingError: As for :meth:`from_parameters`.
            GainError: As for the class.
            NormError: As for the class.
        """
        return with_values(self, changes)

    @property
    def degree(self) -> float:
        """The degree of the law: ``mu``, or 0 where the law is linear."""
        return self.mu if self.law == "hpid" else 0.0

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
        return norm_floor(
            self.norm_family(self.degree),
            period=self.timing.control_period,
            derivative_gain=self.gains.d / (self.plant_inertia or 1.0),
            resolution=self.encoder.resolution,
            filter_time_constant=self.velocity.filter_time_constant,
            cap=self.norm.cap,
        )
