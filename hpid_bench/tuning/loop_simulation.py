"""Controllers simulated on a robot along a recorded motion."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from hpid_bench.tuning.recorded_pid import recorded_answers, recorded_motion
from hpid_ros.base.errors import SettingError
from hpid_ros.base.processes import side_by_side
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.control.joint_loop import JointLoop
from hpid_ros.control.reference import Motion
from hpid_ros.control.settings import LoopSettings
from hpid_ros.messages.series import JointSeries, RunSeries, complete_run
from hpid_ros.motion.joint_trajectory import Column, Knot
from hpid_ros.robot.compensation import compensators
from hpid_ros.simulation.drives import DriveSettings
from hpid_ros.simulation.engine import record_run
from hpid_ros.simulation.settings import VelocityFilter, WorldSettings, default_engine
from hpid_ros.simulation.world import World

_STEP_DURATION = 3.0  # [s]
_LONGEST_GAP = 1.0
"""Between two recorded states, in [s]: beyond it the motion between them is anybody's guess."""
PHYSICS_STEPS = 2
"""In a control period: half the time of four, and no ratio moved by more than 0.01."""


class DriveFacts(NamedTuple):
    """What is known of a joint's drive and sensor, which no URDF says."""

    delay: int = 0  # by which its efforts act late, in control periods
    noise: float = 0.0  # [rad] standard deviation of what is added to its position
    resolution: float | None = None  # [rad] smallest step of its measured position
    velocity: VelocityFilter = VelocityFilter()  # how its driver reports velocities, if it does
    integral: float | None = None  # [N m] with which its PID began; None to look for it


@dataclass(frozen=True)
class RobotSimulation:
    """A robot, with what is known of its drives and sensors, and how it is simulated."""

    source: str  # path of its URDF, or the XML text
    fixed_base: bool = False  # whether its root is held
    initial_positions: Mapping[str, float] = field(default_factory=dict)  # where none is recorded
    facts: Mapping[str, DriveFacts] = field(default_factory=dict)  # by joint
    has_velocities: bool = False  # whether its states have velocities
    period: float | None = None  # [s] from one state to the next; None for the controllers' own
    engine: str | None = None  # that computes it; None for the default one


def simulate(
    robot: RobotSimulation,
    loops: Mapping[str, Sequence[LoopSettings]],
    recorded: Sequence[JointSeries],
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
    start = dict(robot.initial_positions)
    start |= {name: float(each.position[0]) for name, each in series.items()}
    period_ns = round((robot.period or first[0].timing.control_period) * NANOSECONDS)
    facts = [robot.facts.get(joint, DriveFacts()) for joint in joints]
    world = WorldSettings(
        robot_description=robot.source,
        joints=joints,
        control_period_ns=period_ns,
        initial_positions=start,
        fixed_base=robot.fixed_base,
        encoder_counts=tuple(map(_counts, first, facts)),
        physics_steps=PHYSICS_STEPS,
        position_noise=tuple(each.noise for each in facts),
        drives=tuple(DriveSettings(delay=each.delay) for each in facts),
        velocity_filters=tuple(each.velocity for each in facts),
        initial_efforts=tuple(_first_effort(series.get(joint)) for joint in joints),
        velocity="differences" if robot.has_velocities else "none",
        engine=robot.engine or default_engine(),
    )
    motions = {
        each.joint: _motion(each, series.get(each.joint), start.get(each.joint, 0.0))
        for each in first
    }
    duration = max((float(each.time[-1]) for each in series.values()), default=_STEP_DURATION)
    periods = math.floor(duration * NANOSECONDS / period_ns)
    integrals = {
        each.joint: _integral(each, known, series.get(each.joint))
        for each, known in zip(first, facts, strict=True)
    }
    work = partial(_run, world=world, motions=motions, integrals=integrals, periods=periods)
    found = dict(side_by_side(work, list(loops.items()), name=itemgetter(0)))
    return [found[place] for place in range(len(loops))]


def _first_effort(series: JointSeries | None) -> float:
    return float(series.effort[0]) if series is not None and series.has_effort else 0.0


def _integral(settings: LoopSettings, known: DriveFacts, series: JointSeries | None) -> float:
    if known.integral is not None or series is None:
        return known.integral or 0.0
    return recorded_answers(settings, series, {}).integral


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
    integrals: Mapping[str, float],
    periods: int,
) -> RunSeries:
    label, settings = task
    loops = [JointLoop(each) for each in settings]
    for loop in loops:
        motion: Motion = motions[loop.settings.joint]
        loop.begin_with(integrals[loop.settings.joint])
        loop.follow(motion)
    with World(world) as robot:
        models = compensators(settings, str(world.robot_description))
        stamps_ns, *columns = record_run(robot, loops, periods, models)
        slides = robot.description.slides
    return complete_run(label, world.joints, stamps_ns, columns, slides)


def _motion(settings: LoopSettings, series: JointSeries | None, start: float) -> Column:
    """Return the recorded reference, none to hold, or without a recording a step, in [rad]."""
    if series is None:
        return Column(settings.joint, (Knot(0, start + settings.norm_family.error_scale),))
    if not series.has_reference:
        return Column(settings.joint, (Knot(0, start),))
    stamps = series.state_stamps_ns - series.state_stamps_ns[0]
    return recorded_motion(settings.joint, stamps, series.reference)


def _counts(settings: LoopSettings, known: DriveFacts) -> int:
    own = known.resolution
    resolution = settings.encoder.encoder_resolution if own is None else own
    return round(math.tau / resolution) if resolution > 0.0 else 0
