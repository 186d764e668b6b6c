"""What a run's bag says of the base."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hpid_ros.analysis import RunSeries
from hpid_ros.analysis.base_figures import BaseFigures, base_figures
from hpid_ros.bags.base_messages import read_planar, read_vectors
from hpid_ros.experiment.base_recording import ODOM, SLIP, TRUTH
from hpid_ros.experiment.description import Experiment
from hpid_ros.robot.differential_drive import DifferentialDrive
from hpid_ros.robot.odometry import integrated
from hpid_ros.simulation.settings import WorldSettings

Numbers = NDArray[np.float64]


def base_results(
    experiment: Experiment, bags: Mapping[str, Path], runs: Sequence[RunSeries]
) -> dict[str, BaseFigures]:
    """Compute the figures of the base of each run; none for a robot without a base.

    Args:
        experiment: What was run.
        bags: The bag of each run.
        runs: The runs, read from them.

    Raises:
        BagError: A bag lacks the odometry, the truth or the slip.
    """
    base = experiment.world.base
    if base is None:
        return {}
    return {run.label: _figures(experiment.world, base, bags[run.label], run) for run in runs}


def _figures(
    world: WorldSettings, base: DifferentialDrive, bag: Path, run: RunSeries
) -> BaseFigures:
    odometry, truth = read_planar(bag, ODOM), read_planar(bag, TRUTH)
    # Each state's messages come together; of a bag that was cut off one may lack its last.
    stamps_ns, at_odometry, at_truth = np.intersect1d(
        odometry.stamps_ns, truth.stamps_ns, assume_unique=True, return_indices=True
    )
    _, slips = read_vectors(bag, SLIP)
    left, right, lateral = slips[-1].tolist()
    return base_figures(
        odometry.poses[at_odometry],
        truth.poses[at_truth],
        reference_poses(world, base, run, stamps_ns),
        (left, right, lateral),
    )


def reference_poses(
    world: WorldSettings, base: DifferentialDrive, run: RunSeries, stamps_ns: NDArray[np.int64]
) -> Numbers | None:
    """Return where the base would be if its wheels followed their references and did not slip.

    Args:
        world: The world, for where the wheels stood at time 0.
        base: The base.
        run: A run of it.
        stamps_ns: When, (N,), in [ns]; stamps of states.

    Returns:
        x [m], y [m] and heading [rad] from where the base stood at time 0, (N, 3); None where
        the run has not both wheels.
    """
    series = {each.joint: each for each in run.joints}
    if not all(wheel in series for wheel in base.joints):
        return None
    left, right = (
        np.concatenate(([world.initial_positions.get(wheel, 0.0)], series[wheel].reference))
        for wheel in base.joints
    )
    states_ns = series[base.left].state_stamps_ns
    poses = integrated(base, left, right)[1:]
    return poses[np.clip(np.searchsorted(states_ns, stamps_ns), 0, len(states_ns) - 1)]
