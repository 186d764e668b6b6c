"""From a recording under a PID, and the robot, to a proposal that is simulated.

The stages, each of which returns a complete record: :class:`.PidRecording` (what was read),
:class:`IdentifiedRobot`, :class:`.SimulatedPid`, :class:`TriedGoal`, :class:`BagUpgrade`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from hpid_bench.tuning.identification.regression import Estimate
from hpid_bench.tuning.identification.robot_identification import (
    RobotIdentification,
    as_recorded,
    base_travel,
    identify_robot,
    visited_poses,
)
from hpid_bench.tuning.loop_simulation import DriveFacts
from hpid_bench.tuning.pid_recording import PidRecording, read_pid_recording
from hpid_bench.tuning.recorded_pid import recorded_answers
from hpid_bench.tuning.robot_model import RobotModel, robot_model
from hpid_bench.tuning.simulated_pid import (
    SIMULATED_RUN,
    SimulatedPid,
    delay_estimates,
    simulated,
    simulated_pid,
    with_shorter_delay,
)
from hpid_bench.tuning.upgrade import (
    GOALS,
    Certifying,
    Proposals,
    Upgrade,
    effort_limits,
    propose,
    worthwhile,
)
from hpid_bench.tuning.upgrade_prediction import JUDGED, Expected, Prediction, over
from hpid_ros.base.errors import HpidError, RobotDescriptionError, SettingError, unknown_name
from hpid_ros.control.settings import LoopSettings
from hpid_ros.messages.messages import read_velocities
from hpid_ros.messages.series import JointSeries, RunSeries
from hpid_ros.metrics.comparison import Comparison
from hpid_ros.metrics.quantities import INDICES, IVC
from hpid_ros.metrics.run_numbers import run_indices
from hpid_ros.robot.description import GivenRobot
from hpid_ros.robot.dynamics import inertia_ranges
from hpid_ros.stability.gain_check import judged_inertia
from hpid_ros.stability.margins import Case, FamilyMargins, Margins, loop_family, margins_of

DEFAULT_GOAL = "balanced"
"""The one that lowers both: what nobody has to choose."""

PREDICTED_RUN = "proposed"
"""Label of the run under what is proposed."""


@dataclass(frozen=True)
class UpgradeRequest:
    """What is to be upgraded."""

    bag: Path  # recorded under the PID
    robot: GivenRobot  # its own rotors and friction do not count
    robot_name: str  # what the robot was named by
    goal: str | None = None  # of GOALS; None for the default one, or else to see what others bring
    parameters: Path | None = None  # file of the controllers' parameters, where the bag has none
    payload: float = 0.0  # [kg] largest that inertias are certified for


@dataclass(frozen=True)
class IdentifiedRobot:
    """What a recording told of the robot."""

    model: RobotModel  # the robot with what was identified
    inertias: Mapping[str, tuple[float, float]]  # [kg m^2] least and largest, by joint
    limits: Mapping[str, float]  # [N m] of the motors, by joint


@dataclass(frozen=True)
class TriedGoal:
    """What is proposed for a goal, and its simulation."""

    goal: str  # of GOALS
    proposals: Proposals  # the PID where nothing is gained
    settings: Sequence[LoopSettings]  # of all controllers, with what is proposed
    run: RunSeries  # simulated under them
    doubts: Mapping[str, float]  # half of the interval of the logarithm of a ratio, by joint

    @property
    def is_kept(self) -> bool:
        """Whether every joint keeps its PID."""
        return not _changed(self.proposals.found)


@dataclass(frozen=True)
class BagUpgrade:
    """What a recording under a PID led to: the robot, a proposal, and its simulation."""

    request: UpgradeRequest
    recording: PidRecording
    identification: RobotIdentification
    pid: SimulatedPid
    margins: Mapping[str, Margins | str]  # the worst ones of each PID, or why there are none
    tried: TriedGoal
    # of goals that were not asked for, by index: what they would bring, over the PID's
    other_goals: Mapping[str, Mapping[str, float]]

    @property
    def goal(self) -> str:
        return self.tried.goal

    @property
    def is_kept(self) -> bool:
        return self.tried.is_kept

    @property
    def runs(self) -> tuple[RunSeries, RunSeries, RunSeries]:
        """The recording, its simulation, and the proposal's."""
        return self.recording.controlled, self.pid.run, self.tried.run

    @cached_property
    def comparison(self) -> Comparison:
        return Comparison(tuple(map(run_indices, self.runs)))

    @cached_property
    def prediction(self) -> Prediction:
        """What is expected of each joint."""
        joints: dict[str, dict[str, Expected]] = {}
        for name in self.recording.joints:
            doubt, known = self.tried.doubts[name], dict[str, Expected]()
            for index in INDICES:
                before, model, after = (run.value(index, name) for run in self.comparison.runs)
                known[index.key] = Expected(before, over(after, model), over(model, before), doubt)
            joints[name] = known
        parameters = {each.joint: dict(each.to_parameters()) for each in self.tried.settings}
        slides = self.pid.model.robot.description.slides
        named = tuple(name for name in joints if name in slides)
        return Prediction(self.request.bag.name, self.goal, joints, parameters, named)


