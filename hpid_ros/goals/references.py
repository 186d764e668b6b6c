"""Where the references of a group's joints are, as their controllers follow what they are told.

The controllers are asked for nothing: the code that follows a trajectory in each of them
(:class:`~hpid_ros.control.reference.Following`) runs here once more, fed with the same
trajectories and stamps. They differ by when exactly a controller took a trajectory up, which fades
with the glide. What controllers tell of their references is used where nothing was told them yet.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy

from hpid_ros.control.reference import Following
from hpid_ros.goals.settings import GroupSettings
from hpid_ros.goals.trajectories import GroupTrajectory

AGREES_WITHIN = 0.01
"""A controller whose reference is further from where it should be follows something else [rad]."""


class GroupReferences:
    """The references of all joints of a group.

    Args:
        settings: Of the group.
    """

    def __init__(self, settings: GroupSettings) -> None:
        self._joints, self._takeover_time = settings.joints, settings.takeover_time
        self._following = [Following() for _ in settings.joints]
        for following, facts in zip(self._following, settings.facts, strict=True):
            following.turn = math.tau if facts.takes_shorter_way else 0.0

    def restart(self) -> None:
        """Forget where they are."""
        for following in self._following:
            following.follow(None)
            following.restart()

    def stand(self, joint: int, position: float) -> None:
        """Let a joint's reference be at a position, at rest.

        Args:
            joint: Its place in the group.
            position: In [rad] or [m].
        """
        self._following[joint].follow(None)
        self._following[joint].stand(position)

    def is_standing(self, joint: int) -> bool:
        """Tell whether it is known where a joint's reference is."""
        return self._following[joint].is_standing

    def follow(self, trajectory: GroupTrajectory, now_ns: int) -> None:
        """Let the joints of a trajectory follow it from now on; they must be standing.

        Args:
            trajectory: Of some joints, or all.
            now_ns: The control clock in [ns].
        """
        for at, name in enumerate(trajectory.names):
            following = self._following[self._joints.index(name)]
            following.sample(now_ns, self._takeover_time, None)
            following.follow(trajectory.column(at))
            following.sample(now_ns, self._takeover_time, None)

    def sample(self, joint: int, stamp_ns: int) -> Sequence[float]:
        """Return position, velocity and acceleration of a joint's reference, and go on from there.

        Args:
            joint: Its place in the group.
            stamp_ns: The control clock in [ns].
        """
        return self._following[joint].sample(stamp_ns, self._takeover_time, None)

    def look(self, joint: int, stamp_ns: int) -> Sequence[float]:
        """Return the same of any instant, and leave everything as it is.

        Args:
            joint: Its place in the group.
            stamp_ns: The control clock in [ns].
        """
        return copy(self._following[joint]).sample(stamp_ns, self._takeover_time, None)
