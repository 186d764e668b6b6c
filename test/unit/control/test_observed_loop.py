"""A loop with an observer: sent efforts, switching while it runs, faults, disturbances fed."""

import math
from itertools import pairwise

import pytest
from harness.loops import pure_loop
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.control import ModelTerm
from hpid_ros.control.reference import Setpoint
from hpid_ros.motion import Column, Knot

MS = 1_000_000
INERTIA = 0.5
VALUES = {
    **{"law": "pid", "gains__p": 200.0, "gains__i": 500.0, "gains__d": 20.0},
    **{"inertia": INERTIA, "velocity_source": "observer"},
}
FIGURES = {
    **{"velocity_source": "filtered", "velocity_filter_time_constant": 0.02, "inertia": 0.7},
    **{"observer.bandwidth": 300.0, "observer.degree": 0.2, "observer.innovation_scale": 1e-5},
}


def loop_of(**changes):
    return pure_loop(**{**VALUES, **changes})


class Joint:
    """A joint of constant inertia under a load, moved exactly."""

    def __init__(self, load=0.0, inertia=INERTIA):
        self.position, self.velocity = 0.1, 0.0
        self.load, self.inertia, self.stamp_ns = load, inertia, 0

    def push(self, effort, dt_ms=1):
        dt = dt_ms * 1e-3
        acceleration = (effort + self.load) / self.inertia
        self.position += dt * (self.velocity + 0.5 * dt * acceleration)
        self.velocity += dt * acceleration
        self.stamp_ns += dt_ms * MS


def drive(loop, joint, samples, periods=(1,)):
    """Step the loop on the joint, and return its efforts."""
    efforts = []
    for k in range(samples):
        efforts.append(loop.step(joint.stamp_ns, joint.position))
        joint.push(efforts[-1], periods[k % len(periods)])
    return efforts


@pytest.mark.parametrize("law", ["pid", "hpid"])
@pytest.mark.parametrize("limit", [1e6, 6.0])
@pytest.mark.parametrize("periods", [(1,), (1, 3, 1, 2), (2, 40, 1)])
def test_velocity_and_load_are_found_whatever_the_limits_and_the_stamps(law, limit, periods):
    """What was sent counts, not what was wanted."""
    loop = loop_of(law=law, mu=-0.1, u_clamp_max=limit, u_clamp_min=-limit)
    joint = Joint(load=-3.0)
    loop.follow(Setpoint(0.4))
    drive(loop, joint, 150, periods)
    for _ in range(200):
        speed = joint.velocity
        drive(loop, joint, 1, periods)
        assert loop.estimate[2] == pytest.approx(-3.0, abs=1e-3)
        assert loop.velocity == pytest.approx(speed, abs=1e-4)
    assert (loop.counts.saturated > 0) == (limit == 6.0)


def test_the_law_sees_the_estimated_position():
    loop = loop_of(gains__i=0.0, gains__d=1e-6, observer__bandwidth=50.0)
    loop.follow(Setpoint(0.0))
    for k in range(500):
        effort = loop.step(k * MS, 1e-3 * (-1) ** k)
    assert abs(effort) < 0.1 * 200.0 * 1e-3
    assert loop.error == pytest.approx(-loop.estimate[0])


@given(st.integers(1, 40), st.booleans())
def test_states_without_a_position_leave_the_estimates_right(lost, is_nan):
    """The fallback was sent meanwhile, which the observer knows."""
    loop = loop_of(fallback_effort=2.0, observer__bandwidth=60.0)
    joint = Joint(load=-1.0)
    loop.follow(Setpoint(0.4))
    drive(loop, joint, 400)
    for _ in range(lost):
        joint.push(loop.step(joint.stamp_ns, math.nan if is_nan else 1e300))
    joint_speed = joint.velocity
    drive(loop, joint, 1)
    assert loop.velocity == pytest.approx(joint_speed, abs=1e-6)
    assert loop.estimate[2] == pytest.approx(-1.0, abs=1e-3)


@pytest.mark.parametrize("name", FIGURES)
@pytest.mark.parametrize("back", [False, True])
def test_it_is_switched_and_retuned_in_motion_without_a_kick(name, back):
    """No estimate jumps: the effort moves by no more than from sample to sample before."""
    start = {name.replace(".", "__"): FIGURES[name]} if back else {}
    (loop, joint), twin = [(loop_of(**start), Joint(load=-8.0)) for _ in range(2)]
    for each, own in ((loop, joint), twin):
        each.follow(Setpoint(1.0))
        drive(each, own, 60)
    assert abs(loop.velocity) > 0.5
    values = pure_loop(**VALUES).settings.to_parameters()
    values[name] = values[name] if back else FIGURES[name]
    loop.retune(type(loop.settings).from_parameters(values))
    efforts, others = drive(loop, joint, 10), drive(*twin, 10)
    assert abs(efforts[0] - others[0]) < 0.6  # of up to 60; an estimate that began anew: 10
    differences = [a - b for a, b in zip(efforts, others, strict=True)]
    assert max(abs(b - a) for a, b in pairwise(differences)) < 0.5


