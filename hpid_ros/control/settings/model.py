"""Settings of a loop's model of the robot, fixed when the loop begins."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from hpid_ros.base.errors import SettingError
from hpid_ros.control.settings.table import ParameterSpec, Value

COMPENSATIONS = ("none", "gravity", "decoupling")

_TABLE = (
    ParameterSpec(
        "compensation",
        "none",
        "Model-based term: none, gravity, or decoupling, with which gains and i_clamp are those "
        "of a unit double integrator (per kg m^2)",
        choices=COMPENSATIONS,
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

MODEL_PARAMETERS: Mapping[str, ParameterSpec] = {spec.name: spec for spec in _TABLE}
"""Every parameter of a loop's model by its dotted name; all are fixed when a node starts."""


@dataclass(frozen=True)
class ModelSettings:
    """The model that a loop's effort takes into account; see :data:`MODEL_PARAMETERS`.

    Attributes:
        compensation: ``none``, ``gravity`` or ``decoupling``.
        description: URDF, XML text or path; empty for the robot's own.
        payload: In [kg].
        payload_link: Link that carries it.
        mass_scale: Factor on masses and inertias.
        locked_joints: Names separated by commas.
        left_wheel: Joint of the left wheel; empty for a fixed base.
        right_wheel: Joint of the right wheel.
        wheel_radius: In [m]; 0 is the URDF's.
        wheel_separation: In [m]; 0 is the URDF's.
        effort_filter_time_constant: In [s]; -1 lets the model choose.

    Raises:
        SettingError: Only one wheel is named.
    """

    compensation: str = "none"
    description: str = ""
    payload: float = 0.0
    payload_link: str = "payload"
    mass_scale: float = 1.0
    locked_joints: str = ""
    left_wheel: str = ""
    right_wheel: str = ""
    wheel_radius: float = 0.0
    wheel_separation: float = 0.0
    effort_filter_time_constant: float = -1.0

    def __post_init__(self) -> None:
        if bool(self.left_wheel) != bool(self.right_wheel):
            raise SettingError(
                f"a rolling base needs model.left_wheel and model.right_wheel, "
                f"not {self.left_wheel!r} and {self.right_wheel!r}"
            )

    @classmethod
    def from_parameters(cls, values: Mapping[str, object]) -> ModelSettings:
        """Check parameters by dotted name; what is left out has its default.

        Raises:
            SettingError: An unknown name, a wrong type, a value out of range, one wheel.
        """
        checked = {
            name: spec.checked(values.get(name, spec.default))
            for name, spec in MODEL_PARAMETERS.items()
        }
        fields = {name.removeprefix("model."): value for name, value in checked.items()}
        return cls(**fields)  # type: ignore[arg-type]

    def to_parameters(self) -> dict[str, Value]:
        """Return every parameter by its dotted name; none without a compensation."""
        if not self.is_on:
            return {}
        return {name: getattr(self, name.removeprefix("model.")) for name in MODEL_PARAMETERS}

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
