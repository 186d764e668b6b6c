"""A relay drives the joint within limits, begins and ends without a jump, and always ends."""

import math
import re
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from harness.loops import Joint, pure_loop

from hpid_bench.tuning.autotune import relay_cycle
from hpid_bench.tuning.identification.joint_record import JointRecord
from hpid_ros.base.errors import SettingError
from hpid_ros.control import Gains, JointLoop, LoopSettings, ModelTerm
from hpid_ros.control.overrides import CYCLES_DONE, LONGEST_RELAY, RelayRequest
from hpid_ros.control.reference import Setpoint

MS = 1_000_000
PERIOD = 0.002
INERTIA, VISCOUS, LOAD = 0.1, 0.3, 1.0
LEAD = 0.1
ASKED = RelayRequest(amplitude=2.0, hysteresis=0.08, deviation=0.4, cycles=6, duration=15.0)


class HeldJoint(Joint):
    """A loop on a joint with viscous friction and a load, at rest and held at first."""

    def __init__(self, law="pid", **changes):
        super().__init__(INERTIA, -LOAD, viscous=VISCOUS)
        gains = {"gains.p": 40.0, "gains.i": 133.0, "gains.d": 4.0, "law": law}
        limits = {"u_clamp_max": 15.0, "u_clamp_min": -15.0}
        values = {"joint": "elbow", "control_period": PERIOD, **gains, **limits, **changes}
        self.loop = JointLoop(LoopSettings.from_parameters(values))
        self.rows = []
        self.run(2.5)
        self.rows.clear()

    def step(self):
        now = self.stamp_ns * 1e-9, self.position, self.velocity
        effort = self.loop.step(self.stamp_ns, self.position, self.velocity)
        self.rows.append((*now, effort))
        self.push(effort, PERIOD)
        return effort

    def run(self, duration):
        for _ in range(round(duration / PERIOD)):
            self.step()

    def begin(self, **changes):
        self.loop.begin_relay(replace(ASKED, **changes))

    def until_over(self, within=LONGEST_RELAY):
        begun_ns = self.stamp_ns
        while not self.loop.relay.is_over:
            self.step()
            assert (self.stamp_ns - begun_ns) * 1e-9 <= within
        return np.array(self.rows).T


@pytest.mark.parametrize(("law", "mu"), [("pid", 0.0), ("hpid", -0.1)])
def test_a_relay_makes_a_limit_cycle_begins_and_ends_without_a_jump_and_the_joint_is_held(law, mu):
    joint = HeldJoint(law, mu=mu)
    joint.run(0.1)
    joint.begin()
    _, position, _, effort = joint.until_over()
    assert joint.loop.relay.ending == CYCLES_DONE
    assert joint.loop.relay.cycles == ASKED.cycles
    assert np.ptp(position) > 0.05
    assert np.sum(np.abs(np.diff(effort)) > 3.0) >= 2 * ASKED.cycles
    joint.run(0.1)
    steps = np.abs(np.diff([row[3] for row in joint.rows]))
    assert steps.max() <= 2.0 * ASKED.amplitude * 1.05  # and what the law itself moves
    near = round(0.02 / PERIOD)
    assert steps[50 - 2 : 50 + near].max() < 0.1 * ASKED.amplitude
    assert steps[-50 - near :].max() < 0.2 * ASKED.amplitude
    joint.run(2.0)
    assert joint.position == pytest.approx(0.0, abs=1e-3)
    assert joint.loop.law.effort == pytest.approx(LOAD, abs=0.02)


def test_limits_hold_while_a_relay_is_active():
    joint = HeldJoint(u_clamp_max=3.5, u_clamp_min=-3.5, velocity_max=0.6, position_max=0.2)
    joint.begin()
    _, position, velocity, effort = joint.until_over()
    assert np.abs(effort).max() <= 3.5
    assert np.abs(velocity).max() < 0.6 + 2.0 * 3.0 / 4.0  # load over soft_stop.k_velocity
    assert position.max() < 0.25


@pytest.mark.parametrize(
    ("act", "reason", "is_at_once"),
    [
        (lambda loop: loop.follow(Setpoint(0.0)), "a reference came", False),
        (lambda loop: loop.retune(loop.settings), "parameters were set", False),
        (lambda loop: loop.end_relay("enough"), "enough", False),
        (lambda loop: loop.step(10**12, math.nan), "could not be used", True),
        (lambda loop: loop.note_timeout(), "no state came", True),
        (lambda loop: loop.note_unanswered(), "no state came", True),
        (lambda loop: loop.supersede(0.0), "another effort", True),
        (lambda loop: loop.reset(), "began again", True),
        (lambda loop: loop.release(), "began again", True),
    ],
)
def test_whatever_comes_in_between_ends_a_relay(act, reason, is_at_once):
    joint = HeldJoint()
    joint.begin()
    joint.run(0.7)
    act(joint.loop)
    assert reason in joint.loop.relay.ending
    if is_at_once:
        assert joint.loop.relay.is_over
        with pytest.raises(SettingError):
            joint.begin()
    else:  # it gives back gradually
        before = joint.loop.law.effort
        assert abs(joint.step() - before) <= 2.0 * ASKED.amplitude * 1.05
        joint.until_over(within=0.5)