@pytest.mark.parametrize("last", [500, 501])
def test_what_an_observer_is_off_by_when_it_is_left_fades(last):
    """It is left, met again half way and left anew: no effort steps; the measurement remains."""
    loop = loop_of(gains__i=0.0, gains__d=1e-6, observer__bandwidth=50.0, takeover_time=0.1)
    loop.follow(Setpoint(0.0))
    filtered = {**loop.settings.to_parameters(), "velocity_source": "filtered"}
    observed = loop.settings
    for k in range(last):
        effort = loop.step(k * MS, 1e-3 * (-1) ** k)
    measured = 1e-3 * (-1) ** k
    assert abs(effort + 200.0 * measured) > 0.1  # what a step would be
    for settings in (type(observed).from_parameters(filtered), observed) * 2:
        loop.retune(settings)
        for _ in range(40):
            k += 1
            before, effort = effort, loop.step(k * MS, measured)
            assert abs(effort - before) < 0.02
    loop.retune(type(observed).from_parameters(filtered))
    for _ in range(101):
        k += 1
        before, effort = effort, loop.step(k * MS, measured)
        assert abs(effort - before) < 0.02
    assert loop.error == -measured


@pytest.mark.parametrize("model", [None, ModelTerm(1.0, 2.5), ModelTerm(0.3, -4.0)])
def test_a_disturbance_is_fed_and_left_alone_again_without_a_kick(model):
    """The integral hands over what the other term gives, and takes it back."""
    changes = {} if model is None or model.gain == 1.0 else {"compensation": "decoupling"}
    loop, joint = loop_of(observer__bandwidth=60.0, **changes), Joint(load=-8.0)
    loop.follow(Setpoint(0.1))

    def step():
        effort = loop.step(joint.stamp_ns, joint.position, None, model)
        joint.push(effort)
        return effort

    for _ in range(4000):
        effort = step()
    assert effort == pytest.approx(8.0, abs=1e-3)
    for is_on in (True, False, True):
        feeding = {"observer.feed_disturbance": is_on}
        loop.retune(loop.settings.with_parameters(feeding))
        assert step() == pytest.approx(effort, abs=1e-5)
        own = 8.0 - (0.0 if model is None else model.effort)
        assert loop.integral == pytest.approx(0.0 if is_on else own, abs=0.01)
        for _ in range(200):
            assert step() == pytest.approx(effort, abs=1e-3)


def test_with_decoupling_only_what_the_model_does_not_know_is_a_disturbance():
    """Its gain, its effort and the reference's acceleration are known to drive the joint."""
    gain, own, load = 0.3, -4.0, 0.6
    loop = loop_of(compensation="decoupling")
    loop.follow(Column("j", (Knot(0, 0.1, 0.0, 0.0), Knot(800 * MS, 2.0, 0.0, 0.0)), stamp_ns=1))
    joint = Joint(inertia=gain)
    for k in range(800):
        effort = loop.step(joint.stamp_ns, joint.position, None, ModelTerm(gain, own, True))
        joint.push(effort - own + load)
        if k > 300:
            assert loop.estimate[2] == pytest.approx(load, abs=1e-3)
    assert joint.position > 1.5


def test_a_disturbance_that_is_fed_settles_sooner():
    errors = []
    for is_fed in (False, True):
        loop, joint = loop_of(gains__i=50.0, observer__feed_disturbance=is_fed), Joint(load=-8.0)
        loop.follow(Setpoint(0.1))
        drive(loop, joint, 500)
        errors.append(abs(joint.position - 0.1))
    assert errors[1] < 0.1 * errors[0]


@pytest.mark.parametrize("is_fed", [False, True])
def test_a_takeover_begins_with_the_effort_in_force(is_fed):
    loop, joint = loop_of(observer__feed_disturbance=is_fed), Joint(load=-8.0)
    loop.follow(Setpoint(0.1))
    effort = drive(loop, joint, 3000)[-1]
    joint.stamp_ns += 500 * MS
    assert drive(loop, joint, 1)[0] == pytest.approx(effort, abs=1e-6)
    assert loop.counts.takeovers == 1
    assert drive(loop, joint, 300)[-1] == pytest.approx(effort, abs=0.05)


def test_a_reset_leaves_nothing_behind():
    loop, fresh = loop_of(), loop_of()
    drive(loop, Joint(load=5.0), 300)
    loop.reset()
    assert drive(loop, Joint(load=-2.0), 300) == drive(fresh, Joint(load=-2.0), 300)


def test_without_inertia_it_is_the_filter_to_the_bit_and_says_so():
    values = {"inertia": 0.0, "velocity_filter_time_constant": 0.01}
    loop, twin = loop_of(**values), loop_of(**values, velocity_source="filtered")
    assert drive(loop, Joint(), 300) == drive(twin, Joint(), 300)
    assert loop.estimate is None
    assert loop.velocity_origin == "filtered, the inertia is unknown"
    assert "needs the parameter inertia" in loop.velocity_warning
    loop.retune(loop.settings.with_parameters({"inertia": INERTIA}))
    assert (loop.velocity_origin, loop.velocity_warning) == ("observer", "")
    assert loop.estimate is not None


def test_its_bandwidth_follows_the_gains_unless_it_is_given():
    for d, given_, expected in ((20.0, 0.0, 160.0), (10.0, 0.0, 80.0), (10.0, 33.0, 33.0)):
        loop = loop_of(gains__d=d, observer__bandwidth=given_)
        assert loop._estimation._observer.figures.bandwidth == expected


def test_a_source_that_was_changed_beside_a_stray_stamp_stays_changed():
    loop, joint = loop_of(), Joint()
    drive(loop, joint, 50)
    loop.step(joint.stamp_ns + 10_000 * MS, joint.position)  # from the future
    loop.retune(loop_of(velocity_source="filtered").settings)
    drive(loop, joint, 5)
    assert loop.counts.takeovers == 0  # the stray stamp has left nothing behind
    assert loop.estimate is None
