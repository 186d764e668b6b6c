"""What an experiment's robot says of the models of its controllers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from hpid_ros.control import LoopSettings
from hpid_ros.control.model_settings import ModelSettings
from hpid_ros.robot.description import RobotDescription
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.tuning.compensation import robot_xml, with_inertia


def with_robot(settings: LoopSettings, world: WorldSettings) -> LoopSettings:
    """Return settings whose model has what the experiment's robot says.

    A model rolls where the robot does, and holds the joints that are not driven.

    Args:
        settings: Of one joint's loop; without a compensation they stay as they are.
        world: The simulated robot.

    Raises:
        HpidError: The model's robot cannot be read, or lacks the joint.
    """
    model = settings.model
    if not model.is_on:
        return settings
    if not model.locked_joints:
        robot = RobotDescription.load(world.robot_description)
        idle = [name for name in robot.joints if name not in world.joints]
        model = replace(model, locked_joints=",".join(idle))
    if not model.left_wheel and not world.fixed_base:
        model = _rolling(model, world)
    return with_inertia(replace(settings, model=model), str(world.robot_description))


def models_of(controllers: Mapping[str, Sequence[LoopSettings]]) -> list[str]:
    """Return the URDF texts of models that are not the experiment's own robot.

    Args:
        controllers: Settings of each joint by the controller's label.

    Raises:
        HpidError: One cannot be read.
    """
    loops = [each for settings in controllers.values() for each in settings]
    sources = {each.model.description for each in loops if each.model.is_on}
    return [robot_xml(source) for source in sorted(sources - {""})]


def _rolling(model: ModelSettings, world: WorldSettings) -> ModelSettings:
    base = world.base
    if base is None or not {base.left, base.right} <= set(world.joints):
        return model
    return replace(
        model,
        left_wheel=base.left,
        right_wheel=base.right,
        wheel_radius=base.radius,
        wheel_separation=base.separation,
    )
