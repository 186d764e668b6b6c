"""The linear loop of the margins is the loop that runs, sample by sample."""

import math
from dataclasses import replace

import control
import numpy as np
import pytest
from harness.examples import examples
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from hpid_ros.base.errors import SettingError
from hpid_ros.control import JointLoop, LoopSettings
from hpid_ros.control.reference import Setpoint
from hpid_ros.stability.frequency import FrozenLoop, SampledJoint
from hpid_ros.stability.margins import loop_family

PERIOD = 0.001
INERTIA = 0.105
SOURCES = {
    "measured": {"velocity_source": "measured"},
    "filtered": {"velocity_source": "filtered", "velocity_filter_time_constant": 0.01},
    "difference": {"velocity_source": "filtered", "velocity_filter_time_constant": 0.0},
    "levant": {"velocity_source": "homogeneous_differentiator", "acceleration_bound": 1e5},
    "observer": {"velocity_source": "observer"},
    "observer that feeds": {"velocity_source": "observer", "observer.feed_disturbance": True},
    "semi-implicit": {"velocity_source": "filtered", "discretization": "semi_implicit"},
}


def settings_of(source="filtered", **others):
    values = {"joint": "elbow", "law": "pid", "inertia": INERTIA, "control_period": PERIOD}
    values |= {"gains.p": 21.0, "gains.i": 52.5, "gains.d": 2.1, "takeover_time": 0.0}
    return LoopSettings.from_parameters({**values, **SOURCES[source], **others})


def continuous(joint):
    """Return the joint's system matrix and input."""
    return (
        np.array([[0.0, 1.0], [0.0, -joint.friction / joint.inertia]]),
        np.array([[0.0], [1.0 / joint.inertia]]),
    )


def carried(joint, time):
    """Return what carries position, velocity and a constant effort over a time: (2, 3), exact."""
    system, gain = continuous(joint)
    block = np.zeros((3, 3))
    block[:2, :2], block[:2, 2:] = system * time, gain * time
    return expm(block)[:2]


def run_loop(settings, joint, start, samples):
    """Return positions and efforts of the loop that nodes run, on the exact joint."""
    loop = JointLoop(settings)
    loop.follow(Setpoint(0.0))
    whole = math.floor(joint.delay / joint.period)
    late = joint.delay - whole * joint.period
    older, newer = carried(joint, late), carried(joint, joint.period - late)
    efforts = [0.0] * (whole + 2)
    # Its first sample stands at the target; it begins after it, as the linear loop does.
    loop.step(1_000_000, 0.0, 0.0)
    state, positions = np.array(start), []
    for k in range(samples):
        stamp_ns = round((k + 2) * joint.period * 1e9)
        efforts.insert(0, loop.step(stamp_ns, float(state[0]), float(state[1])))
        positions.append(float(state[0]))
        state = older @ [*state, efforts[whole + 1]]
        state = newer @ [*state, efforts[whole]]
    return positions, efforts[:samples][::-1]


def run_matrix(frozen, start, samples):
    matrix = frozen.transition
    state, positions, efforts = np.zeros(matrix.shape[0]), [], []
    state[:2] = start
    for _ in range(samples):
        positions.append(float(state[0]))
        state = matrix @ state
        efforts.append(float(state[2]))
    return positions, efforts