def upgrade_from_bag(
    request: UpgradeRequest,
    phase: Callable[[str], None] = lambda name: None,
    certifying: Certifying = lambda count: nullcontext(lambda joints: None),
) -> BagUpgrade:
    """Identify the robot, check the PID, propose another law and simulate what it brings.

    ``phase`` is called with the name of what begins.
    """
    goal = DEFAULT_GOAL if request.goal is None else request.goal
    phase("reading the recording")
    base = base_travel(request.bag)
    if goal not in GOALS:
        raise SettingError(unknown_name("goal", goal, GOALS))
    recording = read_pid_recording(request.bag, request.robot, request.parameters, base)
    robot = as_recorded(request.robot, recording.run.joints)
    phase("identifying the joints")
    identification = identify_robot(
        recording.run,
        robot,
        robot_name=request.robot_name,
        bag_name=str(request.bag),
        base=base,
    )
    known = _identified(request, robot, recording, identification)

    def certified(goal: str) -> Proposals:
        phase(f"certifying degrees for the goal {goal}")
        recorded = recording.run.joints
        return propose(recording.loops, known.inertias, recorded, known.limits, goal, certifying)

    proposals = certified(goal)
    phase("simulating the identified robot")
    pid = simulated_pid(recording, identification.joints, known.model)
    delays = delay_estimates(identification.joints)
    tried = _tried(goal, proposals, recording, pid, delays)
    others: dict[str, Mapping[str, float]] = {}
    if request.goal is None and tried.is_kept:
        for other in GOALS:
            if other == goal:
                continue
            proposals = certified(other)
            phase("simulating the identified robot")
            attempt = _tried(other, proposals, recording, pid, delays)
            if not attempt.is_kept:
                both = Comparison((run_indices(pid.run), run_indices(attempt.run)))
                others[other] = {each.key: both.ratio(PREDICTED_RUN, each) for each in INDICES}
    margins = {
        each.joint: pid_margins(
            each,
            known.inertias[each.joint],
            pid.model,
            recording.period,
            recording.has_velocities,
        )
        for each in recording.loops
    }
    return BagUpgrade(request, recording, identification, pid, margins, tried, others)


def _identified(
    request: UpgradeRequest,
    robot: GivenRobot,
    recording: PidRecording,
    identification: RobotIdentification,
) -> IdentifiedRobot:
    """Return the robot's model, with the velocities that it reports and how it was answered."""
    measured = [each.joint for each in recording.loops if each.velocity.is_measured]
    velocities = (
        read_velocities(request.bag, measured) if recording.has_velocities and measured else {}
    )
    answers = {
        each.joint: recorded_answers(
            each, recording.series[each.joint], velocities.get(each.joint, {})
        )
        for each in recording.loops
    }
    model = robot_model(robot, identification.joints, recording.run.joints, velocities, answers)
    inertias = _inertias(model, request.payload, recording.loops, recording.run.joints)
    limits = effort_limits(robot.description)  # what a recording shows may be a load's
    return IdentifiedRobot(model, inertias, limits)


def _inertias(
    model: RobotModel,
    payload: float,
    loops: Sequence[LoopSettings],
    recorded: Sequence[JointSeries],
) -> dict[str, tuple[float, float]]:
    poses = [{**model.robot.initial_positions, **pose} for pose in visited_poses(recorded)]
    joints = [each.joint for each in loops]
    try:
        return inertia_ranges(model.robot.description, joints, payload, poses)
    except np.linalg.LinAlgError:
        raise RobotDescriptionError(
            "the robot has a joint that moves no mass, and no rotor was found: give its links "
            "masses, or hold it"
        ) from None


