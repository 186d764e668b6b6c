"""The newest command of each joint, held until the next one: what a paced robot acts on."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from hpid_ros.simulation.lockstep import AnswerCounts


class HeldCommands:
    """Takes commands as they come and waits for nobody; else it has the face of a ``Barrier``.

    A command stands until the joint's next one, whichever state it answers, so that a late
    controller costs delay and not effort. A joint whose last command came too long ago gets no
    effort: its controller is gone.

    Args:
        joints: The driven joints, in the order of the efforts.
        timeout_ns: Simulated time for which a command stands, in [ns].
        limits: Largest absolute effort of each joint in [N m]; without limit if not given.
    """

    missing: tuple[str, ...] = ()
    """Nobody is waited for."""

    is_abandoned = False
    """Time goes on without answers."""

    def __init__(
        self, joints: Sequence[str], timeout_ns: int, limits: Mapping[str, float] | None = None
    ) -> None:
        self.joints = tuple(joints)
        self.counts = {joint: AnswerCounts() for joint in self.joints}
        self.foreign = 0
        self._timeout_ns = timeout_ns
        self._stamp_ns = 0
        self._held: dict[str, tuple[int, float]] = {}
        self._limits = limits or {}
        self._last: dict[str, tuple[int, float]] = {}  # stamp and effort, as they came

    @property
    def silent(self) -> tuple[str, ...]:
        """Joints without a command that still stands, in their order."""
        return tuple(joint for joint in self.joints if self._effort(joint) is None)

    def begin(self, stamp_ns: int) -> None:
        """Note the present state; a clock that goes back ends all commands.

        Args:
            stamp_ns: Its stamp in [ns].
        """
        if stamp_ns < self._stamp_ns:
            self._held.clear()
            self._last.clear()
        self._stamp_ns = stamp_ns

    def answer(self, stamp_ns: int, names: Sequence[str], efforts: Sequence[float]) -> bool:
        """Take a command.

        Args:
            stamp_ns: Stamp of the state that it answers in [ns]; another than the present one
                is counted as stale, and the command is taken all the same.
            names: Its joints.
            efforts: Their efforts in [N m]; one that is not finite is taken as zero.

        Returns:
            False: no command completes anything.
        """
        for name, effort in zip(names, efforts, strict=True):
            counts = self.counts.get(name)
            if counts is None:
                self.foreign += 1
                continue
            counts.answered += 1
            counts.stale += stamp_ns != self._stamp_ns
            counts.conflicting += self._is_by_another(name, stamp_ns, effort)
            self._last[name] = stamp_ns, effort
            effort = counts.checked(effort, self._limits.get(name, math.inf))
            self._held[name] = self._stamp_ns, effort
        return False

    def _is_by_another(self, name: str, stamp_ns: int, effort: float) -> bool:
        """Tell whether a command does not continue the joint's last one.

        One controller answers each state once, in their order; it repeats itself, and leaves
        with an effort of zero. Commands without stamps say nothing about their order.
        """
        before_ns, before = self._last.get(name, (0, 0.0))
        if effort == 0.0 or before_ns == 0:
            return False
        return stamp_ns < before_ns or (stamp_ns == before_ns and effort != before)

    def give_up(self) -> tuple[str, ...]:
        """Return the joints that are no longer waited for: none ever was."""
        return ()

    def finish(self) -> list[float]:
        """Count who is silent, and return the efforts for the physics in [N m]."""
        efforts = []
        for joint in self.joints:
            effort = self._effort(joint)
            self.counts[joint].unanswered += effort is None
            efforts.append(effort or 0.0)
        return efforts

    def _effort(self, joint: str) -> float | None:
        """Return the command that stands in [N m]; None when there is none."""
        came_ns, effort = self._held.get(joint, (-self._timeout_ns - 1, 0.0))
        return effort if self._stamp_ns - came_ns <= self._timeout_ns else None
