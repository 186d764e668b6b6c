"""A robot that somebody names, with what is known of how it stands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hpid_ros.robot.description import RobotDescription


@dataclass(frozen=True)
class GivenRobot:
    """A robot that an option names."""

    source: str  # path of its URDF, or the XML text where more is known than the URDF says
    description: RobotDescription  # what that says
    fixed_base: bool = False  # whether its root is held
    initial_positions: Mapping[str, float] = field(default_factory=dict)
    wheels: tuple[str, ...] = ()  # joints on which its base rolls, as far as they are named
