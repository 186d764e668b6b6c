"""The settings of a joint loop, checked as a whole."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

from hpid_ros.base.errors import SettingError, unknown_name
from hpid_ros.control.gains import Gains, require_hurwitz
from hpid_ros.control.norms import NormFamily, norm_floor, require_degree, require_floor
from hpid_ros.control.settings.choices import Discretization, LawName
from hpid_ros.control.settings.groups import (
    EffortLimits,
    EncoderSettings,
    FeedforwardSettings,
    IntegralLimits,
    MotionSettings,
    NormSettings,
    ObserverSettings,
    Timing,
    VelocitySettings,
)
from hpid_ros.control.settings.model import ModelSettings
from hpid_ros.control.settings.records import (
    ParameterRecord,
    from_values,
    parameter,
    to_values,
    with_values,
)
from hpid_ros.control.settings.table import PARAMETERS, Value


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
        """The least value of the norm in force: ``norm.floor``, or what sampling can bear.

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
