"""A robot that somebody names, with what is known of how it stands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hpid_ros.robot.description import RobotDescription


@dataclass(frozen=True)
class GivenRobot:
    """A robot that an option names.

    Attributes:
        source: Path of its URDF, or the XML text where more is known than the URDF says.
        description: What that says.
        fixed_base: Whether its root is held.
        initial_positions: Where its joints stand at first, in [rad]; others at 0.
        wheels: Joints on which its base rolls, as far as they are named.
    """

    source: str
    description: RobotDescription
    fixed_base: bool = False
    initial_positions: Mapping[str, float] = field(default_factory=dict)
    wheels: tuple[str, ...] = ()
