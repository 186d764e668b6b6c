"""The section of an experiment file that says which joints are the wheels of a base."""

from __future__ import annotations

from hpid_ros.errors import ExperimentError, RobotDescriptionError, SettingError
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.differential_drive import DifferentialDrive
from hpid_ros.sections import Section


def base_from(robot: Section, description: RobotDescription) -> DifferentialDrive | None:
    """Return the base of a robot; None where the section names none.

    Args:
        robot: The section ``robot``, of which ``base`` is taken: ``left_wheel`` and
            ``right_wheel``, and, where the URDF is not to be asked, ``wheel_radius`` [m] and
            ``wheel_separation`` [m].
        description: The robot.

    Raises:
        ExperimentError: An entry is unknown, missing or out of range, or the robot's wheels are
            not a pair on one axle.
    """
    if "base" not in robot:
        return None
    base = robot.section("base")
    left, right = base.text("left_wheel"), base.text("right_wheel")
    radius, separation = (
        base.number(key, above=0.0) if key in base else None
        for key in ("wheel_radius", "wheel_separation")
    )
    base.finish()
    try:
        return DifferentialDrive.of(description, left, right, radius, separation)
    except (RobotDescriptionError, SettingError) as error:
        raise ExperimentError(f"{base.where}: {error}") from None
