"""Settings of a loop's model of the robot, fixed when the loop begins."""

from __future__ import annotations

from dataclasses import dataclass

from hpid_ros.base.errors import SettingError
from hpid_ros.control.settings.choices import Compensation
from hpid_ros.control.settings.records import ParameterRecord, parameter


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
