"""How well robots are identified whose truth is known: ``python -m benchmarks.identification``.

Draws friction, rotors, noise and delay for robots of the example experiments, moves their joints
in process along multisines, all at once (identified with the URDF, which knows no rotors and no
friction) or one after the other (without), and compares what is found with the truth. Prints a
table in Markdown: median, 95 % point and largest of the errors, how many are within the limit, and
how many of the 95 % intervals contain the truth.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from importlib.util import find_spec
from itertools import repeat
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from hpid_bench.experiment.description import Experiment, following_loops, load_experiment
from hpid_bench.tuning.identification.identify import identify
from hpid_bench.tuning.identification.joint_identification import JointIdentification
from hpid_bench.tuning.identification.joint_record import JointRecord
from hpid_bench.tuning.identification.regression import COULOMB, DELAY, INERTIA, VISCOUS
from hpid_ros.base.resources import find_resource
from hpid_ros.motion import JointTrajectory, TrajectoryPoint
from hpid_ros.motion.excitation import Design, JointBounds, Wish, plan
from hpid_ros.robot.amendments import JointAmendment, amended
from hpid_ros.robot.compensation import compensators
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.dynamics import Dynamics, InverseDynamics
from hpid_ros.simulation.engine import Recording, record_run
from hpid_ros.simulation.world import World

ROBOTS = ("paper", "iiwa", "panda") if find_spec("pybullet_data") else ("paper",)
PERIOD = 1e-3  # [s]
_TOGETHER, _ALONE = 20.0, 12.0  # [s], of all joints, of each, unless --duration says otherwise
_NOISES = (5e-5, 4e-4)  # [rad]
_COUNTS = 65536
_HEADINGS = (
    "robot",
    "parameter",
    "numbers",
    "told",
    "median error",
    "95 %",
    "largest",
    "within limit",
    "inside interval",
)
_LIMITS: Mapping[str, float] = {INERTIA: 0.03, VISCOUS: 0.1, COULOMB: 0.1, DELAY: 0.5}


class Truth(NamedTuple):
    """What is drawn for one joint."""

    viscous: float  # in [N m s/rad]
    coulomb: float  # in [N m]
    rotor: float  # reflected inertia, in [kg m^2]
    delay: float  # in [s]


@dataclass(frozen=True)
class Drawn:
    """A robot drawn at random."""

    experiment: Experiment  # in which it moves
    bare: RobotDescription  # its description without rotors and friction
    truth: Mapping[str, Truth]  # by joint


class Setup(NamedTuple):
    """How robots are moved."""

    engine: str  # who computes the physics
    duration: float  # of the motion in [s]; of each joint if they move one by one
    is_alone: bool  # they move one by one


class Finding(NamedTuple):
    """One number beside its truth."""

    joint: str  # of which joint
    name: str  # of the parameter
    error: float  # relative; of a delay in control periods
    is_inside: bool  # whether the interval contains the truth
    is_reliable: bool  # whether the data are said to tell it


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.identification", description=__doc__
    )
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("robots", nargs="*", default=ROBOTS, metavar="ROBOT", help="(all)")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=1, help="the first of the seeds (1)")
    parser.add_argument("--engine", default="mujoco", help="(mujoco)")
    parser.add_argument("--duration", type=float, help="of the motion in [s] (20; 12 a joint)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (1)")
    parser.add_argument("--alone", action="store_true", help="one joint at a time, without URDF")
    parser.add_argument("--verbose", action="store_true", help="every number that is too far off")
    options = parser.parse_args(arguments)
    print(f"| {' | '.join(_HEADINGS)} |")
    print("|---|---|---|---|---|---|---|---|---|")
    duration = options.duration or (_ALONE if options.alone else _TOGETHER)
    setup = Setup(options.engine, duration, options.alone)
    seeds = range(options.first, options.first + options.seeds)
    with ProcessPoolExecutor(options.jobs, get_context("spawn")) as pool:
        for robot in options.robots:
            found = []
            for seed, new in zip(
                seeds, pool.map(_findings, repeat(robot), seeds, repeat(setup)), strict=True
            ):
                found += new
                if options.verbose:
                    for each in new:
                        if not each.is_inside or abs(each.error) > _LIMITS[each.name]:
                            print(seed, each, file=sys.stderr, flush=True)
            for name in _LIMITS:
                print(_row(robot, name, [e for e in found if e.name == name]), flush=True)
    return 0


def _row(robot: str, name: str, found: Sequence[Finding]) -> str:
    told = [each for each in found if each.is_reliable]
    errors = np.abs([each.error for each in told]) if told else np.full(1, np.nan)
    scale, unit = (1.0, " T") if name == DELAY else (100.0, " %")
    within = np.mean(errors <= _LIMITS[name])
    inside = np.mean([each.is_inside for each in told]) if told else np.nan
    middle, high, most = (scale * np.quantile(errors, each) for each in (0.5, 0.95, 1.0))
    return (
        f"| {robot} | {name} | {len(found)} | {len(told)} | {middle:.2g}{unit} | {high:.2g}{unit} "
        f"| {most:.2g}{unit} | {within:.1%} | {inside:.1%} |"
    )


def _findings(robot: str, seed: int, setup: Setup) -> list[Finding]:
    """Draw a robot, move it, identify it, and return every number beside its truth."""
    chance = np.random.default_rng([seed, *robot.encode()])
    drawn = draw(robot, seed, setup, chance)
    joints = drawn.experiment.world.joints
    arm = [name for name in joints if name in drawn.truth]
    trajectory, windows = excitation(drawn, arm, setup, seed)
    recording = move(replace(drawn.experiment, trajectory=trajectory))
    if setup.is_alone:
        found = [
            identify([record_of(recording, joints, name, window)])[0]
            for name, window in windows.items()
        ]
    else:
        body = InverseDynamics(drawn.bare, joints)
        records = [record_of(recording, joints, name) for name in joints]
        found = list(identify(records, body.efforts, wanted=arm, spin=body.spin))
    return [finding for each in found for finding in _beside_truth(drawn, each, setup.is_alone)]


def draw(robot: str, seed: int, setup: Setup, chance: np.random.Generator) -> Drawn:
    """Return a robot with friction, rotors, noise and delay drawn at random."""
    path = find_resource(f"config/experiments/{robot}.yaml")
    plain = load_experiment(path)
    description = RobotDescription.load(plain.world.robot_description)
    arm = [name for name in plain.world.joints if "wheel" not in name]
    delay = int(chance.integers(0, 4))
    truth, amendments = {}, {}
    for name in arm:
        joint = description.joints[name]
        coulomb = joint.effort * float(chance.uniform(0.005, 0.02))
        viscous = coulomb * float(chance.uniform(0.5, 1.5))
        rotor = joint.reflected_inertia * float(chance.uniform(0.7, 1.4))
        truth[name] = Truth(viscous, coulomb, rotor, delay * PERIOD)
        amendments[name] = {
            "rotor_inertia": rotor / joint.gear_ratio**2,
            "damping": viscous,
            "friction": coulomb,
        }
    document: dict[str, Any] = {
        "extends": str(path),
        "duration": setup.duration,
        "seed": seed,
        "robot": {
            **{"fixed_base": True, "joints": amendments},
            **({"base": None} if plain.world.base is not None else {}),
        },
        "simulation": {"engine": setup.engine},
        "sensors": {"noise": float(chance.uniform(*_NOISES)), "encoder_counts": _COUNTS},
        "actuators": {"delay": delay},
    }
    nothing = {name: JointAmendment(rotor_inertia=0.0, damping=0.0, friction=0.0) for name in arm}
    return Drawn(_loaded(document), amended(description, nothing, {}, {}), truth)


def _loaded(document: Mapping[str, Any]) -> Experiment:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "drawn.yaml"
        file.write_text(yaml.safe_dump(document))
        return load_experiment(file)


def excitation(
    drawn: Drawn, arm: Sequence[str], setup: Setup, seed: int
) -> tuple[JointTrajectory, dict[str, tuple[float, float]]]:
    """Return what ``hpid excite`` would do with these joints, and when each of them moves."""
    joints, start = drawn.experiment.world.joints, drawn.experiment.world.initial_positions
    design = Design(duration=setup.duration, are_together=not setup.is_alone, seed=seed)
    planned = plan([_bounds(drawn, name) for name in arm], Wish(), design)
    states = np.zeros((3, len(planned.times), len(joints)))
    columns = [joints.index(name) for name in planned.names]
    states[:, :, columns] = planned.positions, planned.velocities, planned.accelerations
    states[0] += [start.get(name, 0.0) for name in joints]
    points = tuple(
        TrajectoryPoint(round(time * 1e9), *(tuple(each[k]) for each in states))
        for k, time in enumerate(planned.times)
    )
    windows = {each.bounds.joint: (each.begin, each.end) for each in planned.joints}
    return JointTrajectory(tuple(joints), points), windows


def _bounds(drawn: Drawn, name: str) -> JointBounds:
    """Return what a joint may do by its description, from where it stands."""
    joint, start = drawn.bare.joints[name], drawn.experiment.world.initial_positions
    load = _dynamics(drawn).gravity_torques([name], start)[name]
    limits = (joint.lower, joint.upper, joint.velocity, (-joint.effort, joint.effort))
    inertia = _moved_inertia(drawn, name)
    return JointBounds(name, "", start.get(name, 0.0), load, *limits, inertia=inertia)


def move(experiment: Experiment) -> Recording:
    """Return the run of an experiment's first controller along its trajectory."""
    settings = next(iter(experiment.controllers.values()))
    loops = following_loops(settings, experiment.trajectory)
    models = compensators(settings, str(experiment.world.robot_description))
    periods = round(experiment.trajectory.points[-1].time_from_start_ns * 1e-9 / PERIOD)
    with World(experiment.world) as world:
        return record_run(world, loops, periods, models)


