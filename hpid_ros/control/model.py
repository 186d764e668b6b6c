"""A model of the robot as one loop takes it: its settings, and what it says of one sample."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

from hpid_ros.base.errors import SettingError
from hpid_ros.base.records import Record, quantity

Compensation = Literal["none", "gravity", "decoupling"]
"""What of a model of the robot a loop's effort takes into account."""


@dataclass(frozen=True)
class ModelSettings(Record, prefix="model."):
    """The model that a loop's effort takes into account; see :data:`.MODEL_PARAMETERS`."""

    compensation: Compensation = quantity(
        "Model-based term: none, gravity, or decoupling, with which gains and i_clamp are "
        "those of a unit double integrator (per kg m^2)",
        default="none",
        key="compensation",
    )
    description: str = quantity(
        "URDF of the model, XML text or path, where it is not robot_description", default=""
    )
    payload: float = quantity(
        "Payload that the model carries", "kg", default=0.0, least=0.0, most=1e4
    )
    payload_link: str = quantity("Link that carries the model's payload", default="payload")
    mass_scale: float = quantity(
        "Factor on the mass and inertia of every link of the model, rotors not",
        default=1.0,
        least=0.001,
        most=1000.0,
    )
    locked_joints: str = quantity(
        "Joints that joint_states do not have, separated by commas: the model holds them at 0",
        default="",
    )
    left_wheel: str = quantity(
        "Joint of the left wheel of a rolling base; empty for a fixed base", default=""
    )
    right_wheel: str = quantity("Joint of its right wheel; empty for a fixed base", default="")
    wheel_radius: float = quantity(
        "Of both wheels [m]; 0 is that of the URDF", default=0.0, least=0.0, most=1e6
    )
    wheel_separation: float = quantity(
        "Distance of the wheels' contact points [m]; 0 is that of the URDF",
        default=0.0,
        least=0.0,
        most=1e6,
    )
    effort_filter_time_constant: float = quantity(
        "Of the low-pass on the measured efforts of the other joints [s]; 0 is none, -1 "
        "chooses it from the model",
        default=-1.0,
        least=-1.0,
        most=10.0,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if -1.0 < self.effort_filter_time_constant < 0.0:
            raise SettingError(
                "model.effort_filter_time_constant must be -1 or at least 0, "
                f"not {self.effort_filter_time_constant:g}"
            )
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


class ModelTerm(NamedTuple):
    r"""One sample of a model, as one joint's loop needs it.

    The loop's effort, before the limits, is

    .. math:: \tau = g\,(u + a) + \tau_m

    with the law's output u, the reference's acceleration a (0 unless asked for), the gain g and
    the model's own effort :math:`\tau_m`. The law's gains, its integral and ``i_clamp`` are in
    the units of u: efforts where g is 1, accelerations where it is an inertia.
    """

    gain: float  # [kg m^2] g > 0: an inertia where u is an acceleration; 1 where it is an effort
    effort: float  # [N m] the model's own effort
    # whether the reference's acceleration is added to the law's output
    follows_acceleration: bool = False
