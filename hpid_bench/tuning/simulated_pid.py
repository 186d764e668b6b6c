"""The recorded PID, simulated on the identified robot: delays and noise fitted, and doubts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hpid_bench.tuning.identification.joint_identification import JointIdentification
from hpid_bench.tuning.identification.regression import DELAY, STRIBECK, Estimate
from hpid_bench.tuning.loop_simulation import DriveFacts, RobotSimulation, simulate
from hpid_bench.tuning.pid_recording import PidRecording
from hpid_bench.tuning.robot_model import RobotModel
from hpid_bench.tuning.upgrade_prediction import JUDGED
from hpid_ros.control.settings import LoopSettings
from hpid_ros.messages.series import JointSeries, RunSeries
from hpid_ros.metrics.quantities import IVC, Quantity
from hpid_ros.metrics.results import RunIndices
from hpid_ros.metrics.run_numbers import run_indices

SIMULATED_RUN = "simulated"
"""Label of the run."""

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


@dataclass(frozen=True)
class SimulatedPid:
    """The PID, simulated along the recorded motion."""

    model: RobotModel  # the robot, with the delays and the noise that were fitted
    run: RunSeries
    # half of the interval of the logarithm of a ratio of two simulations, by joint
    doubts: Mapping[str, float]


class _Fitted(NamedTuple):
    """A model of the robot, and the PID simulated on it."""

    model: RobotModel
    run: RunSeries


def simulated_pid(
    recording: PidRecording, identified: Sequence[JointIdentification], model: RobotModel
) -> SimulatedPid:
    """Simulate the PID with the delays and the noise that explain best what was recorded.

    The doubts say by how far the simulated PID is from the recorded one, also before noise was
    fitted, and what the simulation lacks of a joint though it was seen.
    """
    target = run_indices(recording.controlled)
    plain = _with_fitted_delays(recording, delay_estimates(identified), model, target)
    fitted = _with_fitted_noise(recording, plain)
    before, after = run_indices(plain.run), run_indices(fitted.run)
    lacking = {each.joint: _doubt_of_what_lacks(each) for each in identified}
    doubts: dict[str, float] = {}
    for each in fitted.run.joints:
        name = each.joint
        misfit = max(_misfit(before, target, name, (IVC,)), _misfit(after, target, name, JUDGED))
        doubts[name] = (
            _LEAST_DOUBT
            + _DOUBT_OF_MISFIT * misfit
            + lacking.get(name, 0.0)
            + _DOUBT_OF_COURSE * _unlike(each, recording.series[name])
        )
    return SimulatedPid(fitted.model, fitted.run, doubts)


def simulated(
    label: str, loops: Sequence[LoopSettings], recording: PidRecording, model: RobotModel
) -> RunSeries:
    """Return controllers, simulated on a model of the robot along the recorded motion."""
    robot = RobotSimulation(
        source=model.robot.source,
        fixed_base=model.robot.fixed_base,
        initial_positions=model.robot.initial_positions,
        facts=model.facts,
        has_velocities=recording.has_velocities,
        period=recording.period,
        engine=_ENGINE,
    )
    (run,) = simulate(robot, {label: loops}, recording.run.joints)
    return run


def delay_estimates(identified: Sequence[JointIdentification]) -> dict[str, Estimate]:
    """Return the delays that were identified, by joint."""
    found = {each.joint: each.estimates.get(DELAY) for each in identified}
    return {joint: estimate for joint, estimate in found.items() if estimate is not None}


def with_shorter_delay(
    facts: DriveFacts | None, estimate: Estimate | None, period: float, share: float
) -> DriveFacts | None:
    """Return a joint's facts, its delay shorter by a share of the half-width of its interval.

    None where that is the same delay, or where nothing is known of it.
    """
    if facts is None or estimate is None or not math.isfinite(estimate.half_width):
        return None
    delay = max(facts.delay - round(share * estimate.half_width / period), 0)
    return facts._replace(delay=delay) if delay != facts.delay else None


def _with_fitted_delays(
    recording: PidRecording,
    delays: Mapping[str, Estimate],
    model: RobotModel,
    target: RunIndices,
) -> _Fitted:
    """Simulate the PID with the noise that the positions show; shorten delays where that helps.

    A delay is known within an interval. Where the middle of it gives another run than the
    recorded one, as an oscillation that was none, the delay that comes closer is taken.
    """
    first = simulated(SIMULATED_RUN, recording.loops, recording, model)
    indices = run_indices(first)
    least = {name: _misfit(indices, target, name, JUDGED) for name in recording.joints}
    trials: dict[str, list[DriveFacts]] = {}
    for name, misfit in least.items():
        if misfit > _FAR_OFF:
            facts, estimate = model.facts.get(name), delays.get(name)
            shorter = [
                with_shorter_delay(facts, estimate, recording.period, share) for share in _SHORTER
            ]
            trials[name] = list(dict.fromkeys(each for each in shorter if each is not None))
    best: dict[str, DriveFacts] = {}
    for number in range(max(map(len, trials.values()), default=0)):
        tried = {name: each[number] for name, each in trials.items() if number < len(each)}
        run = simulated(SIMULATED_RUN, recording.loops, recording, model.with_facts(tried))
        indices = run_indices(run)
        for name, facts_tried in tried.items():
            if (misfit := _misfit(indices, target, name, JUDGED)) < least[name]:
                least[name], best[name] = misfit, facts_tried
    if not best:
        return _Fitted(model, first)
    fitted = model.with_facts(best)
    return _Fitted(fitted, simulated(SIMULATED_RUN, recording.loops, recording, fitted))


def _with_fitted_noise(recording: PidRecording, plain: _Fitted) -> _Fitted:
    """Simulate the PID with the noise that explains how its efforts vary."""
    aims = {name: _quiet_variation(recording.series[name]) for name in recording.joints}
    was = {each.joint: _quiet_variation(each) for each in plain.run.joints}
    search = {
        name: _NoiseSearch.begun(plain.model.facts[name])
        for name in recording.joints
        if name in plain.model.facts
        and not abs(_ratio_or_one(was[name], aims[name]) - 1.0) <= _NEAR
    }
    for _ in range(_NOISE_TRIALS if search else 0):
        tried = plain.model.with_facts({name: each.facts for name, each in search.items()})
        run = simulated(SIMULATED_RUN, recording.loops, recording, tried)
        for each in run.joints:
            if each.joint in search:
                search[each.joint] = search[each.joint].after(
                    _quiet_variation(each), aims[each.joint]
                )
    found = {name: each.best for name, each in search.items() if each.best is not None}
    if not found:
        return plain
    fitted = plain.model.with_facts(found)
    return _Fitted(fitted, simulated(SIMULATED_RUN, recording.loops, recording, fitted))


def _misfit(run: RunIndices, target: RunIndices, joint: str, indices: Sequence[Quantity]) -> float:
    """Return the largest logarithm by which a run misses a recorded index of a joint."""
    ratios = [_ratio_or_one(run.value(each, joint), target.value(each, joint)) for each in indices]
    return max(abs(math.log(each)) if 0.0 < each < math.inf else math.inf for each in ratios)


def _doubt_of_what_lacks(joint: JointIdentification) -> float:
    """Return a doubt for what was seen of a joint, and is not simulated."""
    is_creeping = joint.reliable(STRIBECK) is not None
    return _DOUBT_OF_SPRING * (not joint.is_rigid) + _DOUBT_OF_CREEP * is_creeping


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

    facts: DriveFacts  # what is tried next
    low: float  # [rad] noise with too little variation
    high: float  # [rad] noise with too much
    best: DriveFacts | None = None  # what came closest, if close enough; None if nothing has
    off: float = _CLOSE_ENOUGH  # by how much, as a share

    @classmethod
    def begun(cls, facts: DriveFacts) -> _NoiseSearch:
        largest = max(_MOST_COUNTS * (facts.resolution or 0.0), _MOST_TIMES * facts.noise)
        return cls(facts._replace(noise=largest / 4.0), 0.0, largest)

    def after(self, value: float, target: float) -> _NoiseSearch:
        """Return the next step once a simulation has said how much the effort varies."""
        tried, off = self.facts.noise, abs(value / target - 1.0)
        low, high = (tried, self.high) if value < target else (self.low, tried)
        best, least = (self.facts, off) if off < self.off else (self.best, self.off)
        middle = math.sqrt(low * high) if low > 0.0 else high / 4.0
        return _NoiseSearch(self.facts._replace(noise=middle), low, high, best, least)
