"""Whether predictions of ``hpid upgrade BAG`` come true: ``python -m benchmarks.upgrades``.

Draws robots from those of the example experiments: masses and inertias of every link, rotors,
friction, delay, encoder noise, the gains of a PID placed by a bandwidth that is drawn, too, a
motion through random places, smooth or in steps, and the goal. Records a run under the PID in
process, upgrades that bag and a URDF without rotors and friction, records what was
proposed on the drawn robot with other noise, and prints what was predicted beside what was
measured, in Markdown. ``strange`` instead of a robot draws from :mod:`benchmarks.strange_plants`,
of which the package's simulators know nothing.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
import yaml

from benchmarks import strange_plants
from hpid_bench.experiment.description import Experiment, load_experiment
from hpid_bench.experiment.in_process import NoProgress, controllers_text, run_without_ros
from hpid_bench.tuning.upgrade import GOALS
from hpid_bench.tuning.upgrade_from_bag import BagUpgrade, UpgradeRequest, upgrade_from_bag
from hpid_bench.tuning.upgrade_prediction import (
    HOLDS_WITHIN,
    Prediction,
    PredictionVerification,
    verify_prediction,
)
from hpid_ros.base.errors import HpidError
from hpid_ros.base.resources import find_resource
from hpid_ros.control import JointLoop, LoopSettings
from hpid_ros.messages.columns import JOINT_STATE, JOINT_TRAJECTORY
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.messages.joint_trajectory import encode_joint_trajectory
from hpid_ros.messages.metadata import CONTROLLERS_ENTRY
from hpid_ros.messages.writer import BagWriter, TopicQos
from hpid_ros.metrics.quantities import ITAE, IVC
from hpid_ros.motion.generators import minimum_jerk, step
from hpid_ros.robot.amendments import JointAmendment, amended
from hpid_ros.robot.description import GivenRobot, RobotDescription
from hpid_ros.robot.dynamics import Dynamics

ROBOTS = ("paper", "iiwa", "panda") if find_spec("pybullet_data") else ("paper",)
STRANGE = "strange"
_MASSES = (0.7, 1.4)  # times as the robot's
_ROTORS = (0.7, 1.4)
_BANDWIDTHS = (7.0, 14.0)  # [rad/s], of the triple pole that gains are placed by
_MISPLACED = (0.85, 1.15)  # times the gains that were placed: nobody knows the inertia exactly
_NOISES = (1e-6, 1.5e-4)  # [rad], even in the logarithm
_BITS = (16, 20)  # of the encoders
_DELAYS = 3  # control periods: 0 to 2
_MOTIONS = ("minimum_jerk", "step")
_STOPS, _LEG = 6, 2.0  # places to go to, [s] from one to the next
_REACH = {"minimum_jerk": 0.6, "step": 0.15}  # [rad], from where it stands, within its limits
_HEADINGS = (
    "robot",
    "seed",
    "motion",
    "goal",
    "laws",
    "IVC predicted",
    "measured",
    "off",
    "ITAE predicted",
    "measured",
    "off",
    "model: IVC",
    "ITAE",
    "held",
)


class Drawn(NamedTuple):
    """A robot drawn at random, and what its owner knows."""

    controllers: tuple[LoopSettings, ...]  # its PIDs
    # has it move under controllers and writes a bag, with a seed of its noise
    record: Callable[[Sequence[LoopSettings], Path, int], None]
    given: GivenRobot  # what its owner knows
    motion: str  # what it does
    goal: str  # what its owner wants


class Travelled(NamedTuple):
    """The upgrade of one robot."""

    motion: str  # its kind
    found: BagUpgrade  # what was proposed
    prediction: Prediction  # what it was to bring
    verification: PredictionVerification  # what it brought


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.upgrades", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument(
        "robots", nargs="*", default=ROBOTS, metavar="ROBOT", help="(all but strange)"
    )
    parser.add_argument("--seeds", type=int, default=10, help="robots to draw in all (10)")
    parser.add_argument("--first", type=int, default=1, help="the first seed (1)")
    parser.add_argument("--goal", choices=tuple(GOALS), help="of all (drawn)")
    parser.add_argument("--engine", default="mujoco", help="of the drawn robots (mujoco)")
    parser.add_argument(
        "--wrong-links",
        type=float,
        default=0.0,
        metavar="SHARE",
        help="by which the masses in the owner's URDF are wrong, at most (0)",
    )
    options = parser.parse_args(arguments)
    print(f"| {' | '.join(_HEADINGS)} |")
    print("|---" * len(_HEADINGS) + "|")
    held = kept = refused = 0
    intervals = {index: [0, 0] for index in (IVC, ITAE)}
    for seed in range(options.first, options.first + options.seeds):
        robot = options.robots[seed % len(options.robots)]
        drawn = draw(robot, seed, options.engine, options.wrong_links)
        try:
            travelled = travel(drawn, seed, options.goal)
        except HpidError as error:
            print(f"| {robot} | {seed} | {drawn.motion} | {error} |", flush=True)
            continue
        if not travelled.prediction.is_credible:
            refused += 1
        elif not travelled.found.is_kept:
            for index, counts in intervals.items():
                known = travelled.prediction.total(index.key)
                measured = travelled.verification.totals[index.key].measured
                counts[known.low <= measured <= known.high] += 1
        held += travelled.verification.is_held
        kept += travelled.found.is_kept
        print(_row(robot, seed, travelled), flush=True)
    print(f"\n{held} of {options.seeds} within {HOLDS_WITHIN:.0%}; {kept} kept their PID")
    for index, (off, inside) in intervals.items():
        print(f"{index.symbol}: {inside} of {off + inside} intervals of proposals hold")
    print(f"{refused} far from what was recorded: nothing is proposed")
    return 0


def _row(robot: str, seed: int, travelled: Travelled) -> str:
    found, prediction, verification = travelled[1:]
    homogeneous = sum(each.is_homogeneous for each in found.tried.settings)
    cells = [
        robot,
        str(seed),
        travelled.motion,
        found.goal,
        f"{homogeneous} of {len(found.tried.settings)}",
    ]
    for index in (IVC, ITAE):
        held = verification.totals[index.key]
        known = prediction.total(index.key)
        predicted = f"{held.predicted:.3f} ({known.low:.2f} to {known.high:.2f})"
        cells += [predicted, f"{held.measured:.3f}", f"{held.off:+.1%}"]
    cells += [f"{prediction.total(index.key).fidelity:.3f}" for index in (IVC, ITAE)]
    return f"| {' | '.join((*cells, 'yes' if verification.is_held else 'NO'))} |"


def travel(drawn: Drawn, seed: int, goal: str | None = None) -> Travelled:
    """Record a robot, upgrade it, and record what was proposed."""
    with tempfile.TemporaryDirectory() as folder:
        before, after = Path(folder) / "before", Path(folder) / "after"
        drawn.record(drawn.controllers, before, seed)
        goal = goal or drawn.goal
        request = UpgradeRequest(before, drawn.given, "drawn.urdf", goal)
        found = upgrade_from_bag(request)
        if found.is_kept and goal == "balanced":
            found = upgrade_from_bag(replace(request, goal="smooth"))
        prediction = found.prediction
        new = {each.joint: each for each in found.tried.settings}
        proposed = [new.get(each.joint, each) for each in drawn.controllers]
        drawn.record(proposed, after, seed + 1_000_000)
        return Travelled(
            drawn.motion, found, prediction, verify_prediction(prediction, before, after)
        )


def draw(robot: str, seed: int, engine: str = "mujoco", wrong_links: float = 0.0) -> Drawn:
    """Return a robot with all drawn at random that a recording has to tell."""
    if robot == STRANGE:
        return _draw_strange(seed)
    chance = np.random.default_rng([seed, *robot.encode()])
    plain = load_experiment(find_resource(f"config/experiments/{robot}.yaml"))
    source = RobotDescription.load(plain.world.robot_description)
    arm = [name for name in plain.world.joints if "wheel" not in name]
    heavy = _with_other_masses(source, _MASSES, chance)
    truth = {name: _amendment(heavy, name, chance) for name in arm}
    drawn = amended(heavy, truth, {}, {})
    nothing = {name: JointAmendment(rotor_inertia=0.0, damping=0.0, friction=0.0) for name in arm}
    motion = str(chance.choice(_MOTIONS))
    document = {
        "extends": str(plain.path),
        "seed": seed,
        "duration": _STOPS * _LEG,
        "robot": {"fixed_base": True, **({"base": None} if plain.world.base else {})},
        "simulation": {"engine": engine},
        "sensors": {
            "noise": float(np.exp(chance.uniform(*np.log(_NOISES)))),
            "encoder_counts": 2 ** int(chance.integers(*_BITS, endpoint=True)),
        },
        "actuators": {"delay": int(chance.integers(0, _DELAYS))},
        "reference": _reference(plain, drawn, motion, chance),
        "controllers": {"joints": _gains(drawn, arm, plain.world.initial_positions, chance)},
        "compare": {"PID": {"law": "pid"}},
    }
    goal = str(chance.choice(tuple(GOALS)))
    known = _with_other_masses(heavy, (1.0 - wrong_links, 1.0 + wrong_links), chance)
    bare = amended(known, nothing, {}, {})
    experiment = _loaded(document, drawn)

    def record(controllers: Sequence[LoopSettings], bag: Path, noise: int) -> None:
        world = replace(experiment.world, seed=noise)
        run = replace(experiment, world=world, controllers={"run": tuple(controllers)})
        run_without_ros(run, "run", bag, NoProgress())

    given = GivenRobot(bare.xml, bare, True, experiment.world.initial_positions)
    return Drawn(experiment.controllers["PID"], record, given, motion, goal)


def _draw_strange(seed: int) -> Drawn:
    chance = np.random.default_rng([seed, *STRANGE.encode()])
    plant = strange_plants.drawn(seed)
    motion = str(chance.choice(_MOTIONS))
    places = chance.uniform(-_REACH[motion], _REACH[motion], _STOPS)
    start = float(chance.uniform(-1.0, 1.0))
    times, positions = [_LEG * k for k in range(_STOPS + 1)], [start, *(start + places)]
    make = minimum_jerk if motion == "minimum_jerk" else step
    trajectory = make(times, {"arm": positions})
    bandwidth = float(chance.uniform(*_BANDWIDTHS))
    inertia = plant.inertia * float(chance.uniform(*_MISPLACED))
    limit = float(np.ceil(3.0 * plant.mass * strange_plants.GRAVITY * plant.length))
    values = {"joint": "arm", "law": "pid", "u_clamp_max": limit, "u_clamp_min": -limit}
    gains = zip("pid", (3.0 * bandwidth**2, bandwidth**3, 3.0 * bandwidth), strict=True)
    controller = LoopSettings.from_parameters(
        values | {f"gains.{name}": gain * inertia for name, gain in gains}
    )
    period = controller.timing.control_period
    template = JointStateTemplate(["arm"], position=True, velocity=bool(plant.velocity))
    command = JointStateTemplate(["arm"], effort=True)

    def record(controllers: Sequence[LoopSettings], bag: Path, noise: int) -> None:
        loop, moving = (
            JointLoop(controllers[0]),
            strange_plants.Motion(plant, period, start, noise),
        )
        begin, step_ns = round(plant.hold_time * 1e9), round(period * 1e9)
        for stamp in range(0, begin, step_ns):  # it holds where it is
            moving.step(loop.step(stamp, *moving.read()))
        loop.follow(trajectory.column("arm"))
        with BagWriter(bag, metadata={CONTROLLERS_ENTRY: controllers_text(controllers)}) as writer:
            latched = TopicQos(transient_local=True, depth=1)
            reference = writer.add_topic("/joint_trajectory", JOINT_TRAJECTORY, latched)
            commands = writer.add_topic("/joint_commands", JOINT_STATE)
            states = writer.add_topic("/joint_states", JOINT_STATE)
            writer.write(reference, 1, encode_joint_trajectory(trajectory))
            for stamp in range(begin, begin + round(_STOPS * _LEG * 1e9), step_ns):
                at, velocity = moving.read()
                effort = loop.step(stamp, at, velocity)
                known = {} if velocity is None else {"velocity": (velocity,)}
                late = stamp + plant.late_stamps * step_ns
                writer.write(states, stamp + 1, template.encode(stamp, position=(at,), **known))
                writer.write(commands, stamp + 1, command.encode(late, effort=(effort,)))
                moving.step(effort)

    urdf = plant.urdf(limit)
    given = GivenRobot(urdf, RobotDescription.load(urdf), True, {"arm": start})
    goal = str(chance.choice(tuple(GOALS)))
    return Drawn((controller,), record, given, f"{motion}, {plant.kind}", goal)


def _with_other_masses(
    source: RobotDescription, factors: tuple[float, float], chance: np.random.Generator
) -> RobotDescription:
    """Return a robot each of whose links is heavier or lighter, as if of another density."""
    robot = ElementTree.fromstring(source.xml)
    for link in robot.iter("inertial"):
        factor = float(chance.uniform(*factors))
        for element in (*link.findall("mass"), *link.findall("inertia")):
            for name, value in element.attrib.items():
                element.set(name, repr(factor * float(value)))
    return amended(
        RobotDescription.load(ElementTree.tostring(robot, encoding="unicode")), {}, {}, {}
    )


def _amendment(
    description: RobotDescription, name: str, chance: np.random.Generator
) -> JointAmendment:
    joint = description.joints[name]
    coulomb = joint.effort * float(chance.uniform(0.005, 0.02))
    return JointAmendment(
        rotor_inertia=joint.reflected_inertia
        / joint.gear_ratio**2
        * float(chance.uniform(*_ROTORS)),
        damping=coulomb * float(chance.uniform(0.5, 1.5)),
        friction=coulomb,
    )


def _reference(
    plain: Experiment, description: RobotDescription, motion: str, chance: np.random.Generator
) -> dict[str, Any]:
    """Return a motion of all joints but wheels, from place to place."""
    positions = {}
    for name in plain.world.joints:
        start = float(plain.world.initial_positions.get(name, 0.0))
        reach = 0.0 if "wheel" in name else _REACH[motion]
        joint = description.joints[name]
        low, high = max(start - reach, joint.lower), min(start + reach, joint.upper)
        places = [float(x) for x in chance.uniform(low, high, _STOPS)]
        positions[name] = [start, *places] if reach else [start] * (_STOPS + 1)
    times = [_LEG * k for k in range(_STOPS + 1)]
    new = {"kind": motion, "times": times, "positions": positions}
    return dict.fromkeys(yaml.safe_load(plain.text)["reference"]) | new


def _gains(
    description: RobotDescription,
    joints: Sequence[str],
    start: Mapping[str, float],
    chance: np.random.Generator,
) -> dict[str, Any]:
    """Return gains by a triple pole, a little misplaced."""
    inertias = Dynamics(description).joint_inertias(joints, start)
    found = {}
    for name in joints:
        bandwidth = float(chance.uniform(*_BANDWIDTHS))
        inertia = inertias[name] * float(chance.uniform(*_MISPLACED))
        gains = {
            "p": 3.0 * bandwidth**2 * inertia,
            "i": bandwidth**3 * inertia,
            "d": 3.0 * bandwidth * inertia,
        }
        found[name] = {"gains": gains, "inertia": inertia}
    return found


def _loaded(document: Mapping[str, Any], description: RobotDescription) -> Experiment:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "drawn.yaml"
        file.write_text(yaml.safe_dump(document, sort_keys=False))
        experiment = load_experiment(file)
    world = replace(experiment.world, robot_description=description.xml)
    return replace(experiment, world=world, description=description)


if __name__ == "__main__":
    sys.exit(main())
