"""From a recording under a PID, and the robot, to a proposal that is simulated."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from hpid_bench.tuning.driver_velocity import DriverVelocity, driver_velocity
from hpid_bench.tuning.identify import JointIdentification
from hpid_bench.tuning.recorded_loops import recorded_controllers
from hpid_bench.tuning.recorded_pid import RecordedAnswers, recorded_answers
from hpid_bench.tuning.regression import (
    COULOMB,
    DELAY,
    INERTIA,
    OFFSET,
    STRIBECK,
    VISCOUS,
    Estimate,
)
from hpid_bench.tuning.robot_identification import (
    BaseMotion,
    RobotIdentification,
    as_recorded,
    base_motion,
    identify_robot,
    is_wheel,
    remark_on_base,
    visited_poses,
    why_not_wheel,
)
from hpid_bench.tuning.upgrade import (
    GOALS,
    Certifying,
    Proposals,
    Upgrade,
    effort_limits,
    median_period,
    position_resolution,
    propose,
    worthwhile,
)
from hpid_bench.tuning.upgrade_prediction import (
    JUDGED,
    PHYSICS_STEPS,
    Expected,
    JointFacts,
    Prediction,
    over,
    simulate,
)
from hpid_ros.base.errors import HpidError, RobotDescriptionError, SettingError, unknown_name
from hpid_ros.base.processes import raise_if_interrupted
from hpid_ros.control.settings import LoopSettings
from hpid_ros.messages.messages import measures_velocity, read_retunes, read_velocities
from hpid_ros.messages.quality import NO_EFFORT
from hpid_ros.messages.run import read_run
from hpid_ros.messages.selection import BagSelection
from hpid_ros.messages.series import JointSeries, RunSeries
from hpid_ros.metrics.comparison import Comparison
from hpid_ros.metrics.quantities import INDICES, IVC, Quantity
from hpid_ros.metrics.results import RunIndices
from hpid_ros.metrics.run_numbers import run_indices
from hpid_ros.robot.amendments import JointAmendment, amended
from hpid_ros.robot.description import GivenRobot
from hpid_ros.robot.dynamics import inertia_ranges
from hpid_ros.simulation.drives import LONGEST_DELAY
from hpid_ros.stability.gain_check import inertia_of
from hpid_ros.stability.margins import Case, FamilyMargins, Margins, loop_family, margins_of

_WINDOW = 200  # samples
_THIRD_DIFFERENCE = 20.0  # of white noise, over the variance of the noise itself: 1 + 9 + 9 + 1
_BELOW_A_COUNT = 0.2  # of a count: less noise than that cannot be told from rounding
_ROUNDED = math.sqrt(12.0)  # a step over the standard deviation of what rounding to it adds
_AS_DIFFERENCES = (
    "how the velocity that is reported comes about cannot be told: it is simulated as the "
    "differences of the positions"
)
_MUCH = 0.05  # of the largest effort: a constant load that is worth a word


@dataclass(frozen=True)
class RobotModel:
    """A robot with what was identified of it."""

    robot: GivenRobot  # with the rotors and the friction that were found
    facts: Mapping[str, JointFacts]  # delays and noise, by joint
    assumptions: Mapping[str, Sequence[str]]  # what had to be assumed, by joint, a line each


def robot_model(
    robot: GivenRobot,
    found: Sequence[JointIdentification],
    recorded: Sequence[JointSeries],
    velocities: Mapping[str, Mapping[int, float]] = MappingProxyType({}),
    answers: Mapping[str, RecordedAnswers] = MappingProxyType({}),
) -> RobotModel:
    """Return a robot with what was found of its joints, and of their controllers.

    ``velocities`` [rad/s] are those that are reported, by joint and stamp.

    Unreliable estimates are taken, too, where they can be true at all: together
    with the others they explain the recording, whichever share each of them has.
    """
    series = {each.joint: each for each in recorded}
    amendments = {
        each.joint: _amendment(each, robot.description.joints[each.joint].effort)
        for each in found
        if each.is_found
    }
    facts, assumptions = {}, dict[str, tuple[str, ...]]()
    for each in found:
        own = series[each.joint]
        resolution = position_resolution(own)
        noise = position_noise(own, resolution)
        integral, late = answers.get(each.joint, RecordedAnswers())
        delay = _delay(each, median_period(own), late)
        facts[each.joint] = JointFacts(delay, noise, resolution, integral=integral)
        assumptions[each.joint] = tuple(_assumptions(each, own, late))
        if known := velocities.get(each.joint):
            report = reported_velocity(own, known, math.hypot(noise, resolution / _ROUNDED))
            if report is not None:
                facts[each.joint] = facts[each.joint]._replace(velocity=report.filter)
                assumptions[each.joint] += (f"the velocity that is reported: {report.words}",)
            else:
                assumptions[each.joint] += (_AS_DIFFERENCES,)
    description = amended(robot.description, amendments, {}, {})
    return RobotModel(
        replace(robot, source=description.xml, description=description),
        facts,
        assumptions,
    )


def reported_velocity(
    series: JointSeries, velocities: Mapping[int, float], noise: float
) -> DriverVelocity | None:
    """Return how a driver makes the velocities of a joint; None where nothing can be said."""
    stamps = series.state_stamps_ns.tolist()
    has_one = np.array([stamp in velocities for stamp in stamps])
    told = np.array([velocities[stamp] for stamp in stamps if stamp in velocities])
    return driver_velocity(series.time[has_one], series.position[has_one], told, noise)


def position_noise(series: JointSeries, resolution: float) -> float:
    """Return the standard deviation of a position's noise before it is rounded, in [rad].

    From third differences, in which smooth motion leaves no trace; the median over windows, so
    that jumps and gaps do not count.
    """
    differences = np.diff(series.position, 3)
    windows = max(1, len(differences) // _WINDOW)
    if len(differences) < 2:
        return 0.0
    each = [float(np.var(window)) for window in np.array_split(differences, windows)]
    whole = float(np.median(each)) / _THIRD_DIFFERENCE
    noise = math.sqrt(max(0.0, whole - resolution**2 / 12.0))
    return 0.0 if noise < _BELOW_A_COUNT * resolution else noise


def _amendment(found: JointIdentification, limit: float) -> JointAmendment:
    rotor = _possible(found.estimates.get(INERTIA))
    return JointAmendment(
        rotor_inertia=rotor,
        gear_ratio=None if rotor is None else 1.0,
        damping=_possible(found.estimates.get(VISCOUS)),
        friction=_possible(found.estimates.get(COULOMB)),
        effort=found.effort_limit if found.effort_limit < limit else None,
    )


def _possible(estimate: Estimate | None) -> float | None:
    """Return a number that is not negative; None where there is none."""
    if estimate is None or not math.isfinite(estimate.value):
        return None
    return max(estimate.value, 0.0)


def _delay(found: JointIdentification, period: float, late: float) -> int:
    """Return the delay from a state to what answers it, in control periods.

    A simulated position is half a physics step ahead of time, by semi-implicit integration.
    """
    estimate = found.estimates.get(DELAY)
    if estimate is None or period <= 0.0:
        return 0
    periods = (estimate.value + late) / period + 0.5 / PHYSICS_STEPS
    return min(max(round(periods), 0), LONGEST_DELAY)


_WORDS = {INERTIA: "rotor", VISCOUS: "viscous friction", COULOMB: "Coulomb friction"}


def _assumptions(found: JointIdentification, series: JointSeries, late: float) -> Iterator[str]:
    if not found.is_found:
        reason = found.unreliable.get(found.joint, "nothing was found")
        yield f"its rotor and friction are those of the robot's description: {reason}"
        return
    for name, words in _WORDS.items():
        estimate = found.estimates.get(name)
        if estimate is None:
            yield f"{words}: as the robot's description says"
        elif not estimate.is_reliable:
            yield f"{words} {max(estimate.value, 0.0):.3g} is a guess: {estimate.reason}"
    if late:
        yield (
            f"its efforts are stamped {late * 1e3:.3g} ms after the states that they answer, "
            "as the PID answers them: what acts is that much later than the delay"
        )
    elif (delay := found.estimates.get(DELAY)) is not None and delay.high < 0.0 and delay.reason:
        yield f"the delay is a guess, none: {delay.reason}"
    offset, largest = found.reliable(OFFSET), float(np.max(np.abs(series.effort), initial=0.0))
    if offset is not None and abs(offset.value) > _MUCH * largest:
        load = f"a constant load of {offset.value:.3g} N m"
        yield f"{load} is not simulated: the integral carries it"
    if found.effort_limit < math.inf:
        yield f"its drive gives at most {found.effort_limit:.3g} N m, whatever is commanded"
    if found.reliable(STRIBECK) is not None:
        yield "friction that grows when creeping (Stribeck) is not simulated"
    yield from found.remarks


RECORDED, SIMULATED, PREDICTED = "recorded", "simulated", "proposed"
"""Labels of the three runs: the recording, the same PID simulated, the proposal simulated."""

DEFAULT_GOAL = "balanced"
"""The one that lowers both: what nobody has to choose."""

_ENGINE = "mujoco"  # its joints have armatures: a rotor is simulated as it was identified

_DOUBT_OF_COURSE = 0.35
"""Of the mean logarithm by which efforts vary more or less than recorded at the same times."""
_HARDLY = 0.01  # of how much an effort varies on average: less is as good as nothing
_DOUBT_OF_SPRING, _DOUBT_OF_CREEP = 0.5, 0.1
"""Of the logarithm of a ratio, where the joint gives or friction grows when creeping."""
_LEAST_DOUBT, _DOUBT_OF_MISFIT = 0.06, 0.55
"""Of the logarithm of a ratio, and of the largest logarithm by which a simulated PID misses an
index: what the strange plants 16 to 47 need (``python -m benchmarks.upgrades strange``)."""
_NEAR = 0.03  # of the variation of an effort: the noise is left as it is
_CLOSE_ENOUGH = 0.1  # of it: a noise that does not bring it as close explains nothing
_NOISE_TRIALS = 6
_WINDOWS, _QUIET = 60, 0.7
_FAR_OFF = math.log(1.1)  # of an index: a run that is no further off is the recorded one
_SHORTER = (0.5, 1.0, 1.5)  # half-widths of a delay's interval; at the end it may be a bit off
_MOST_COUNTS = 0.5  # of noise: more would be seen in the position
_MOST_TIMES = 2.0  # what the position shows


def upgrade_from_bag(
    bag: Path,
    robot: GivenRobot,
    urdf: str,
    goal: str | None = None,
    parameters: Path | None = None,
    payload: float = 0.0,
    phase: Callable[[str], None] = lambda name: None,
    certifying: Certifying = lambda count: nullcontext(lambda joints: None),
) -> BagUpgrade:
    """Identify the robot, check the PID, propose another law and simulate what it brings.

    The robot's own rotors and friction do not count. ``parameters`` is a file of the controllers'
    parameters, where the bag has none; ``payload`` [kg] the largest that inertias are certified
    for. ``phase`` is called with the name of what begins.
    """
    phase("reading the recording")
    base = base_motion(bag)
    recording, loops, warnings = _read(bag, robot, goal, parameters, base)
    robot = as_recorded(robot, recording.joints)
    phase("identifying the joints")
    found = identify_robot(recording, robot, robot_name=urdf, bag_name=str(bag), base=base)
    has_velocities = measures_velocity(bag, loops[0].joint)
    own = [each.joint for each in loops if has_velocities and each.velocity.is_measured]
    velocities = read_velocities(bag, own) if own else {}
    series = {each.joint: each for each in recording.joints}
    answers = {
        each.joint: recorded_answers(each, series[each.joint], velocities.get(each.joint, {}))
        for each in loops
    }
    model = robot_model(robot, found.joints, recording.joints, velocities, answers)
    inertias = _inertias(model, payload, loops, recording.joints)
    limits = effort_limits(robot.description)  # what a recording shows may be a load's
    upgraded = BagUpgrade(
        bag,
        urdf,
        goal or DEFAULT_GOAL,
        recording,
        loops,
        warnings,
        found,
        model,
        inertias,
        limits,
        has_velocities,
        parameters,
        payload,
        phase,
        certifying,
    )
    upgraded.proposals, upgraded.predicted = upgraded.propose(upgraded.goal)
    if goal is None and upgraded.is_kept:
        upgraded.try_other_goals()
    return upgraded


def _read(
    bag: Path,
    robot: GivenRobot,
    goal: str | None,
    parameters: Path | None,
    base: BaseMotion | None,
) -> tuple[RunSeries, list[LoopSettings], list[str]]:
    """Return the recording, the controllers that ran, and what to warn of."""
    if goal is not None and goal not in GOALS:
        raise SettingError(unknown_name("goal", goal, GOALS))
    controllers = recorded_controllers(bag, parameters)
    recording = read_run(
        bag,
        RECORDED,
        selection=BagSelection(  # of runs that are no one motion
            separates_runs=True, every=True, kinds=robot.description.kinds
        ),
        progress=lambda share: raise_if_interrupted(),
    ).with_slides(robot.description.slides)
    loops: list[LoopSettings] = []
    left_out: dict[str, list[str]] = {}  # joints by the reason
    driven = {each.joint for each in recording.joints if each.has_effort or each.has_reference}
    for joint, controller in controllers.items():
        if joint not in recording.joint_names or joint not in robot.description.joints:
            who = "the recording" if joint not in recording.joint_names else "the robot"
            left_out.setdefault(f"{who} does not have it", []).append(joint)
        elif is_wheel(joint, robot, base) and (reason := why_not_wheel(base, is_asked_for=True)):
            left_out.setdefault(reason, []).append(joint)
        elif joint not in driven:
            left_out.setdefault("the recording has no effort or reference of it", []).append(joint)
        else:
            loops.append(controller.settings)
    warnings = [f"left out: {', '.join(each)}: {reason}" for reason, each in left_out.items()]
    if not loops:
        raise SettingError(f"{bag}: no controller can be upgraded: {'; '.join(warnings)}")
    others = [f"{each.joint} (mu {each.mu:+g})" for each in loops if each.degree != 0.0]
    if others:
        raise SettingError(
            f"{bag} was not recorded under a PID, but under the homogeneous law: "
            f"{', '.join(others)}; record one with law pid or mu 0, which is the baseline"
        )
    without = {each.joint for each in recording.joints if not each.has_reference}
    missing = [each.joint for each in loops if each.joint in without]
    if missing:
        raise SettingError(
            f"{bag} has no reference of {', '.join(missing)}: record joint_trajectory, "
            "as bag_recorder does"
        )
    without = {each.joint for each in recording.joints if not each.has_effort}
    missing = [each.joint for each in loops if each.joint in without]
    if missing:
        why = recording.quality.joints[missing[0]].no_effort or NO_EFFORT
        raise SettingError(
            f"{bag} has no efforts of {', '.join(missing)} ({why}): record joint_commands, or "
            "efforts that are measured"
        )
    retunes = read_retunes(bag)
    if retunes:
        first = retunes[0]
        warnings.append(
            f"parameters were changed while it was recorded, first {first.node}: {first.change}; "
            "the controllers are taken as they began"
        )
    if base is not None and base.is_moving:
        warnings.append(remark_on_base(base))
    warnings.extend(recording.quality.missing_lines)
    return recording, loops, warnings


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
    facts = model.facts.get(joint, JointFacts())
    delay, lag = facts.delay, facts.velocity.lag * period
    try:
        settings = settings.with_parameters({"control_period": period})
        if settings.velocity.is_measured and not has_velocities:
            settings = settings.with_parameters({"velocity_source": "filtered"})
        elif settings.velocity.is_measured and lag > 0.0:  # as the driver filters it
            known = {"velocity_source": "filtered", "velocity_filter_time_constant": lag}
            settings = settings.with_parameters(known)
        family = loop_family(settings, inertia_of(settings, inertia), damping, delay * period)
        ends = [Case(each, 1.0, margins_of(family.loop(each))) for each in family.inertia]
    except HpidError as error:
        return str(error)
    return FamilyMargins(tuple(ends)).worst or "unstable"


def _ratio_or_one(value: float, other: float) -> float:
    return value / other if other else 1.0


def _quiet_variation(series: JointSeries) -> float:
    """Return how much an effort varies in a window of time, the liveliest left out, in [N m].

    They are those in which what a model lacks, as a spring, answers a step.
    """
    windows = np.array_split(np.abs(np.diff(series.effort)), _WINDOWS)
    each = np.sort([float(window.sum()) for window in windows])
    return float(each[: round(_QUIET * _WINDOWS)].mean())


def _unlike(one: JointSeries, other: JointSeries) -> float:
    """Return the mean logarithm by which efforts vary more or less at the same times.

    The noise is fitted to how much they vary in all, and may hide that the one rests, or rings,
    where the other does not.
    """
    windows = (
        np.array([part.sum() for part in np.array_split(np.abs(np.diff(each.effort)), _WINDOWS)])
        for each in (one, other)
    )
    each = [window + _HARDLY * float(window.mean()) for window in windows]
    if not all(window.all() for window in each):
        return 0.0
    return float(np.mean(np.abs(np.log(each[0] / each[1]))))


class _NoiseSearch(NamedTuple):
    """The noise of one joint's position that makes its effort vary as recorded, bisected.

    What is less than a fifth of a count is not seen in the position, but it is in the effort:
    close to the edge between two counts it decides how often the position goes to and fro.
    """

    facts: JointFacts  # what is tried next
    low: float  # [rad] noise with too little variation
    high: float  # [rad] noise with too much
    best: JointFacts | None = None  # what came closest, if close enough; None if nothing has
    off: float = _CLOSE_ENOUGH  # by how much, as a share

    @classmethod
    def begun(cls, facts: JointFacts) -> _NoiseSearch:
        largest = max(_MOST_COUNTS * (facts.resolution or 0.0), _MOST_TIMES * facts.noise)
        return cls(facts._replace(noise=largest / 4.0), 0.0, largest)

    def after(self, value: float, target: float) -> _NoiseSearch:
        """Return the next step once a simulation has said how much the effort varies."""
        tried, off = self.facts.noise, abs(value / target - 1.0)
        low, high = (tried, self.high) if value < target else (self.low, tried)
        best, least = (self.facts, off) if off < self.off else (self.best, self.off)
        middle = math.sqrt(low * high) if low > 0.0 else high / 4.0
        return _NoiseSearch(self.facts._replace(noise=middle), low, high, best, least)


@dataclass
class BagUpgrade:
    """What a recording under a PID led to: the robot, a proposal, and its simulation."""

    bag: Path  # recorded under the PID
    urdf: str  # what the robot was named by
    goal: str  # of GOALS: what the proposal is for
    recording: RunSeries  # what was recorded
    loops: Sequence[LoopSettings]  # the controllers as they ran
    warnings: Sequence[str]  # what the numbers must be read with, one line each
    identification: RobotIdentification  # what was identified of the recording
    model: RobotModel  # the robot with that
    inertias: Mapping[str, tuple[float, float]]  # [kg m^2] least and largest, by joint
    limits: Mapping[str, float]  # [N m] of the motors, by joint
    has_velocities: bool  # whether the robot measures them
    parameters: Path | None  # file of the controllers' parameters, if one was given
    payload: float  # [kg] largest that inertias are certified for
    phase: Callable[[str], None]
    certifying: Certifying
    proposals: Proposals = field(init=False)  # the PID where nothing is gained
    predicted: RunSeries = field(init=False)  # the proposal, simulated
    # by how much the logarithm of a joint's ratio depends on a delay that is hardly known
    delay_doubts: Mapping[str, float] = field(init=False, default_factory=dict)
    # of goals that were not asked for, by index: what they would bring, over the PID's
    others: dict[str, dict[str, float]] = field(init=False, default_factory=dict)

    @cached_property
    def margins(self) -> dict[str, Margins | str]:
        """The worst margins of each PID along the recording, or why there are none."""
        known = self.model, median_period(self.recording.joints[0]), self.has_velocities
        return {
            each.joint: pid_margins(each, self.inertias[each.joint], *known) for each in self.loops
        }

    @property
    def runs(self) -> tuple[RunSeries, RunSeries, RunSeries]:
        """The recording, its simulation, and the proposal's."""
        return self._recorded, self.before, self.predicted

    @cached_property
    def comparison(self) -> Comparison:
        return Comparison(tuple(map(run_indices, self.runs)))

    @property
    def settings(self) -> list[LoopSettings]:
        return _after(self.loops, self.proposals.found)

    @property
    def is_kept(self) -> bool:
        return not _changed(self.proposals.found)

    @cached_property
    def prediction(self) -> Prediction:
        """What is expected of each joint."""
        joints: dict[str, dict[str, Expected]] = {each.joint: {} for each in self.loops}
        for name, known in joints.items():
            for index in INDICES:
                before, model, after = (run.value(index, name) for run in self.comparison.runs)
                doubt = self.doubts[name] + self.delay_doubts.get(name, 0.0)
                known[index.key] = Expected(before, over(after, model), over(model, before), doubt)
        slides = self.model.robot.description.slides
        parameters = {each.joint: dict(each.to_parameters()) for each in self.settings}
        named = tuple(name for name in joints if name in slides)
        return Prediction(self.bag.name, self.goal, joints, parameters, named)

    @cached_property
    def _recorded(self) -> RunSeries:
        return self.recording.narrowed([each.joint for each in self.loops])

    @cached_property
    def _target(self) -> RunIndices:
        return run_indices(self._recorded)

    @cached_property
    def doubts(self) -> dict[str, float]:
        """Half of the interval of the logarithm of a ratio, by joint.

        By how far the simulated PID is from the recorded one, also before noise was fitted.
        """
        plain, simulated, found = run_indices(self._plain), run_indices(self.before), {}
        for name in (each.joint for each in self.loops):
            misfit = max(self._misfit(plain, name, (IVC,)), self._misfit(simulated, name, JUDGED))
            found[name] = _LEAST_DOUBT + _DOUBT_OF_MISFIT * misfit + self._lacking.get(name, 0.0)
        recorded = {each.joint: each for each in self.recording.joints}
        for each in self.before.joints:
            found[each.joint] += _DOUBT_OF_COURSE * _unlike(each, recorded[each.joint])
        return found

    @cached_property
    def _lacking(self) -> dict[str, float]:
        """What the simulation lacks of each joint, though it was seen, as a doubt."""
        return {
            each.joint: _DOUBT_OF_SPRING * (not each.is_rigid)
            + _DOUBT_OF_CREEP * (each.reliable(STRIBECK) is not None)
            for each in self.identification.joints
        }

    def _misfit(self, run: RunIndices, name: str, indices: Sequence[Quantity] = JUDGED) -> float:
        """Return the largest logarithm by which a run misses a recorded index of a joint."""
        ratios = [_ratio_or_one(run.value(x, name), self._target.value(x, name)) for x in indices]
        return max(abs(math.log(x)) if 0.0 < x < math.inf else math.inf for x in ratios)

    def _doubt(self, goal: str, joint: str, spread: Mapping[str, float]) -> float:
        """Return the doubt that a gain must exceed: of all joints where they count together."""
        doubts = {name: each + spread.get(name, 0.0) for name, each in self.doubts.items()}
        if goal != "balanced":
            return doubts[joint]
        sizes = {name: self._target.value(IVC, name) for name in self.doubts}
        whole = math.fsum(sizes.values())
        return math.fsum(sizes[x] * doubts[x] for x in sizes if sizes[x]) / (whole or 1.0)

    @cached_property
    def _plain(self) -> RunSeries:
        """The PID, simulated with the noise that the positions show; before noise is fitted.

        A delay is known within an interval. Where the middle of it gives another run than the
        recorded one, as an oscillation that was none, the delay that comes closer is taken.
        """
        plain = self._simulated(SIMULATED, self.loops)
        least = {each.joint: self._misfit(run_indices(plain), each.joint) for each in self.loops}
        shorter = {
            name: [each for each in self._shorter_delays(name) if misfit > _FAR_OFF]
            for name, misfit in least.items()
        }
        best: dict[str, JointFacts] = {}
        for trial in range(max(map(len, shorter.values()))):
            facts = {name: each[trial] for name, each in shorter.items() if trial < len(each)}
            run = run_indices(self._simulated(SIMULATED, self.loops, facts))
            for name, known in facts.items():
                if (misfit := self._misfit(run, name)) < least[name]:
                    least[name], best[name] = misfit, known
        if not best:
            return plain
        self.model = replace(self.model, facts={**self.model.facts, **best})
        return self._simulated(SIMULATED, self.loops)

    def _shorter_delays(self, name: str) -> list[JointFacts]:
        """Return what is known of a joint with each shorter delay that its interval allows."""
        tried = [self._with_shorter_delay(name, share) for share in _SHORTER]
        return list(dict.fromkeys(each for each in tried if each is not None))

    def _with_shorter_delay(self, name: str, share: float) -> JointFacts | None:
        """Return what is known of a joint, its delay shorter by a share of its half-width."""
        facts, period = self.model.facts.get(name), median_period(self.recording.joints[0])
        found = {each.joint: each for each in self.identification.joints}.get(name)
        estimate = None if found is None else found.estimates.get(DELAY)
        if facts is None or estimate is None or not math.isfinite(estimate.half_width):
            return None
        delay = max(facts.delay - round(share * estimate.half_width / period), 0)
        return facts._replace(delay=delay) if delay != facts.delay else None

    @cached_property
    def before(self) -> RunSeries:
        """The PID, simulated with the noise that explains how its efforts vary."""
        plain = self._plain
        aims = {each.joint: _quiet_variation(each) for each in self.recording.joints}
        was = {each.joint: _quiet_variation(each) for each in plain.joints}
        search = {
            name: _NoiseSearch.begun(self.model.facts[name])
            for name in (each.joint for each in self.loops)
            if name in self.model.facts
            and not abs(_ratio_or_one(was[name], aims[name]) - 1.0) <= _NEAR
        }
        for _ in range(_NOISE_TRIALS if search else 0):
            facts = {name: each.facts for name, each in search.items()}
            run = self._simulated(SIMULATED, self.loops, facts)
            for each in run.joints:
                if each.joint in search:
                    search[each.joint] = search[each.joint].after(
                        _quiet_variation(each), aims[each.joint]
                    )
        found = {name: each.best for name, each in search.items() if each.best is not None}
        if not found:
            return plain
        self.model = replace(self.model, facts={**self.model.facts, **found})
        return self._simulated(SIMULATED, self.loops)

    def propose(self, goal: str) -> tuple[Proposals, RunSeries]:
        """Return what is proposed for a goal, and its simulation."""
        self.phase(f"certifying degrees for the goal {goal}")
        found, failures = propose(
            self.loops, self.inertias, self.recording.joints, self.limits, goal, self.certifying
        )
        self.phase("simulating the identified robot")
        before = self.before  # first: it fits the noise
        after = self._simulated(PREDICTED, _after(self.loops, found))
        both = Comparison((run_indices(before), run_indices(after)))
        spread = self._delay_spread(_after(self.loops, found), both)
        found = {
            name: worthwhile(each, goal, both, self._doubt(goal, name, spread))
            for name, each in found.items()
        }
        if goal == self.goal:
            self.delay_doubts = {name: spread.get(name, 0.0) for name in _changed(found)}
        if not _changed(found):
            after = replace(before, label=PREDICTED)
        elif len(_changed(found)) < len(found):
            after = self._simulated(PREDICTED, _after(self.loops, found))
        return Proposals(found, failures), after

    def _delay_spread(
        self, proposed: Sequence[LoopSettings], both: Comparison
    ) -> dict[str, float]:
        """Return how far ratios move, by joint, with a delay at the near end of its interval."""
        shorter = {
            each.joint: known
            for each in self.loops
            if (known := self._with_shorter_delay(each.joint, 1.0)) is not None
        }
        if not shorter:
            return {}
        runs = [
            run_indices(self._simulated(label, loops, shorter))
            for label, loops in ((SIMULATED, self.loops), (PREDICTED, proposed))
        ]
        found: dict[str, float] = {}
        for name in shorter:
            one, other = (
                [each.ratio(PREDICTED, index, name) for index in JUDGED]
                for each in (both, Comparison(tuple(runs)))
            )
            moved = [abs(math.log(b / a)) for a, b in zip(one, other, strict=True) if a * b > 0.0]
            found[name] = max((each for each in moved if math.isfinite(each)), default=0.0)
        return found

    def try_other_goals(self) -> None:
        """Find what goals that were not asked for would bring to all joints."""
        for goal in GOALS:
            if goal == self.goal:
                continue
            proposals, after = self.propose(goal)
            if _changed(proposals.found):
                both = Comparison((run_indices(self.before), run_indices(after)))
                self.others[goal] = {each.key: both.ratio(after.label, each) for each in INDICES}

    def _simulated(
        self,
        label: str,
        loops: Sequence[LoopSettings],
        facts: Mapping[str, JointFacts] = MappingProxyType({}),
    ) -> RunSeries:
        robot = self.model.robot
        (found,) = simulate(
            robot.source,
            {label: loops},
            self.recording.joints,
            robot.fixed_base,
            robot.initial_positions,
            facts={**self.model.facts, **facts},
            has_velocities=self.has_velocities,
            period=median_period(self.recording.joints[0]),
            engine=_ENGINE,
        )
        return found


def _after(loops: Sequence[LoopSettings], found: Mapping[str, Upgrade]) -> list[LoopSettings]:
    return [found[each.joint].settings if each.joint in found else each for each in loops]


def _changed(found: Mapping[str, Upgrade]) -> list[str]:
    """Return the joints that do not keep their PID."""
    return [name for name, each in found.items() if each.settings.is_homogeneous]
