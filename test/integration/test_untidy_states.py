"""States as robots send them: in any order, of some joints, twice, at any rate, without time."""

import math
import random

import pytest
from harness.loops import pure_loop

from hpid_ros.control.reference import Setpoint
from hpid_ros.messages.joint_state import JointReader, JointStateTemplate

MS = 1_000_000
NAMES = ("wrist_3", "base", "elbow", "wrist_1", "shoulder", "wrist_2", "wheel")


def loops(**parameters):
    made = {
        name: pure_loop(
            joint=name,
            law="hpid",
            mu=-0.1,
            gains__p=100.0,
            gains__i=200.0,
            gains__d=20.0,
            **({"encoder_wrap": math.tau} if name == "wheel" else {}),
            **parameters,
        )
        for name in NAMES
    }
    for loop in made.values():
        loop.follow(Setpoint(0.5))
    return made


def answers(loops, messages):
    """Return the efforts that each joint's controller gives, by its own reader."""
    readers = {name: JointReader(name) for name in loops}
    efforts = {name: [] for name in loops}
    for raw in messages:
        for name, loop in loops.items():
            sample = readers[name].read(raw)
            if sample is not None:
                efforts[name].append((sample.stamp_ns, loop.step(*sample)))
    return efforts


def message(stamp_ns, places, order):
    template = JointStateTemplate(order, position=True)
    return template.encode(stamp_ns, position=[places[name] for name in order])


def path(count, period_ns):
    for k in range(1, count):
        places = {name: 0.1 * math.sin(0.01 * k + at) for at, name in enumerate(NAMES)}
        places["wheel"] = math.remainder(3.0 + 0.002 * k, math.tau)  # through pi
        yield k * period_ns, places


@pytest.mark.parametrize("seed", range(3))
def test_order_company_and_repeats_change_no_effort(seed):
    draw, tidy, untidy = random.Random(seed), [], []
    for stamp_ns, places in path(400, 2 * MS):
        tidy.append(message(stamp_ns, places, NAMES))
        order = draw.sample(NAMES, len(NAMES))
        cut = draw.randint(0, len(NAMES))
        parts = [part for part in (order[:cut], order[cut:]) if part]  # one message, or two
        untidy += [message(stamp_ns, places, part) for part in parts]
        if draw.random() < 0.1:
            untidy.append(untidy[-1])
        if draw.random() < 0.1:
            untidy.append(message(stamp_ns, {"of another robot": 1.0}, ["of another robot"]))
    wanted, made = answers(loops(), tidy), answers(loops(), untidy)
    for name in NAMES:
        assert list(dict(made[name]).items()) == wanted[name]
        assert all(dict(wanted[name])[stamp_ns] == effort for stamp_ns, effort in made[name])


def test_a_joint_that_messages_leave_out_misses_them_and_no_more():
    draw, every, some = random.Random(5), [], []
    for stamp_ns, places in path(400, 2 * MS):
        left_out = NAMES[2] if draw.random() < 0.3 else ""
        some.append(message(stamp_ns, places, [name for name in NAMES if name != left_out]))
        every.append(message(stamp_ns, places, NAMES))
    tried, twins = loops(), loops()
    made, wanted = answers(tried, some), answers(twins, every)
    for name in NAMES:
        assert (made[name] == wanted[name]) == (name != NAMES[2])
    assert tried[NAMES[2]].counts.gaps == tried[NAMES[2]].counts.takeovers == 0
    assert len(made[NAMES[2]]) < len(wanted[NAMES[2]])


@pytest.mark.parametrize("period_ns", [MS // 4, 2 * MS, 10 * MS, 50 * MS])
def test_any_rate_holds_a_joint(period_ns):
    loop = pure_loop(
        law="pid",
        gains__p=30.0,
        gains__i=20.0,
        gains__d=8.0,
        control_period=period_ns * 1e-9,
        inertia=1.0,
    )
    loop.follow(Setpoint(0.5))
    reader, template = JointReader("elbow"), JointStateTemplate(["elbow"], position=True)
    position = velocity = 0.0
    for k in range(1, 10_000 * MS // period_ns):
        sample = reader.read(template.encode(k * period_ns, position=[position]))
        effort = loop.step(*sample)
        velocity += effort * period_ns * 1e-9
        position += velocity * period_ns * 1e-9
    assert position == pytest.approx(0.5, abs=0.01)
    assert loop.counts.gaps == 0


def test_states_without_stamps_get_one_effort_and_are_counted_as_repeats():
    """Time stands still for the loop; that it is silence the watchdog tells."""
    tried = loops()["elbow"]
    efforts = {tried.step(0, 0.1 * math.sin(k), None) for k in range(100)}
    assert len(efforts) == 1
    assert tried.counts.repeats == 99
