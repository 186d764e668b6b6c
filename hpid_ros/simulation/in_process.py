"""The whole loop without ROS: the same joint loops and world, and the same numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from hpid_ros.control import JointLoop
from hpid_ros.control.compensation import Compensator
from hpid_ros.simulation.compensated import CompensatedLoops
from hpid_ros.simulation.world import World


class Sample(NamedTuple):
    """One state and the commands that answer it.

    Attributes:
        stamp_ns: Stamp of both in [ns].
        positions: Measured positions of the driven joints in [rad].
        applied: Efforts that the motors gave in the period before, in [N m].
        efforts: The commands in [N m].
        velocities: Measured velocities in [rad/s]; None where the robot measures none.
    """

    stamp_ns: int
    positions: Sequence[float]
    applied: Sequence[float]
    efforts: Sequence[float]
    velocities: Sequence[float] | None = None


def run_in_process(
    world: World,
    loops: Sequence[JointLoop],
    periods: int,
    observe: Callable[[Sample], None],
    compensators: Sequence[Compensator | None] = (),
) -> None:
    """Run a world under control from its present state on.

    Args:
        world: The world.
        loops: One loop for each driven joint, in the world's order.
        periods: Control periods to run; there is one state more.
        observe: Called with every sample, the last one included.
        compensators: The model of each loop, None for one without; empty where none has one.
    """
    compensated = None
    if any(compensators):
        compensated = CompensatedLoops(world.settings.joints, loops, compensators)
    unmeasured = (None,) * len(loops)
    for period in range(periods + 1):
        stamp_ns, positions, applied = world.time_ns, world.read(), world.applied_efforts()
        velocities = world.read_velocities()
        measured = unmeasured if velocities is None else velocities
        if compensated is not None:
            efforts = compensated.step(stamp_ns, positions, velocities, applied)
        else:
            efforts = [
                loop.step(stamp_ns, position, velocity)
                for loop, position, velocity in zip(loops, positions, measured, strict=True)
            ]
        observe(Sample(stamp_ns, positions, applied, efforts, velocities))
        if period < periods:
            world.step(efforts)
