"""What has been measured of a group's joints, and how long ago by the stamps."""

from __future__ import annotations

import math
from collections.abc import Sequence

from hpid_ros.base.units import NANOSECONDS, SECONDS_PER_NANOSECOND
from hpid_ros.control.reference import LARGEST_POSITION
from hpid_ros.control.velocity import MeasuredVelocity, Unwrapper
from hpid_ros.goals.settings import GroupSettings
from hpid_ros.wire import JointPart

_VELOCITY_FILTER = 0.05  # [s], for states without velocities: one count of an encoder is no motion


class GroupStates:
    """The newest state of each joint.

    Attributes:
        now_ns: The newest stamp of all, in [ns]; None before the first state.
        stamps_ns: Stamp of each joint's state in [ns]; None where there is none.
        positions: In [rad] or [m].
        velocities: In [rad/s] or [m/s]; estimated where states have none.
        unusable: States that were not finite.

    Args:
        settings: Of the group.
    """

    def __init__(self, settings: GroupSettings) -> None:
        self._joints = settings.joints
        self._timeout = settings.state_timeout
        self._sources = [MeasuredVelocity(_VELOCITY_FILTER) for _ in settings.joints]
        self._unwrappers = [
            Unwrapper(math.tau) if facts.is_endless else None for facts in settings.facts
        ]
        self.unusable = 0
        self.restart()

    def restart(self) -> None:
        """Forget everything: the next state is the first one."""
        count = len(self._joints)
        self.now_ns: int | None = None
        self.stamps_ns: list[int | None] = [None] * count
        self.positions, self.velocities = [0.0] * count, [0.0] * count
        for source in self._sources:
            source.reset()
        for unwrapper in self._unwrappers:
            if unwrapper is not None:
                unwrapper.reset()

    def take(self, stamp_ns: int, parts: Sequence[JointPart]) -> list[int] | None:
        """Take the joints of one message.

        Args:
            stamp_ns: Its stamp in [ns].
            parts: Those of the joints that it has.

        Returns:
            The joints that have a new state; None if the clock has gone back: then nothing was
            taken.
        """
        for part in parts:
            before_ns = self.stamps_ns[part.joint]
            if before_ns is not None and stamp_ns < before_ns:
                return None
        taken = []
        for joint, position, velocity in parts:
            before_ns = self.stamps_ns[joint]
            if stamp_ns == before_ns:
                continue  # a repeat
            if not -LARGEST_POSITION <= position <= LARGEST_POSITION:
                self.unusable += 1
                continue
            since = 0.0 if before_ns is None else (stamp_ns - before_ns) * SECONDS_PER_NANOSECOND
            unwrapper = self._unwrappers[joint]
            steady = position if unwrapper is None else unwrapper.update(position)
            if velocity is not None and not -LARGEST_POSITION <= velocity <= LARGEST_POSITION:
                velocity = None  # drivers fill in NaN for what they do not measure
            self.stamps_ns[joint] = stamp_ns
            self.positions[joint] = position
            self.velocities[joint] = self._sources[joint].update(steady, velocity, since)
            taken.append(joint)
        if taken and (self.now_ns is None or stamp_ns > self.now_ns):
            self.now_ns = stamp_ns
        return taken

    @property
    def are_complete(self) -> bool:
        """Whether every joint has a state."""
        return None not in self.stamps_ns

    def lack(self) -> str:
        """Return which joint has no state, or an old one, in words; nothing if all are there."""
        for joint, stamp_ns in zip(self._joints, self.stamps_ns, strict=True):
            if stamp_ns is None or self.now_ns is None:
                return f"there is no state of {joint} yet"
            age = (self.now_ns - stamp_ns) / NANOSECONDS
            if age > self._timeout:
                return f"{joint} has had no state for {age:.3g} s"
        return ""