def record_of(
    recording: Recording,
    joints: Sequence[str],
    name: str,
    window: tuple[float, float] = (-np.inf, np.inf),
) -> JointRecord:
    """Return one joint of a recording."""
    time = np.asarray(recording.stamps_ns * 1e-9, dtype=np.float64)
    inside = (time >= window[0]) & (time <= window[1])
    place, time = joints.index(name), time[inside]
    position, effort = recording.positions[inside, place], recording.efforts[inside, place]
    reference = recording.references[inside, place]
    return JointRecord(name, time, position, time, effort, reference)


def _beside_truth(drawn: Drawn, found: JointIdentification, is_alone: bool) -> Iterator[Finding]:
    """Yield the numbers of one joint, each beside its truth."""
    truth = drawn.truth[found.joint]
    values = {VISCOUS: truth.viscous, COULOMB: truth.coulomb, DELAY: truth.delay}
    # Positions advance by the velocity at the end of a physics step: half of one ahead of time.
    values[DELAY] -= drawn.experiment.world.physics_period / 2.0
    rotor, moved = truth.rotor, _moved_inertia(drawn, found.joint)
    values[INERTIA] = moved if is_alone else rotor
    for name, true in values.items():
        estimate = found.estimates.get(name)
        if estimate is None:
            yield Finding(found.joint, name, np.nan, False, False)
            continue
        # What matters of a rotor is its part in what the motor moves.
        size = {DELAY: PERIOD, INERTIA: moved}.get(name, true)
        error = (estimate.value - true) / size
        is_inside = estimate.low <= true <= estimate.high
        yield Finding(found.joint, name, error, is_inside, estimate.is_reliable)


def _moved_inertia(drawn: Drawn, joint: str) -> float:
    """Return what the motor moves while the other joints are held, in [kg m^2]."""
    start = drawn.experiment.world.initial_positions
    return float(_dynamics(drawn).mass_matrix([joint], start)[0, 0])


def _dynamics(drawn: Drawn) -> Dynamics:
    return Dynamics(RobotDescription.load(drawn.experiment.world.robot_description))


if __name__ == "__main__":
    sys.exit(main())
