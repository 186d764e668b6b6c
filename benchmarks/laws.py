"""The cost of one control law, and of one whole joint loop."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from simple_pid import PID

from benchmarks.figures import Bound, Figure, Group, Measure, Source
from benchmarks.measuring import time_per_item
from hpid_ros.control import (
    Gains,
    HomogeneousPid,
    JointLoop,
    LoopSettings,
    Pid,
)
from hpid_ros.control.norms import NORMS
from hpid_ros.control.settings import (
    EffortLimits,
    EncoderSettings,
    IntegralLimits,
    NormSettings,
    VelocitySettings,
)
from hpid_ros.motion import minimum_jerk

GAINS = Gains(p=39.6, i=132.0, d=3.96)
DEGREE = -0.1
PERIOD = 0.001  # [s]
PERIOD_NS = 1_000_000
ERROR_SCALE = 0.3  # [rad]
RATE_WEIGHT = 0.2  # [s/rad]
EFFORT_LIMIT = 4.0  # [N m]; about a quarter of the samples exceed it
JOINT = "joint"

_MICROSECONDS = 1e6  # in a second
_SAMPLES, _SAMPLES_QUICK = 200_000, 20_000
_LOOP_SAMPLES, _LOOP_SAMPLES_QUICK = 50_000, 9_000


def group(quick: bool) -> Group:
    """Return the figures of laws and loops."""
    law_samples = _SAMPLES_QUICK if quick else _SAMPLES
    loop_samples = _LOOP_SAMPLES_QUICK if quick else _LOOP_SAMPLES
    contenders: dict[str, Measure] = {
        "Pid.update": _law(lambda: Pid(GAINS), law_samples),
        "HomogeneousPid.update": _law(lambda: _homogeneous("weighted"), law_samples),
        "HomogeneousPid.update, canonical norm": _law(
            lambda: _homogeneous("canonical"), law_samples
        ),
        "simple_pid.PID": _peer(law_samples),
        "JointLoop.step": _loop("weighted", loop_samples),
        "JointLoop.step, canonical norm": _loop("canonical", loop_samples),
    }
    peer = "a simple_pid.PID call"
    bounds = (Bound("ours", most=6.0), Bound("ratio", most=10.0))
    return Group(
        contenders,
        (
            _figure("law.hpid", "HomogeneousPid.update", "simple_pid.PID", peer,
                    (Bound("ratio", most=0.5),)),
            _figure("law.pid", "Pid.update", "simple_pid.PID", peer),
            _figure("joint_loop.step", "JointLoop.step", "HomogeneousPid.update",
                    "the bare law", bounds),
            _figure("joint_loop.step.canonical", "JointLoop.step, canonical norm",
                    "HomogeneousPid.update, canonical norm", "the bare law, canonical norm"),
        ),
    )  # fmt: skip


def _figure(
    name: str, ours: str, reference: str, against: str, bounds: tuple[Bound, ...] = ()
) -> Figure:
    return Figure(name, "us", Source(ours, "time"), Source(reference, "time"), against, bounds)


def _error_states(count: int) -> list[tuple[float, float]]:
    """Return errors in [rad] and their rates in [rad/s] as a joint that settles shows them."""
    states = []
    for k in range(count):
        phase, size = 0.02 * k, 0.3 * math.exp(-(k % 1000) / 200.0)
        states.append((size * math.cos(phase), -20.0 * size * math.sin(phase)))
    return states


def _homogeneous(norm: str) -> HomogeneousPid:
    return HomogeneousPid(GAINS, NORMS[norm].scaled(DEGREE, ERROR_SCALE, RATE_WEIGHT))


def _law(make: Callable[[], Pid], count: int) -> Measure:
    states = _error_states(count)

    def measure() -> Mapping[str, float]:
        update = make().update

        def run() -> None:
            for error, error_rate in states:
                update(error, error_rate, PERIOD)

        return {"time": time_per_item(run, count) * _MICROSECONDS}

    return measure


def _peer(count: int) -> Measure:
    states = _error_states(count)

    def measure() -> Mapping[str, float]:
        # Without a sample time it computes at every call; it reads the clock for its dt.
        pid = PID(GAINS.p, GAINS.i, GAINS.d, setpoint=0.0, sample_time=None)

        def run() -> None:
            for error, _ in states:
                pid(error)

        return {"time": time_per_item(run, count) * _MICROSECONDS}

    return measure


def _loop(norm: str, count: int) -> Measure:
    """Return the measurement of a joint loop with everything switched on."""
    settings = LoopSettings(
        joint=JOINT,
        gains=GAINS,
        mu=DEGREE,
        norm=NormSettings(norm, ERROR_SCALE, RATE_WEIGHT),
        effort=EffortLimits(EFFORT_LIMIT, -EFFORT_LIMIT),
        integral=IntegralLimits(0.5 * EFFORT_LIMIT, -0.5 * EFFORT_LIMIT, "back_calculation"),
        velocity=VelocitySettings("filtered"),
        encoder=EncoderSettings(encoder_resolution=math.tau / 16384),
        inertia=0.132,
    )
    seconds = count * PERIOD
    knots = [seconds * k / 8.0 for k in range(9)]
    reference = minimum_jerk(knots, {JOINT: [0.6 * (k % 2) for k in range(9)]}).column(JOINT)
    sampled = reference.start(0, 0.0, 0.0)
    states = []
    for k in range(count):
        deviation = 0.2 * math.exp(-(k % 1000) / 200.0) * math.cos(0.02 * k)
        states.append((k * PERIOD_NS, sampled.sample(k * PERIOD_NS)[0] + deviation))

    def measure() -> Mapping[str, float]:
        loop = JointLoop(settings)
        loop.follow(reference)
        step = loop.step

        def run() -> None:
            for stamp_ns, position in states:
                step(stamp_ns, position)

        time = time_per_item(run, count)
        _require_all_features(loop, count)
        return {"time": time * _MICROSECONDS}

    return measure


def _require_all_features(loop: JointLoop, count: int) -> None:
    """Make sure that what was timed is what is claimed."""
    counts = loop.counts
    if counts.samples != count or not 0.01 * count < counts.saturated < 0.5 * count:
        raise RuntimeError(
            f"the loop took {counts.samples} of {count} samples and saturated in "
            f"{counts.saturated} of them"
        )
