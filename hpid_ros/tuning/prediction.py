"""Prediction of an upgrade, simulated in this process on the robot's model."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool

from hpid_ros.analysis import Comparison, RunIndices, run_indices
from hpid_ros.base.errors import RunError
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.compensation.build import compensators
from hpid_ros.control import JointLoop, LoopSettings
from hpid_ros.control.reference import Motion
from hpid_ros.recordings.series import JointSeries, complete_run
from hpid_ros.simulation import World, WorldSettings
from hpid_ros.simulation.engine import record_run
from hpid_ros.trajectory import Column, Knot

_STEP_DURATION = 3.0  # [s]
_PHYSICS_STEPS = 2  # in a period: half the time, and no ratio moved by more than 0.01


def predict(
    robot: str,
    loops: Mapping[str, Sequence[LoopSettings]],
    recorded: Sequence[JointSeries],
    fixed_base: bool = False,
    initial_positions: Mapping[str, float] | None = None,
    tell: Callable[[str], None] = lambda label: None,
) -> Comparison:
    """Simulate controllers on a robot, side by side on the machine's cores, and compare them.

    The reference is the recorded one, from the recorded start; without a recording each joint
    steps by its ``norm.error_scale`` from where it starts.

    Args:
        robot: The robot's URDF, path or XML.
        loops: Settings of the same joints, in the same order, by the controller's label.
        recorded: The recorded joints, or none.
        fixed_base: The robot's root is held.
        initial_positions: Where joints start that are not recorded, in [rad]; others at 0.
        tell: Called with the label of a controller that has been simulated.

    Raises:
        RunError: A process died.
        HpidError: The robot lacks a joint, or cannot start where the recording does.
    """
    first = next(iter(loops.values()))
    joints = tuple(each.joint for each in first)
    series = {each.joint: each for each in recorded if each.joint in joints}
    start = dict(initial_positions or {})
    start |= {name: float(each.position[0]) for name, each in series.items()}
    period_ns = round(first[0].timing.control_period * NANOSECONDS)
    world = WorldSettings(
        robot_description=robot,
        joints=joints,
        control_period_ns=period_ns,
        initial_positions=start,
        fixed_base=fixed_base,
        encoder_counts=tuple(_counts(each) for each in first),
        physics_steps=_PHYSICS_STEPS,
    )
    motions = {
        each.joint: _motion(each, series.get(each.joint), start.get(each.joint, 0.0))
        for each in first
    }
    duration = max((float(each.time[-1]) for each in series.values()), default=_STEP_DURATION)
    periods = math.floor(duration * NANOSECONDS / period_ns)
    indices = {}
    with ProcessPoolExecutor(min(len(loops), len(os.sched_getaffinity(0)))) as pool:
        futures = {
            pool.submit(_run, label, world, each, motions, periods): label
            for label, each in loops.items()
        }
        try:
            for future in as_completed(futures):
                indices[futures[future]] = future.result()
                tell(futures[future])
        except BrokenProcessPool:
            raise RunError("a process died while controllers were simulated") from None
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
    return Comparison(tuple(indices[label] for label in loops))


def _run(
    label: str,
    world: WorldSettings,
    settings: Sequence[LoopSettings],
    motions: Mapping[str, Column],
    periods: int,
) -> RunIndices:
    loops = [JointLoop(each) for each in settings]
    for loop in loops:
        motion: Motion = motions[loop.settings.joint]
        loop.follow(motion)
    with World(world) as robot:
        models = compensators(settings, str(world.robot_description))
        stamps_ns, *columns = record_run(robot, loops, periods, models)
        slides = robot.description.slides
    return run_indices(complete_run(label, world.joints, stamps_ns, columns, slides))


def _motion(settings: LoopSettings, series: JointSeries | None, start: float) -> Column:
    """Return the recorded reference, or a step from where the joint starts, in [rad]."""
    if series is None:
        return Column(settings.joint, (Knot(0, start + settings.norm_family.error_scale),))
    stamps = series.state_stamps_ns - series.state_stamps_ns[0]
    knots = (Knot(int(t), float(x)) for t, x in zip(stamps, series.reference, strict=True))
    return Column(settings.joint, tuple(knots))


def _counts(settings: LoopSettings) -> int:
    resolution = settings.encoder.resolution
    return round(math.tau / resolution) if resolution > 0.0 else 0
