"""One joint of a robot, as its description has it: kind, limits, friction, rotor."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from hpid_ros.base.errors import RobotDescriptionError
from hpid_ros.control.settings import LARGEST_EFFORT, LoopSettings


@dataclass(frozen=True)
class JointDescription:
    """One moving joint; "per rad" reads "per m" where the joint is prismatic."""

    name: str  # name of the joint
    type: str  # revolute, continuous or prismatic
    # axis of motion in the frame of the joint, as the URDF gives it
    axis: tuple[float, float, float]
    parent: str  # name of the parent link
    child: str  # name of the child link
    lower: float = -math.inf  # [rad] lowest position; -inf where there is none
    upper: float = math.inf  # [rad] highest position; +inf where there is none
    effort: float = math.inf  # [N m] or [N], largest absolute; +inf where there is none, or 0
    velocity: float = math.inf  # [rad/s] largest absolute velocity; +inf where there is none
    damping: float = 0.0  # [N m s/rad] viscous friction
    friction: float = 0.0  # [N m] or [N], Coulomb friction
    rotor_inertia: float = 0.0  # [kg m^2] inertia of the motor's rotor about its own axis
    gear_ratio: float = 1.0  # turns of the rotor for one turn of the joint; 1 without a gear
    has_zero_effort: bool = False  # whether its limit of effort is 0: nobody can drive it by that

    @property
    def is_slide(self) -> bool:
        """Whether it slides: its units are m and N."""
        return self.type == "prismatic"

    @property
    def is_continuous(self) -> bool:
        """Whether it turns without end."""
        return self.type == "continuous"

    @property
    def reflected_inertia(self) -> float:
        """Rotor inertia as the joint feels it, Jr N^2, in [kg m^2]."""
        return self.rotor_inertia * self.gear_ratio**2

    def require_effort(self, settings: LoopSettings) -> None:
        """Refuse settings that drive the joint where neither they nor the URDF say an effort."""
        if self.has_zero_effort and settings.effort.largest == LARGEST_EFFORT:
            raise RobotDescriptionError(
                f"joint {self.name!r}: its effort limit in the URDF is 0: say what its motor can "
                f"give (robot.joints.{self.name}.effort of an experiment, or u_clamp_max), or "
                "hold it (robot.held)"
            )

    def within(self, settings: LoopSettings) -> LoopSettings:
        """Return settings within the limits of this joint, with its friction where they ask."""
        effort, motion, encoder = settings.effort, settings.motion, settings.encoder
        ahead = settings.feedforward
        wraps = self.is_continuous and encoder.encoder_wrap < 0.0
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
            encoder=replace(encoder, encoder_wrap=math.tau if wraps else encoder.encoder_wrap),
            feedforward=replace(
                ahead,
                viscous_friction=(
                    self.damping if ahead.viscous_friction < 0.0 else ahead.viscous_friction
                ),
                coulomb_friction=(
                    self.friction if ahead.coulomb_friction < 0.0 else ahead.coulomb_friction
                ),
            ),
        )


UNLIMITED = JointDescription("", "revolute", (1.0, 0.0, 0.0), "", "")
"""A joint of which nothing is known."""
