"""Prediction of an upgrade, simulated on the robot's model."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from operator import itemgetter
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_ros.base.errors import SettingError
from hpid_ros.base.processes import side_by_side
from hpid_ros.base.units import NANOSECONDS, Numbers
from hpid_ros.control.joint_loop import JointLoop
from hpid_ros.control.reference import Motion
from hpid_ros.control.settings import LoopSettings
from hpid_ros.messages.series import JointSeries, RunSeries, complete_run
from hpid_ros.motion.joint_trajectory import Column, Knot
from hpid_ros.robot.compensation import compensators
from hpid_ros.simulation.drives import DriveSettings
from hpid_ros.simulation.engine import record_run
from hpid_ros.simulation.settings import WorldSettings, default_engine
from hpid_ros.simulation.world import World

_STEP_DURATION = 3.0  # [s]
_JUMP = 10.0  # times as far as from one sample to the next before and after
_LEAST_JUMP = 1e-6  # [rad]
_BEYOND_NS = 1_000_000
_LONGEST_GAP = 1.0
"""Between two recorded states, in [s]: beyond it the motion between them is anybody's guess."""
PHYSICS_STEPS = 2
"""In a control period: half the time of four, and no ratio moved by more than 0.01."""


class JointFacts(NamedTuple):
    """What is known of a joint's drive and sensor, which no URDF says."""

    delay: int = 0  # by which its efforts act late, in control periods
    noise: float = 0.0  # [rad] standard deviation of what is added to its position
    resolution: float | None = None  # [rad] smallest step of its measured position


def simulate(
    robot: str,
    loops: Mapping[str, Sequence[LoopSettings]],
    recorded: Sequence[JointSeries],
    fixed_base: bool = False,
    initial_positions: Mapping[str, float] | None = None,
    *,
    facts: Mapping[str, JointFacts] | None = None,
    period: float | None = None,
    has_velocities: bool = False,
    engine: str | None = None,
) -> list[RunSeries]:
    """Simulate controllers on a robot, side by side on the machine's cores.

    The reference is the recorded one, from the recorded start; without a recording each joint
    steps by its ``norm.error_scale`` from where it starts.
    """
    first = next(iter(loops.values()))
    joints = tuple(each.joint for each in first)
    series = {each.joint: each for each in recorded if each.joint in joints}
    for each in series.values():
        _require_one_motion(each)
    start = dict(initial_positions or {})
    start |= {name: float(each.position[0]) for name, each in series.items()}
    period_ns = round((period or first[0].timing.control_period) * NANOSECONDS)
    known = [(facts or {}).get(joint, JointFacts()) for joint in joints]
    world = WorldSettings(
        robot_description=robot,
        joints=joints,
        control_period_ns=period_ns,
        initial_positions=start,
        fixed_base=fixed_base,
        encoder_counts=tuple(map(_counts, first, known)),
        physics_steps=PHYSICS_STEPS,
        position_noise=tuple(each.noise for each in known),
        drives=tuple(DriveSettings(delay=each.delay) for each in known),
        velocity="differences" if has_velocities else "none",
        engine=engine or default_engine(),
    )
    motions = {
        each.joint: _motion(each, series.get(each.joint), start.get(each.joint, 0.0))
        for each in first
    }
    duration = max((float(each.time[-1]) for each in series.values()), default=_STEP_DURATION)
    periods = math.floor(duration * NANOSECONDS / period_ns)
    work = partial(_run, world=world, motions=motions, periods=periods)
    found = dict(side_by_side(work, list(loops.items()), name=itemgetter(0)))
    return [found[place] for place in range(len(loops))]


def _require_one_motion(series: JointSeries) -> None:
    """Refuse a recording that cannot be simulated as one motion."""
    steps = np.diff(series.state_stamps_ns)
    if not len(steps) or (longest := int(steps.max())) <= _LONGEST_GAP * NANOSECONDS:
        return
    at = float(series.time[int(steps.argmax())])
    raise SettingError(
        f"{series.joint!r} has no state for {longest / NANOSECONDS:.3g} s from {at:.3f} s on: "
        "messages are missing, or the clock was set; to be simulated, a recording may have no "
        f"gap above {_LONGEST_GAP:g} s"
    )


def _run(
    task: tuple[str, Sequence[LoopSettings]],
    world: WorldSettings,
    motions: Mapping[str, Column],
    periods: int,
) -> RunSeries:
    label, settings = task
    loops = [JointLoop(each) for each in settings]
    for loop in loops:
        motion: Motion = motions[loop.settings.joint]
        loop.follow(motion)
    with World(world) as robot:
        models = compensators(settings, str(world.robot_description))
        stamps_ns, *columns = record_run(robot, loops, periods, models)
        slides = robot.description.slides
    return complete_run(label, world.joints, stamps_ns, columns, slides)


def _motion(settings: LoopSettings, series: JointSeries | None, start: float) -> Column:
    """Return the recorded reference, or a step from where the joint starts, in [rad]."""
    if series is None:
        return Column(settings.joint, (Knot(0, start + settings.norm_family.error_scale),))
    stamps = series.state_stamps_ns - series.state_stamps_ns[0]
    return recorded_motion(settings.joint, stamps, series.reference)


def recorded_motion(joint: str, times_ns: NDArray[np.int64], reference: Numbers) -> Column:
    """Return what goes through the samples of a reference, smooth but where it jumps.

    A jump is one nanosecond wide, as those of :func:`~hpid_ros.motion.generators.step` are: a
    ramp from one sample to the next would have a velocity that nobody was asked to follow.
    """
    steps = np.abs(np.diff(reference))
    near = np.maximum(np.append(steps[1:], 0.0), np.append(0.0, steps[:-1]))
    jumps = np.flatnonzero(steps > np.maximum(_JUMP * near, _LEAST_JUMP)) + 1
    knots: list[Knot] = []
    for times, values in zip(np.split(times_ns, jumps), np.split(reference, jumps), strict=True):
        if knots:
            knots.append(_going_on(knots[-1], int(times[0]) - 1))
        rates = _rates(times / NANOSECONDS, values)
        knots += map(Knot, times.tolist(), values.tolist(), rates.tolist())
    # What was recorded may end while it moves.
    return Column(joint, (*knots, _going_on(knots[-1], knots[-1].time_ns + _BEYOND_NS)))


def _going_on(knot: Knot, time_ns: int) -> Knot:
    """Return where a reference is at a later time if its velocity stays what it is."""
    way = (knot.velocity or 0.0) * (time_ns - knot.time_ns) / NANOSECONDS
    return Knot(time_ns, knot.position + way, knot.velocity)


def _rates(times: Numbers, values: Numbers) -> Numbers:
    if len(values) < 2:
        return np.zeros(len(values))
    order: Literal[1, 2] = 2 if len(values) > 2 else 1
    return np.asarray(np.gradient(values, times, edge_order=order))


def _counts(settings: LoopSettings, known: JointFacts) -> int:
    own = known.resolution
    resolution = settings.encoder.resolution if own is None else own
    return round(math.tau / resolution) if resolution > 0.0 else 0
