"""What the robot's board reads of its joints, once a control period."""

from __future__ import annotations

import random
from collections.abc import Sequence

from hpid_ros.simulation.settings import WorldSettings


class Sensors:
    """Encoders with noise, with the zero that a homing run found, and with differences.

    What is drawn by chance comes from a stream of each joint's own, which neither the other
    joints nor the number of readings change.

    Args:
        settings: Settings of the world.
        start: Positions of the driven joints at time 0, in [rad].
    """

    def __init__(self, settings: WorldSettings, start: Sequence[float]) -> None:
        self._encoders = settings.encoders
        self._noise = settings.position_noises
        self._chances = [stream(settings.seed, "noise", joint) for joint in settings.joints]
        self._period = settings.control_period_ns * 1e-9
        self._has_differences = settings.velocity == "differences"
        self._offsets = [0.0] * len(settings.joints)
        for index, homing in enumerate(settings.homings):
            if homing is not None:
                chance = stream(settings.seed, "homing", settings.joints[index])
                self._offsets[index] = homing.error(
                    start[index], self._period, self._encoders[index], chance
                )
        self.positions = self._read(start)
        """Measured positions, in [rad]."""
        self.velocities = (0.0,) * len(start) if self._has_differences else None
        """Measured velocities, in [rad/s]; None where none are."""

    @property
    def offsets(self) -> tuple[float, ...]:
        """What the readings are wrong by since homing, in [rad]."""
        return tuple(self._offsets)

    def sample(self, positions: Sequence[float]) -> None:
        """Measure once; called once a control period.

        Args:
            positions: True positions, in [rad].
        """
        before, self.positions = self.positions, self._read(positions)
        if self._has_differences:
            self.velocities = tuple(
                [
                    (now - then) / self._period
                    for now, then in zip(self.positions, before, strict=True)
                ]
            )

    def _read(self, positions: Sequence[float]) -> tuple[float, ...]:
        each = zip(
            self._encoders, positions, self._noise, self._chances, self._offsets, strict=True
        )
        return tuple(
            [
                encoder.read(position + (noise * chance.gauss(0.0, 1.0) if noise else 0.0)) + off
                for encoder, position, noise, chance, off in each
            ]
        )


def stream(seed: int, purpose: str, joint: str) -> random.Random:
    """Return a joint's own source of chance, the same in every process.

    Args:
        seed: Of the world.
        purpose: What is drawn from it.
        joint: Name of the joint.
    """
    return random.Random(f"{seed} {purpose} {joint}")
