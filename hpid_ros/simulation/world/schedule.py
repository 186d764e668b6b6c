"""The schedule of a world while it runs: pushes under way, changes of the load."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from hpid_ros.base.arrays import Vector
from hpid_ros.robot.description import RobotDescription
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world.disturbances import Event, PayloadChange, require_mass, vector
from hpid_ros.simulation.world.physics import Physics


class Pulse(NamedTuple):
    """A wrench under way.

    Attributes:
        link: Name of the link.
        force: On the origin of its frame, in the world frame, in [N].
        torque: In the world frame, in [N m].
        steps_left: Physics steps that it still acts.
    """

    link: str
    force: Vector
    torque: Vector
    steps_left: int


class DisturbanceSchedule:
    """The schedule of a world, and what is asked for besides.

    Args:
        physics: The engine.
        description: The robot in it.
        settings: Settings of the world.
    """

    def __init__(
        self, physics: Physics, description: RobotDescription, settings: WorldSettings
    ) -> None:
        self._physics = physics
        self._description, self._settings = description, settings
        self.begin()

    def begin(self) -> None:
        """Be at time 0, with nothing done yet."""
        self._pulses: list[Pulse] = []
        self._pending: list[Event] = self._settings.disturbances.in_order()[::-1]

    @property
    def is_pushing(self) -> bool:
        """Whether a push is under way."""
        return bool(self._pulses)

    def advance(self, now_ns: int) -> None:
        """Begin the disturbances that are due.

        Args:
            now_ns: Simulated time in [ns].
        """
        while self._pending and self._pending[-1].start_ns <= now_ns:
            event = self._pending.pop()
            if isinstance(event, PayloadChange):
                self.load(event.mass)
            else:
                self.push(event.link, event.force, event.torque, event.duration_ns)

    def apply(self) -> None:
        """Apply all pushes to the next physics step, and drop those that are over."""
        for pulse in self._pulses:
            self._physics.push(pulse.link, pulse.force, pulse.torque)
        if self._pulses:
            left = (pulse._replace(steps_left=pulse.steps_left - 1) for pulse in self._pulses)
            self._pulses = [pulse for pulse in left if pulse.steps_left]

    def push(
        self, link: str, force: Sequence[float], torque: Sequence[float], duration_ns: int
    ) -> None:
        """Push a link; see :meth:`~hpid_ros.simulation.world.world.World.apply_wrench`."""
        settings = self._settings
        steps = round(duration_ns * settings.physics_steps / settings.control_period_ns)
        name = self._description.link(link)
        pulse = Pulse(name, vector("force", force), vector("torque", torque), max(1, steps))
        self._pulses.append(pulse)

    def load(self, mass: float) -> None:
        """Change the payload; see :meth:`~hpid_ros.simulation.world.world.World.set_payload`."""
        self._description.link(self._settings.payload_link)
        self._physics.load(require_mass("payload_mass", mass))
