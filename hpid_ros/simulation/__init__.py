"""The simulated robot; the only importer of PyBullet and MuJoCo.

:class:`World` is the door: efforts in, measured positions out. This package is imported by name
where a simulation is wanted, never by the rest of hpid_ros, so that a robot's computer needs no
PyBullet.
"""

from hpid_ros.simulation.poses import Pose, Twist
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world.world import World

__all__ = ["Pose", "Twist", "World", "WorldSettings"]
