"""What stands between a commanded effort and the torque at a joint."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hpid_ros.errors import SettingError


@dataclass(frozen=True)
class EffortActuator:
    """An ideal torque source with a limit.

    Attributes:
        joint: Name of the joint, for messages.
        limit: Largest absolute effort, in [N m]; +inf for none.
    """

    joint: str
    limit: float = math.inf

    def torque(self, effort: float) -> float:
        """Return the torque at the joint for a commanded effort, both in [N m].

        Raises:
            SettingError: The effort is not a finite number.
        """
        if not math.isfinite(effort):
            raise SettingError(f"effort {effort} of joint {self.joint!r} is not finite")
        return min(max(float(effort), -self.limit), self.limit)