def test_a_gap_ends_a_relay_and_the_takeover_has_no_jump():
    joint = HeldJoint()
    joint.begin()
    joint.run(0.7)
    before = joint.loop.law.effort
    joint.stamp_ns += 500_000_000
    joint.velocity = 0.0
    assert joint.step() == before
    joint.velocity = 0.0
    assert joint.step() == pytest.approx(before, abs=0.05)
    assert joint.loop.relay.ending == "the joint was taken over again"
    joint.run(3.0)
    assert joint.velocity == pytest.approx(0.0, abs=1e-2)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"deviation": 0.2, "amplitude": 0.2}, "the error of .* is above 0.2 rad"),
        ({"duration": 1.0}, "it has taken 1 s"),
    ],
)
def test_a_relay_that_goes_too_far_or_too_long_gives_the_joint_back(changes, reason):
    joint = HeldJoint()
    joint.begin(**changes)
    joint.run(0.6)
    joint.velocity += 1.5  # a push
    joint.until_over(within=3.0)
    assert re.search(reason, joint.loop.relay.ending)
    joint.run(3.0)
    assert joint.position == pytest.approx(0.0, abs=0.01)


def test_a_relay_that_does_not_move_the_joint_ends():
    joint = HeldJoint()
    joint.begin()
    while not joint.loop.relay.is_over:
        joint.step()
        joint.position = joint.velocity = 0.0  # as by friction
    assert joint.loop.relay.ending == "it did not move the joint within 5 s"
    assert joint.stamp_ns * 1e-9 < 2.5 + 7.0


def test_a_relay_is_refused_where_it_cannot_be_safe():
    joint = HeldJoint()
    with pytest.raises(SettingError, match="not within the effort limits, -15 and 15 N m"):
        joint.begin(amplitude=14.5)
    joint.begin()
    with pytest.raises(SettingError, match="there is one already"):
        joint.begin()
    with pytest.raises(SettingError, match="waiting for the first state"):
        JointLoop(joint.loop.settings).begin_relay(ASKED)
    moving = HeldJoint()
    moving.velocity = 2.0
    moving.step()
    with pytest.raises(SettingError, match="the joint moves at 2 rad/s"):
        moving.begin()
    moving.loop.supersede(0.0)
    with pytest.raises(SettingError, match="the joint is to be taken over first"):
        moving.begin()
    with pytest.raises(SettingError, match="no relay now"):
        HeldJoint(**{"gains.d": 0.0, "gains.i": 0.0, "gains.p": 5.0}).begin()


@pytest.mark.parametrize(("inertia", "is_refused"), [(10.0, True), (0.5, False)])
def test_under_decoupling_the_damping_effort_decides_whether_a_joint_moves_too_fast(
    inertia, is_refused
):
    loop = pure_loop(
        **{"gains": Gains(40.0, 0.0, 4.0), "law": "pid", "compensation": "decoupling"},
        **{"u_clamp_max": 50.0, "u_clamp_min": -50.0},
    )
    for k in range(2):
        loop.step(k * MS, 0.0, 0.1, ModelTerm(inertia, 0.0, True))
    with pytest.raises(SettingError, match=r"moves at 0.1 rad/s") if is_refused else nullcontext():
        loop.begin_relay(ASKED)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("amplitude", math.nan),
        ("amplitude", -1.0),
        ("hysteresis", math.inf),
        ("cycles", 1e6),
        ("duration", 31.0),
        ("deviation", 0.0),
    ],
)
def test_what_is_no_relay_is_refused(name, value):
    with pytest.raises(SettingError):
        replace(ASKED, **{name: value})


def test_without_a_relay_every_effort_is_the_law_s_to_the_bit():
    plain, after = HeldJoint(), HeldJoint()
    after.begin()
    after.loop.end_relay("at once")
    after.run(0.1)
    plain.run(0.1)
    assert [row[3] for row in after.rows] == [row[3] for row in plain.rows]


@pytest.mark.parametrize("amplitude", [1.0, 2.0, 4.0])
def test_a_limit_cycle_tells_the_inertia(amplitude):
    joint = HeldJoint()
    joint.begin(amplitude=amplitude)
    time, position, _, effort = joint.until_over()
    record = JointRecord("elbow", time, position, time, effort)
    cycle = relay_cycle(record, amplitude, 0.08, LEAD)
    assert cycle.cycles >= ASKED.cycles - 2
    assert cycle.spread < 0.03
    assert cycle.inertia == pytest.approx(INERTIA, rel=0.05)
    assert cycle.described_inertia == pytest.approx(INERTIA, rel=0.25)
    with pytest.raises(SettingError, match="no limit cycle"):
        relay_cycle(record, 9.0, 0.08, LEAD)
