"""What is fed forward: the reference is met with less error, and no effort jumps."""

from dataclasses import replace
from itertools import pairwise

import pytest
from harness.loops import Joint, drive, loop_settings, pure_loop
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import SettingError
from hpid_ros.control import ModelTerm
from hpid_ros.control.overrides import RelayRequest
from hpid_ros.control.reference import Setpoint
from hpid_ros.motion import Column, Knot
from hpid_ros.robot.joint_description import UNLIMITED

MS, SECOND = 1_000_000, 1_000_000_000
PID = {"law": "pid", "gains__p": 200.0, "gains__i": 500.0, "gains__d": 20.0}
INERTIA, VISCOUS, COULOMB = 0.5, 2.0, 1.5
MODEL = {
    "feedforward__inertia": INERTIA,
    "feedforward__viscous_friction": VISCOUS,
    "feedforward__coulomb_friction": COULOMB,
}


def joint_of(load=0.0):
    """Return a joint with friction, or one under a load."""
    return Joint(INERTIA, load, viscous=VISCOUS, coulomb=0.0 if load else COULOMB)


def at_rest(loop, first, last, model=None):
    return [loop.step(k * MS, 0.0, 0.0, model) for k in range(first, last)]


def motion(first=None, last=None):
    """Return a quintic from 0 to 1 rad in 1 s, with these efforts at its ends."""
    ends = Knot(0, 0.0, 0.0, 0.0, first), Knot(SECOND, 1.0, 0.0, 0.0, last)
    return Column("elbow", ends)


def held(*efforts, begin=0, gap=100 * MS):
    """Return a motion that rests at 0, with these efforts, one a knot."""
    knots = (Knot(begin + k * gap, 0.0, 0.0, 0.0, effort) for k, effort in enumerate(efforts))
    return Column("elbow", tuple(knots))


def test_what_moves_the_joint_is_known_beforehand():
    worst = {}
    inertia = {"feedforward__inertia": INERTIA}
    for name, parts in (("none", {}), ("inertia", inertia), ("all", MODEL)):
        loop, joint = pure_loop(**PID, **parts), joint_of()
        drive(loop, joint, 10)
        loop.follow(motion())
        worst[name] = max(abs(loop.error) for _ in range(1200) if drive(loop, joint, 1))
    assert worst["all"] < 0.02 * worst["none"]
    assert worst["all"] < 0.1 * worst["inertia"] < worst["none"]


def test_planned_efforts_are_given_linearly_between_the_points():
    loop = pure_loop(law="pid", takeover_time=0.0)
    loop.follow(held(1.0, 3.0, -2.0, begin=50 * MS))
    efforts = at_rest(loop, 0, 400)
    for k, effort in {1: 1.0, 50: 1.0, 100: 2.0, 150: 3.0, 190: 1.0, 250: -2.0, 399: -2.0}.items():
        assert efforts[k] == pytest.approx(effort)
        assert loop.feedforward.effort == -2.0


def test_a_planned_weight_takes_the_place_of_the_integral_that_held_it():
    loop, joint = pure_loop(**PID), joint_of(load=-8.0)
    loop.follow(Setpoint(0.0))
    before = drive(loop, joint, 3000)[-1]
    assert loop.law.integral == pytest.approx(before, abs=1e-3)
    loop.follow(held(8.0, 8.0))
    efforts = drive(loop, joint, 300)
    assert efforts == pytest.approx([before] * 300, abs=1e-3)
    assert (loop.feedforward.effort, loop.law.integral) == (
        8.0,
        pytest.approx(before - 8.0, abs=1e-3),
    )
    loop.follow(held(None, None))
    assert drive(loop, joint, 300) == pytest.approx(efforts, abs=1e-3)
    assert loop.feedforward.effort == 0.0


@pytest.mark.parametrize(
    ("values", "rest", "integral"),
    [
        ({"gains__p": 10.0}, 4.0, 0.0),
        ({**PID, "i_clamp_min": -1.0, "i_clamp_max": 1.0}, 3.0, -1.0),
    ],
)
def test_what_no_integral_may_give_up_fades_in(values, rest, integral):
    loop = pure_loop(**{"law": "pid", "takeover_time": 0.2, **values})
    efforts = at_rest(loop, 0, 10)
    loop.follow(held(4.0, 4.0))
    efforts += at_rest(loop, 10, 400)
    assert max(abs(b - a) for a, b in pairwise(efforts)) <= rest / 200 + 1e-6
    assert efforts[-1] == pytest.approx(rest)
    assert loop.law.integral == integral


@pytest.mark.parametrize(
    ("values", "integral"),
    [
        ({"gains__p": 10.0}, 0.0),
        ({**PID, "gains__i": 0.0}, 0.0),
        ({**PID, "i_clamp_min": -1.0, "i_clamp_max": 1.0}, 1.0),
    ],
)
def test_what_no_integral_may_give_after_a_takeover_fades(values, integral):
    loop = pure_loop(Setpoint(0.0), **{"law": "pid", "takeover_time": 0.2, **values})
    at_rest(loop, 0, 10)
    loop.supersede(5.0)
    efforts = at_rest(loop, 10, 400)
    assert efforts[0] == pytest.approx(5.0)
    assert max(abs(b - a) for a, b in pairwise(efforts)) <= (5.0 - integral) / 200 + 1e-6
    assert efforts[-1] == pytest.approx(integral) == loop.law.integral