@pytest.mark.parametrize("delay", [0.0, 0.4e-3, 2.7e-3])
@pytest.mark.parametrize("source", SOURCES)
def test_a_sample_of_the_linear_loop_is_a_sample_of_the_loop_that_runs(source, delay):
    joint = SampledJoint(INERTIA, PERIOD, 0.5, delay)
    settings = settings_of(source)
    start = (1e-3, 0.02)
    positions, efforts = run_loop(settings, joint, start, 400)
    expected = run_matrix(FrozenLoop(settings, joint), start, 400)
    assert positions == pytest.approx(expected[0], rel=1e-7, abs=1e-12)
    assert efforts == pytest.approx(expected[1], rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("degree", [-0.3, 0.2])
def test_at_rest_the_homogeneous_law_is_the_pid_of_its_floor(degree):
    settings = settings_of(law="hpid", mu=degree, **{"norm.floor": 0.1, "norm.effort_scale": 3.0})
    family = loop_family(settings, (INERTIA, INERTIA), friction=0.5)
    frozen = family.loop(INERTIA, family.at_rest)
    start = (1e-3, 0.0)  # its norm stays below the floor
    positions, _ = run_loop(settings, frozen.joint, start, 400)
    expected, _ = run_matrix(frozen, start, 400)
    assert positions == pytest.approx(expected, rel=1e-7, abs=1e-12)
    assert family.at_rest == pytest.approx(0.1**degree)
    other, _ = run_matrix(family.loop(INERTIA), start, 400)
    assert positions[100:] != pytest.approx(other[100:], rel=1e-2)


@pytest.mark.parametrize("source", SOURCES)
def test_the_response_is_that_of_the_loop_cut_at_the_effort(source):
    joint = SampledJoint(INERTIA, PERIOD, 0.5, 1.3e-3)
    frozen = FrozenLoop(settings_of(source), joint)
    frequency = np.array([0.5, 5.0, 60.0, 700.0, 3000.0])
    found = frozen.response(frequency)
    # A sinusoid pushed into the cut loop, whose answer comes back at the same place.
    system, gain, output = cut_open(frozen)
    for w, value in zip(frequency, found, strict=True):
        z = np.exp(1j * w * PERIOD)
        answer = output @ np.linalg.solve(z * np.eye(gain.size) - system, gain)
        assert -complex(answer) == pytest.approx(complex(value), rel=1e-6)


def cut_open(frozen):
    """Return system, input and output of a loop whose joint gets another effort than is sent.

    Its observer hears what its own law sends.
    """
    closed, held = frozen.transition, frozen.joint.held
    own, under_way = closed.shape[0], held.whole_periods + 1
    size = own + under_way
    system, gain = np.zeros((size, size)), np.zeros(size)
    system[:own, :own] = closed
    system[:2] = 0.0
    system[:2, :2] = [[1.0, held.reach], [0.0, held.keep]]
    system[:2, size - 1] += held.older
    if held.whole_periods:
        system[:2, size - 2] += held.newer
    else:
        gain[:2] = held.newer
    gain[own] = 1.0
    for k in range(own + 1, size):
        system[k, k - 1] = 1.0
    return system, gain, np.concatenate([closed[2], np.zeros(under_way)])


numbers = st.floats(-1.0, 1.0)


@examples(1)
@given(numbers, numbers, numbers, st.floats(0.0, 4.0))
def test_the_held_joint_is_that_of_python_control(inertia, friction, period, late):
    joint = SampledJoint(10.0**inertia, 10.0 ** (period - 3), 10.0 ** (2 * friction), 0.0)
    system, gain = continuous(joint)
    sampled = control.c2d(control.ss(system, gain, np.eye(2), 0), joint.period, "zoh")
    frequency = joint.nyquist * np.array([1e-3, 0.03, 0.4, 0.99])
    expected = np.array([sampled(np.exp(1j * w * joint.period)).ravel() for w in frequency])
    found = joint.response(frequency)
    assert found.position == pytest.approx(expected[:, 0], rel=1e-6)
    assert found.velocity == pytest.approx(expected[:, 1], rel=1e-8)
    # A whole number of periods is that many shifts; between two, nothing jumps.
    delayed = replace(joint, delay=round(late) * joint.period).response(frequency)
    shift = np.exp(-1j * frequency * round(late) * joint.period)
    assert delayed.position == pytest.approx(found.position * shift, rel=1e-9)
    near = replace(joint, delay=(round(late) + 1e-9) * joint.period).response(frequency)
    assert near.position == pytest.approx(delayed.position, rel=1e-6)


def test_without_friction_the_joint_is_the_double_integrator():
    joint = SampledJoint(0.2, 0.001)
    w = np.array([1.0, 300.0])
    z = np.exp(1j * w * 0.001)
    expected = 0.001**2 / 0.4 * (z + 1.0) / (z - 1.0) ** 2
    assert joint.response(w).position == pytest.approx(expected, rel=1e-9)
    little = SampledJoint(0.2, 0.001, friction=1e-9).response(w)
    assert little.position == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ({"inertia": 0.0}, "inertia must be positive"),
        ({"period": math.nan}, "period must be positive"),
        ({"friction": -1.0}, "friction must be finite and not negative, not -1.0 N m s/rad"),
        ({"delay": math.inf}, "delay must be finite"),
    ],
)
def test_impossible_joints_are_refused(numbers, words):
    with pytest.raises(SettingError, match=words.replace("(", r"\(")):
        SampledJoint(**{"inertia": 1.0, "period": 1e-3, **numbers})
