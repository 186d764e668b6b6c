"""What a robot's description allows a joint, beside the parameters of its controller."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol

from hpid_ros.control.settings.loop import LoopSettings


class DescribedJoint(Protocol):
    """A joint as a robot's description has it: limits, and whether it turns without end."""

    @property
    def type(self) -> str:
        """As in URDF."""

    @property
    def effort(self) -> float:
        """Largest absolute effort in [N m]."""

    @property
    def lower(self) -> float:
        """Lowest position in [rad]."""

    @property
    def upper(self) -> float:
        """Highest position in [rad]."""

    @property
    def velocity(self) -> float:
        """Largest absolute velocity in [rad/s]; not positive where there is none."""

    @property
    def damping(self) -> float:
        """Viscous friction in [N m s/rad]."""

    @property
    def friction(self) -> float:
        """Coulomb friction in [N m]."""


@dataclass(frozen=True)
class RobotLimits:
    """What the robot's description allows a joint; it holds beside the parameters."""

    effort: float = math.inf  # [N m] largest absolute effort
    lower: float = -math.inf  # [rad] lowest position
    upper: float = math.inf  # [rad] highest position
    velocity: float = math.inf  # [rad/s] largest absolute velocity
    damping: float = 0.0  # [N m s/rad] its viscous friction
    friction: float = 0.0  # [N m] its Coulomb friction
    is_continuous: bool = False  # whether the joint turns without end
    is_slide: bool = False  # whether it slides: "rad" reads "m" then, and "N m" reads "N"

    @classmethod
    def of(cls, joint: DescribedJoint) -> RobotLimits:
        """Return those of a joint. A velocity of 0 is none, as many URDFs write it."""
        velocity = joint.velocity if joint.velocity > 0.0 else math.inf
        return cls(
            joint.effort,
            joint.lower,
            joint.upper,
            velocity,
            joint.damping,
            joint.friction,
            is_continuous=joint.type == "continuous",
            is_slide=joint.type == "prismatic",
        )

    def within(self, settings: LoopSettings) -> LoopSettings:
        """Return the settings within these limits."""
        effort, motion, encoder = settings.effort, settings.motion, settings.encoder
        ahead = settings.feedforward
        wraps = self.is_continuous and encoder.wrap < 0.0
        return replace(
            settings,
            effort=replace(
                effort,
                u_clamp_max=max(min(effort.u_clamp_max, self.effort), -self.effort),
                u_clamp_min=min(max(effort.u_clamp_min, -self.effort), self.effort),
            ),
            motion=replace(
                motion,
                position_max=min(motion.position_max, self.upper),
                position_min=max(motion.position_min, self.lower),
                velocity_max=min(motion.velocity_max, self.velocity),
            ),
            encoder=replace(encoder, wrap=math.tau if wraps else encoder.wrap),
            feedforward=replace(
                ahead,
                viscous_friction=_or_described(ahead.viscous_friction, self.damping),
                coulomb_friction=_or_described(ahead.coulomb_friction, self.friction),
            ),
        )


def _or_described(friction: float, described: float) -> float:
    return described if friction < 0.0 else friction
