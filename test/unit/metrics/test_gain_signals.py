"""What a law did to its gains: a recording's multipliers are those of the loop that ran."""

import math
from dataclasses import replace

import numpy as np
import pytest

from hpid_ros.control.assembly import make_law
from hpid_ros.control.homogeneous_pid import Gains
from hpid_ros.control.joint_loop import JointLoop
from hpid_ros.control.model import ModelSettings
from hpid_ros.control.reference import Setpoint
from hpid_ros.control.settings import LoopSettings, NormSettings, VelocitySettings
from hpid_ros.messages.quality import DataQuality, RecordingQuality
from hpid_ros.messages.series import JointSeries, Retune, RunSeries
from hpid_ros.metrics.gain_signals import gain_notes, gain_signals, gains_of_runs
from hpid_ros.motion.generators import minimum_jerk

SECOND = 1_000_000_000
SETTINGS = LoopSettings(
    "elbow",
    Gains(40.0, 30.0, 8.0),
    mu=-0.2,
    inertia=1.0,
    norm=NormSettings(error_scale=0.5, floor=0.01),
)
SLOW = 0.2  # [s], a filter whose velocities lag far behind
SOURCES = [
    VelocitySettings("measured", velocity_filter_time_constant=SLOW),
    VelocitySettings("filtered", velocity_filter_time_constant=SLOW),
    VelocitySettings("homogeneous_differentiator", acceleration_bound=100.0),
    VelocitySettings("observer"),
]


def ran(settings, motion, reference, *, reports=lambda k: True, count=1500):
    """Run a loop on a double integrator; return its recording and its own multipliers."""
    loop, law = JointLoop(settings), make_law(settings)
    loop.follow(motion)
    rng = np.random.default_rng(3)
    stamp, position, velocity = 5 * SECOND, 0.0, 0.0
    rows, own = [], []
    for k in range(count):
        told = velocity if reports(k) else math.nan
        effort = loop.step(stamp, position, None if math.isnan(told) else told)
        rows.append((stamp, position, loop.following.position, effort, told))
        own.append(law.multiplier(loop.error, loop.following.velocity - loop.estimation.velocity))
        period_ns = int(rng.integers(800_000, 1_200_000))  # stamps of a busy machine
        stamp, dt = stamp + period_ns, period_ns / SECOND
        velocity += dt * effort
        position += dt * velocity
    stamps, position, reference_seen, effort, velocities = map(np.array, zip(*rows, strict=True))
    series = JointSeries(
        "elbow",
        stamps.astype(np.int64),
        position,
        reference_seen,
        stamps.astype(np.int64),
        effort,
        velocity=velocities,
    )
    quality = RecordingQuality(joints={"elbow": DataQuality(reference=reference)})
    return RunSeries("hPID", (series,), quality=quality), np.array(own)


@pytest.mark.parametrize("source", SOURCES, ids=lambda each: each.velocity_source)
def test_the_multiplier_of_a_setpoint_is_the_loops_to_the_last_bit(source):
    settings = replace(SETTINGS, velocity=source)
    run, own = ran(settings, Setpoint(0.4), "setpoint /elbow_controller/setpoint")
    found = gain_signals(run, {"elbow": settings})["elbow"]
    assert np.ptp(own) > 0.1
    assert found.multiplier.values.tolist() == own.tolist()


@pytest.mark.parametrize("source", SOURCES, ids=lambda each: each.velocity_source)
def test_the_multiplier_of_a_motion_is_the_loops_but_for_the_rate_of_the_reference(source):
    settings = replace(SETTINGS, velocity=source)
    motion = minimum_jerk([0.0, 1.0], {"elbow": [0.0, 1.0]}).column("elbow")
    run, own = ran(settings, motion, "trajectory /joint_trajectory")
    found = gain_signals(run, {"elbow": settings})["elbow"]
    assert np.allclose(found.multiplier.values, own, rtol=0.01)


def test_states_that_report_no_velocity_have_the_filters():
    settings = replace(SETTINGS, velocity=SOURCES[0])
    setpoint = "setpoint /elbow_controller/setpoint"
    run, own = ran(settings, Setpoint(0.4), setpoint, reports=lambda k: k % 3)
    found = gain_signals(run, {"elbow": settings})["elbow"]
    assert found.multiplier.values.tolist() == own.tolist()


def test_a_recording_read_without_its_velocities_has_no_multiplier_of_a_loop_that_used_them():
    settings = replace(SETTINGS, velocity=SOURCES[0])
    run, _ = ran(settings, Setpoint(0.4), "setpoint /a", count=10)
    (series,) = run.joints
    bare = replace(run, joints=(replace(series, velocity=None),))
    loops = {"hPID": {"elbow": settings}}
    assert gains_of_runs([bare], loops) == {}
    (line,) = gain_notes([bare], loops)
    assert "the velocities of the states, which were not read" in line
    assert gain_notes([run], loops) == []
    assert gain_notes([bare], {}) == []


def test_an_observer_that_a_model_helped_cannot_be_computed_again():
    model = ModelSettings(compensation="gravity")
    settings = replace(SETTINGS, velocity=SOURCES[3], model=model)
    run, _ = ran(replace(settings, model=SETTINGS.model), Setpoint(0.4), "setpoint /a", count=10)
    assert gain_signals(run, {"elbow": settings}) is None
    assert "model" in gain_notes([run], {"hPID": {"elbow": settings}})[0]


def test_a_change_of_parameters_is_named_beside_the_multiplier():
    run, _ = ran(SETTINGS, Setpoint(0.4), "setpoint /a", count=10)
    run = replace(run, retunes=(Retune(5 * SECOND, "elbow_controller", "mu = 0"),))
    (line,) = gain_notes([run], {"hPID": {"elbow": SETTINGS}})
    assert "parameters were changed while it ran" in line


def test_positions_that_no_loop_takes_have_the_multiplier_of_the_norms_cap():
    settings = replace(SETTINGS, mu=0.45, norm=NormSettings(error_scale=0.5, cap=4.0))
    run, _ = ran(settings, Setpoint(0.4), "setpoint /a", count=10)
    (series,) = run.joints
    far = replace(run, joints=(replace(series, position=series.position + 1e300),))
    found = gain_signals(far, {"elbow": settings})["elbow"]
    assert set(found.multiplier.values.tolist()) == {4.0**0.45}