def pid_margins(
    settings: LoopSettings,
    inertia: tuple[float, float],
    model: RobotModel,
    period: float,
    has_velocities: bool,
) -> Margins | str:
    """Return the worst margins of a PID on the joint as it was identified, or why it has none."""
    joint = settings.joint
    damping = model.robot.description.joints[joint].damping
    facts = model.facts.get(joint, DriveFacts())
    delay, lag = facts.delay, facts.velocity.lag * period
    try:
        settings = settings.with_parameters({"control_period": period})
        if settings.velocity.is_measured and not has_velocities:
            settings = settings.with_parameters({"velocity_source": "filtered"})
        elif settings.velocity.is_measured and lag > 0.0:  # as the driver filters it
            known = {"velocity_source": "filtered", "velocity_filter_time_constant": lag}
            settings = settings.with_parameters(known)
        family = loop_family(settings, judged_inertia(settings, inertia), damping, delay * period)
        ends = [Case(each, 1.0, margins_of(family.loop(each))) for each in family.inertia]
    except HpidError as error:
        return str(error)
    return FamilyMargins(tuple(ends)).worst or "unstable"


def _tried(
    goal: str,
    certified: Proposals,
    recording: PidRecording,
    pid: SimulatedPid,
    delays: Mapping[str, Estimate],
) -> TriedGoal:
    """Simulate what is proposed for a goal; keep the PID of joints that gain nothing."""
    loops = recording.loops
    proposed = _with_upgrades(loops, certified.found)
    run = simulated(PREDICTED_RUN, proposed, recording, pid.model)
    both = Comparison((run_indices(pid.run), run_indices(run)))
    spread = _delay_spread(proposed, both, recording, pid, delays)
    widened = {name: each + spread.get(name, 0.0) for name, each in pid.doubts.items()}
    if goal == "balanced":  # it judges all joints together
        widened = dict.fromkeys(widened, _doubt_of_all(recording, widened))
    found = {
        name: worthwhile(each, goal, both, widened[name]) for name, each in certified.found.items()
    }
    changed = _changed(found)
    settings = _with_upgrades(loops, found)
    if not changed:
        run = replace(pid.run, label=PREDICTED_RUN)
    elif len(changed) < len(found):
        run = simulated(PREDICTED_RUN, settings, recording, pid.model)
    doubts = {
        name: each + (spread.get(name, 0.0) if name in changed else 0.0)
        for name, each in pid.doubts.items()
    }
    return TriedGoal(goal, Proposals(found, certified.failures), settings, run, doubts)


def _delay_spread(
    proposed: Sequence[LoopSettings],
    both: Comparison,
    recording: PidRecording,
    pid: SimulatedPid,
    delays: Mapping[str, Estimate],
) -> dict[str, float]:
    """Return how far ratios move, by joint, with a delay at the near end of its interval."""
    shorter: dict[str, DriveFacts] = {}
    for name in recording.joints:
        facts = with_shorter_delay(
            pid.model.facts.get(name), delays.get(name), recording.period, 1.0
        )
        if facts is not None:
            shorter[name] = facts
    if not shorter:
        return {}
    model = pid.model.with_facts(shorter)
    before = simulated(SIMULATED_RUN, recording.loops, recording, model)
    after = simulated(PREDICTED_RUN, proposed, recording, model)
    with_shorter = Comparison((run_indices(before), run_indices(after)))
    found: dict[str, float] = {}
    for name in shorter:
        moved = []
        for index in JUDGED:
            one, other = (each.ratio(PREDICTED_RUN, index, name) for each in (both, with_shorter))
            if one * other > 0.0:
                moved.append(abs(math.log(other / one)))
        found[name] = max((each for each in moved if math.isfinite(each)), default=0.0)
    return found


def _doubt_of_all(recording: PidRecording, doubts: Mapping[str, float]) -> float:
    """Return the doubt of all joints together, each weighted with how its effort varies."""
    target = run_indices(recording.controlled)
    sizes = {name: target.value(IVC, name) for name in doubts}
    whole = math.fsum(sizes.values())
    return math.fsum(sizes[x] * doubts[x] for x in sizes if sizes[x]) / (whole or 1.0)


def _with_upgrades(
    loops: Sequence[LoopSettings], found: Mapping[str, Upgrade]
) -> list[LoopSettings]:
    return [found[each.joint].settings if each.joint in found else each for each in loops]


def _changed(found: Mapping[str, Upgrade]) -> list[str]:
    """Return the joints that do not keep their PID."""
    return [name for name, each in found.items() if each.settings.is_homogeneous]
