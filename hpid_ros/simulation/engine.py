"""The whole loop without ROS: the same joint loops and world, the same numbers, as arrays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.units import Numbers
from hpid_ros.control.joint_loop import JointLoop
from hpid_ros.robot.compensation import CompensatedLoops, Compensator
from hpid_ros.simulation.world import World


class Sample(NamedTuple):
    """One state and the commands that answer it."""

    stamp_ns: int  # [ns] stamp of both
    positions: Sequence[float]  # [rad] measured positions of the driven joints
    applied: Sequence[float]  # [N m] efforts that the motors gave in the period before
    efforts: Sequence[float]  # [N m] the commands
    velocities: Sequence[float] | None = None  # [rad/s] measured velocities


def run_in_process(
    world: World,
    loops: Sequence[JointLoop],
    periods: int,
    observe: Callable[[Sample], None],
    compensators: Sequence[Compensator | None] = (),
) -> None:
    """Run a world under control from its present state on."""
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
    """N states of K driven joints and the commands that answer them."""

    stamps_ns: NDArray[np.int64]  # [ns] stamps of the states and of their answers, (N,)
    positions: Numbers  # [rad] measured positions, (N, K)
    references: Numbers  # [rad] references as the loops sampled them, (N, K)
    efforts: Numbers  # [N m] commands, (N, K)


def record_run(
    world: World,
    loops: Sequence[JointLoop],
    periods: int,
    compensators: Sequence[Compensator | None] = (),
) -> Recording:
    """Run a world under control from its present state on, and keep every sample."""
    samples = periods + 1
    stamps_ns = np.empty(samples, np.int64)
    positions, references, efforts = np.empty((3, samples, len(loops)))
    rows = iter(range(samples))

    def observe(sample: Sample) -> None:
        row = next(rows)
        stamps_ns[row] = sample.stamp_ns
        positions[row] = sample.positions
        references[row] = [loop.following.position for loop in loops]
        efforts[row] = sample.efforts

    run_in_process(world, loops, periods, observe, compensators)
    return Recording(stamps_ns, positions, references, efforts)
