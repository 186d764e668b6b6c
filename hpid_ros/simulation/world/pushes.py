"""Pulses of force and torque on links, and changes of the load, on schedule."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from hpid_ros.robot.description import RobotDescription
from hpid_ros.simulation.poses import centre_of_mass, link_pose
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world.bullet import pybullet
from hpid_ros.simulation.world.disturbances import (
    Event,
    PayloadChange,
    require_mass,
    vector,
)
from hpid_ros.simulation.world.scene import Scene

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

    def apply(self, client: int, body: int) -> None:
        """Apply the pulse to the next physics step of a robot."""
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

    def apply(self, client: int, body: int) -> None:
        """Apply all to the next physics step of a robot, and drop those that are over."""
        for pulse in self.pulses:
            pulse.apply(client, body)
        self.pulses = [pulse for pulse in self.pulses if pulse.steps_left]


class DisturbanceSchedule:
    """The schedule of a scene, and what is asked for besides.

    Args:
        client: PyBullet's client.
        scene: The scene.
        description: The robot in it.
        settings: Settings of the world.
    """

    def __init__(
        self, client: int, scene: Scene, description: RobotDescription, settings: WorldSettings
    ) -> None:
        self._client, self._scene = client, scene
        self._description, self._settings = description, settings
        self._pushes = Pushes()
        self._pending: list[Event] = []

    def begin(self) -> None:
        """Be at time 0, with nothing done yet."""
        self._pushes.pulses.clear()
        self._pending = self._settings.disturbances.in_order()[::-1]

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
        """Apply all pushes to the next physics step."""
        if self._pushes.pulses:
            self._pushes.apply(self._client, self._scene.body)

    def push(
        self, link: str, force: Sequence[float], torque: Sequence[float], duration_ns: int
    ) -> None:
        """Push a link; see :meth:`~hpid_ros.simulation.world.world.World.apply_wrench`."""
        settings = self._settings
        steps = round(duration_ns * settings.physics_steps / settings.control_period_ns)
        push = vector("force", force), vector("torque", torque)
        index = self._scene.links[self._description.link(link)]
        self._pushes.pulses.append(Pulse(index, *push, max(1, steps)))

    def load(self, mass: float) -> None:
        """Change the payload; see :meth:`~hpid_ros.simulation.world.world.World.set_payload`."""
        self._description.link(self._settings.payload_link)
        self._scene.load_payload(self._client, require_mass("payload_mass", mass))
