"""Pulses of force and torque on links."""

from __future__ import annotations

from dataclasses import dataclass

from hpid_ros.simulation.bullet import pybullet
from hpid_ros.simulation.poses import centre_of_mass, link_pose

Vector = tuple[float, float, float]


@dataclass
class Pulse:
    """A wrench that acts for a number of physics steps.

    Attributes:
        link: Bullet's index of the link.
        force: Force on the origin of the link's frame, in the world frame, in [N].
        torque: Torque, in the world frame, in [N m].
        steps_left: Physics steps that it still acts.
    """

    link: int
    force: Vector
    torque: Vector
    steps_left: int

    def act(self, client: int, body: int) -> None:
        """Act on the next physics step of a robot."""
        self.steps_left -= 1
        origin = link_pose(client, body, self.link).position
        centre = centre_of_mass(client, body, self.link)
        x, y, z = (a - b for a, b in zip(origin, centre, strict=True))
        fx, fy, fz = self.force
        tx, ty, tz = self.torque
        pybullet.applyExternalForce(
            body,
            self.link,
            self.force,
            centre,
            pybullet.WORLD_FRAME,
            physicsClientId=client,
        )
        pybullet.applyExternalTorque(
            body,
            self.link,
            (tx + y * fz - z * fy, ty + z * fx - x * fz, tz + x * fy - y * fx),
            pybullet.WORLD_FRAME,
            physicsClientId=client,
        )


class Pushes:
    """The pulses under way.

    Attributes:
        pulses: Those that still act.
    """

    def __init__(self) -> None:
        self.pulses: list[Pulse] = []

    def act(self, client: int, body: int) -> None:
        """Let all act on the next physics step of a robot, and drop those that are over."""
        for pulse in self.pulses:
            pulse.act(client, body)
        self.pulses = [pulse for pulse in self.pulses if pulse.steps_left]
