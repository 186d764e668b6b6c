"""The whole loop without ROS: the same joint loops and world, the same numbers, as arrays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.arrays import Numbers
from hpid_ros.compensation.loops import CompensatedLoops, Compensator
from hpid_ros.control import JointLoop
from hpid_ros.simulation.world.world import World


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


class Recording(NamedTuple):
    """N states of K driven joints and the commands that answer them.

    Attributes:
        stamps_ns: Stamps of the states and of their answers, (N,), in [ns].
        positions: Measured positions, (N, K), in [rad].
        references: References as the loops sampled them, (N, K), in [rad].
        efforts: Commands, (N, K), in [N m].
    """

    stamps_ns: NDArray[np.int64]
    positions: Numbers
    references: Numbers
    efforts: Numbers


def record_run(
    world: World,
    loops: Sequence[JointLoop],
    periods: int,
    compensators: Sequence[Compensator | None] = (),
) -> Recording:
    """Run a world under control from its present state on, and keep every sample.

    Args:
        world: The world.
        loops: One loop for each driven joint, in the world's order.
        periods: Control periods to run; there is one state more.
        compensators: The model of each loop, None for one without; empty where none has one.

    Raises:
        SettingError: A command is not finite.
    """
    samples = periods + 1
    stamps_ns = np.empty(samples, np.int64)
    positions, references, efforts = np.empty((3, samples, len(loops)))
    rows = iter(range(samples))

    def observe(sample: Sample) -> None:
        row = next(rows)
        stamps_ns[row] = sample.stamp_ns
        positions[row] = sample.positions
        references[row] = [loop.reference[0] for loop in loops]
        efforts[row] = sample.efforts

    run_in_process(world, loops, periods, observe, compensators)
    return Recording(stamps_ns, positions, references, efforts)