def test_the_terms_of_the_last_sample_stay_and_it_is_not_counted_again_where_parameters_are_set():
    loop = pure_loop(Setpoint(0.0), **PID, velocity_max=1.0)
    loop.step(0, 0.0, 0.0)
    loop.step(MS, 0.01, 2.0)
    terms, counts = loop.law.terms, (loop.law.braked, loop.counts.saturated)
    assert terms.p
    assert counts[0] == 1
    loop.retune(loop.settings.with_parameters({"gains.p": 100.0}))
    assert (loop.law.terms, (loop.law.braked, loop.counts.saturated)) == (terms, counts)


MOTIONS = {
    "setpoint": lambda efforts: Setpoint(0.0),
    "weight": lambda efforts: held(*efforts),
    "some": lambda efforts: held(*efforts, None),
    "later": lambda efforts: held(*efforts, begin=70 * MS),
}
CHANGES = {
    "feedforward.inertia": st.floats(0.0, 3.0),
    "feedforward.coulomb_friction": st.floats(0.0, 3.0),
    "feedforward.trajectory_effort": st.booleans(),
    "gains.i": st.sampled_from([0.0, 100.0]),
}


@given(
    st.lists(
        st.tuples(
            st.sampled_from([*MOTIONS, *CHANGES, "gap"]),
            st.lists(st.floats(-5.0, 5.0), min_size=2, max_size=4),
            st.data(),
        ),
        min_size=1,
        max_size=8,
    )
)
def test_where_nothing_moves_the_effort_moves_no_faster_than_its_plan(steps):
    """The reference rests and the joint is on it: no change is a jump."""
    loop = pure_loop(law="pid", gains__p=50.0, gains__i=100.0, gains__d=5.0, takeover_time=0.2)
    stamp_ns, efforts = 0, []

    def go(samples):
        nonlocal stamp_ns
        for _ in range(samples):
            stamp_ns += MS
            efforts.append(loop.step(stamp_ns, 0.0, 0.0))

    go(5)
    for what, planned, data in steps:
        if what == "gap":
            stamp_ns += 500 * MS
        elif what in MOTIONS:
            loop.follow(MOTIONS[what](planned))
        else:
            change = {what: data.draw(CHANGES[what])}
            loop.retune(loop.settings.with_parameters(change))
        go(60)
    # 10 N m in 0.1 s as planned, and what is kept of some jumps of 10 N m fades in 0.2 s.
    assert max(abs(b - a) for a, b in pairwise(efforts)) <= 0.1 + 0.05 * len(steps) + 0.05 + 1e-6


def test_a_single_stamp_from_the_future_leaves_nothing_behind():
    loop, twin = pure_loop(**PID, **MODEL), pure_loop(**PID, **MODEL)
    for each in (loop, twin):
        each.follow(motion(1.0, 3.0))
        for k in range(500):
            each.step(k * MS, 1e-3 * k, 1.0)
    loop.step(60 * SECOND, 0.5, 1.0)
    for k in range(500, 800):
        assert loop.step(k * MS, 1e-3 * k, 1.0) == twin.step(k * MS, 1e-3 * k, 1.0)


@pytest.mark.parametrize(
    ("efforts", "values", "model", "expected"),
    [
        ((1.0, None), {}, None, 0.0),  # efforts of some points are none of the trajectory's
        ((4.0, 4.0), {"compensation": "gravity"}, ModelTerm(1.0, 3.0), 3.0),  # it has the weight
    ],
)
def test_planned_efforts_are_left_out(efforts, values, model, expected):
    loop = pure_loop(law="pid", takeover_time=0.0, **values)
    loop.follow(held(*efforts))
    assert set(at_rest(loop, 0, 100, model)) == {expected}


def test_what_is_described_is_taken():
    names = ("inertia", "viscous_friction", "coulomb_friction")
    known = {"inertia": 0.3, "gains__p": 1.0, "gains__i": 0.1, "gains__d": 1.0, "law": "pid"}
    asked = loop_settings(**known, **{f"feedforward__{name}": -1.0 for name in names})
    described = replace(UNLIMITED, damping=0.25, friction=0.75).within(asked).feedforward
    assert (described.viscous_friction, described.coulomb_friction) == (0.25, 0.75)
    loop = pure_loop(**known, feedforward__inertia=-1.0)
    loop.follow(Column("elbow", (Knot(0, 0.0, 0.0, 2.0), Knot(SECOND, 1.0, 0.0, 0.0)), stamp_ns=1))
    at_rest(loop, 0, 9)  # it began 1 ns after the first state: taken up at the second, not at rest
    assert loop.feedforward.effort == pytest.approx(0.3 * 2.0, abs=0.12)


def test_a_relay_is_refused_where_a_planned_effort_leaves_it_no_room():
    request = RelayRequest(5.0, 0.05, 0.4, 3, 10.0)
    for planned, is_refused in ((8.0, True), (4.0, False)):
        limits = {"u_clamp_max": 10.0, "u_clamp_min": -10.0}
        loop = pure_loop(
            held(planned, planned), takeover_time=0.0, gains__p=5.0, gains__d=1.0, **limits
        )
        at_rest(loop, 0, 200)
        assert loop.law.effort == pytest.approx(planned)
        if is_refused:
            with pytest.raises(SettingError, match="not within the effort limits"):
                loop.begin_relay(request)
        else:
            loop.begin_relay(request)
