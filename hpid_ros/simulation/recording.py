"""A whole run as arrays, filled while it goes on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.control import JointLoop
from hpid_ros.control.compensation import Compensator
from hpid_ros.simulation.in_process import Sample, run_in_process
from hpid_ros.simulation.world import World


class Recording(NamedTuple):
    """N states of K driven joints and the commands that answer them.

    Attributes:
        stamps_ns: Stamps of the states and of their answers, (N,), in [ns].
        positions: Measured positions, (N, K), in [rad].
        references: References as the loops sampled them, (N, K), in [rad].
        efforts: Commands, (N, K), in [N m].
    """

    stamps_ns: NDArray[np.int64]
    positions: NDArray[np.float64]
    references: NDArray[np.float64]
    efforts: NDArray[np.float64]


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
