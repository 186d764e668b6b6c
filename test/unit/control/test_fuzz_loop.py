"""Anything at all into the pure loop: no error, no effort beyond the limits, and back to work."""

import contextlib
import math

import pytest
from harness.examples import examples
from harness.fuzzing import NUMBERS, StateFuzzer
from harness.loops import loop_settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from hpid_ros.base.errors import HpidError, MessageError
from hpid_ros.control import LOOP_PARAMETERS, Gains, JointLoop, LoopSettings
from hpid_ros.control.laws import LAWS
from hpid_ros.control.loop_state import LoopMode
from hpid_ros.control.overrides import RelayRequest
from hpid_ros.control.reference import Setpoint
from hpid_ros.messages.joint_state import JointReader
from hpid_ros.motion import Column, Knot

pytestmark = pytest.mark.slow

MS = 1_000_000
ROUNDS, MESSAGES = 5, 5000
SOURCES = LOOP_PARAMETERS["velocity_source"].choices


def settings(**changes):
    values = {
        **{"joint": "elbow", "gains": Gains(120.0, 200.0, 22.0), "law": "hpid", "mu": -0.2},
        **{"u_clamp_max": 40.0, "u_clamp_min": -30.0, "position_max": 2.0, "position_min": -2.0},
        "velocity_max": 8.0,
    }
    return loop_settings(**{**values, **changes})


def goes_to(loop, target, stamp_ns):
    """Return whether the loop still brings a joint of 1 kg m^2 to a setpoint."""
    loop.follow(Setpoint(target))
    position, velocity, stayed = 0.2, 0.0, 0
    for k in range(6000):
        effort = loop.step(stamp_ns + k * MS, position, velocity)
        velocity += 1e-3 * effort
        position += 1e-3 * velocity
        stayed = stayed + 1 if abs(position - target) < 1e-3 else 0
        if stayed == 500:
            break
    return loop.state.mode is LoopMode.FOLLOWING and abs(position - target) < 2e-3


def test_a_hundred_thousand_messages_and_the_joint_still_goes_where_it_should(faults):
    """The same messages for a loop of each velocity source, and of each law."""
    loops = [JointLoop(settings(velocity_source=source, inertia=1.0)) for source in SOURCES]
    loops += [JointLoop(settings(law=law, inertia=1.0)) for law in LAWS if law != "hpid"]
    reader = JointReader("elbow")
    fuzzer = StateFuzzer("elbow", seed=1)
    seen = refused = 0
    for _ in range(ROUNDS):
        for raw in fuzzer.messages(MESSAGES):
            seen += 1
            try:
                sample = reader.read(raw)
            except MessageError:
                refused += 1
                continue
            for loop in loops if sample is not None else ():
                assert -30.0 <= loop.step(*sample) <= 40.0
                assert math.isfinite(loop.law.integral)
        # By whatever stamps a loop has been sent to the end of time: the clock goes back.
        assert all(goes_to(loop, 0.7, fuzzer.stamp_ns) for loop in loops)
    assert 0.1 * seen < refused < 0.9 * seen
    faults.count("messages fuzzed: pure loop", len(loops) * seen)


class AnyOrder(RuleBasedStateMachine):
    """Everything that can happen to a loop, in any order."""

    def __init__(self):
        super().__init__()
        self.loop = JointLoop(settings())
        self.stamp_ns = 0

    @rule(periods=st.integers(1, 3), position=st.floats(-3.0, 3.0), velocity=st.floats(-9.0, 9.0))
    def state(self, periods, position, velocity):
        self.stamp_ns += periods * MS
        before, reference = self.loop.law.effort, self.loop.following.reference
        effort = self.loop.step(self.stamp_ns, position, velocity)
        assert math.isfinite(before + effort + sum(reference))

    @rule(number=st.sampled_from(NUMBERS), is_velocity=st.booleans())
    def number(self, number, is_velocity):
        self.stamp_ns += MS
        self.loop.step(self.stamp_ns, *((0.1, number) if is_velocity else (number, None)))

    @rule(stamp_ns=st.integers(-(2**31) * 10**9, 2**31 * 10**9))
    def stamp(self, stamp_ns):
        self.loop.step(stamp_ns, 0.1)

    @rule()
    def repeat(self):
        if self.loop.state.stamp_ns is not None:
            before = self.loop.law.effort
            assert self.loop.step(self.loop.state.stamp_ns, math.nan) == before

    @rule(gap=st.floats(0.0, 1.0))
    def silence(self, gap):
        assert self.loop.note_timeout() == 0.0
        self.stamp_ns += int(gap * 1e9)

    @rule(position=st.floats(-4.0, 4.0), stamp=st.integers(0, 4), first=st.integers(0, 9))
    def follow(self, position, stamp, first):
        knots = (Knot(first * 10**8, position, 0.0), Knot(10**9, -position, 0.0))
        self.loop.follow(Column("elbow", knots, stamp * 10**9))

    @rule(position=st.floats())
    def setpoint(self, position):
        with contextlib.suppress(HpidError):
            self.loop.follow(Setpoint(position))

    @rule(
        mu=st.floats(-0.6, 0.6),
        p=st.floats(-10.0, 200.0),
        rate=st.sampled_from([0.0, 100.0]),
        stop=st.sampled_from([2.0, 0.5, 1e6]),
    )
    def retune(self, mu, p, rate, stop):
        before = self.loop.settings
        try:
            changed = settings(
                mu=mu, gains=Gains(p, 10.0, 5.0), effort_rate_max=rate, position_max=stop
            )
        except HpidError:
            assert self.loop.settings is before
        else:
            self.loop.retune(changed)

    @rule(
        numbers=st.just([5.0, 0.1, 1.0, 5.0, 20.0])
        | st.lists(st.sampled_from([*NUMBERS, 0.1, 2.0, 5.0]), min_size=5, max_size=5)
    )
    def relay(self, numbers):
        before = self.loop.law.effort
        with contextlib.suppress(HpidError):
            self.loop.begin_relay(RelayRequest(*numbers))
        assert self.loop.law.effort == before

    @rule()
    def release(self):
        self.loop.release()

    @invariant()
    def is_within_limits(self):
        assert -30.0 <= self.loop.law.effort <= 40.0
        numbers = (
            self.loop.law.integral,
            self.loop.estimation.velocity,
            *self.loop.following.reference,
        )
        assert all(map(math.isfinite, numbers))

    def teardown(self):
        """Whatever has been, it goes on."""
        self.loop.retune(settings())
        start_ns = (self.loop.state.stamp_ns or 0) - 10**9
        if start_ns > -(2**31) * 10**9:
            assert goes_to(self.loop, 0.7, start_ns)


AnyOrder.TestCase.settings = examples(0.6, stateful_step_count=40)
TestAnyOrder = AnyOrder.TestCase


FASTEST, HARDEST = 1.0, 10.0  # [rad/s, rad/s^2], of the joint and of what it follows
FALLBACK = 0.5
FRICTION_VELOCITY = 0.05  # [rad/s]
LAW = {
    **{"joint": "elbow", "law": "pid", "gains.p": 100.0, "gains.i": 50.0, "gains.d": 5.0},
    **{"encoder_wrap": math.tau, "velocity_max": 20.0, "fallback_effort": FALLBACK},
    "feedforward.friction_velocity": FRICTION_VELOCITY,
}
BESIDE_THE_LAW = {
    "velocity_source": st.sampled_from(SOURCES),
    "velocity_filter_time_constant": st.floats(0.001, 0.02),
    "acceleration_bound": st.floats(20.0, 200.0),
    "state_timeout": st.floats(0.02, 0.3),
    "takeover_time": st.floats(0.3, 1.0),
    "position_step_max": st.floats(0.0, 0.5),
    "velocity_max": st.floats(5.0, 50.0),
    "tracking_time_constant": st.floats(0.0, 1.0),
    "feedforward.viscous_friction": st.floats(0.0, 2.0),
    "feedforward.coulomb_friction": st.floats(0.0, 1.0),
    "feedforward.trajectory_effort": st.booleans(),
}


class NothingKicks(RuleBasedStateMachine):
    """A joint that moves smoothly is driven smoothly, whatever its driver and its user do.

    Between two samples the effort moves by what error and rate do, and by what the last sample
    integrated; by more only to and from ``fallback_effort``, and at a takeover by the derivative
    term. An estimate of the velocity that begins anew comes in with its filter; at once, where
    another source takes its place.
    """

    def __init__(self):
        super().__init__()
        self.values = dict(LAW)
        self.loop = JointLoop(LoopSettings.from_parameters(self.values))
        self.stamp_ns = 10**9
        self.position = self.velocity = 0.0
        self.active = 0.0  # [N m] what the joint has
        self.taken_over_ns = self.answered_ns = self.stamp_ns
        self.integrated = 0.0  # [N m] by the last sample, for the next: a lot after a freeze
        self.sampled = 0.0  # [rad] what the last sample said
        self.astray_ns = 0  # when a state was wrong; two in a row are another source

    def _move(self, seconds, acceleration=0.0):
        self.velocity = min(max(self.velocity + acceleration * seconds, -FASTEST), FASTEST)
        self.position += self.velocity * seconds
        self.stamp_ns += round(seconds * 1e9)

    def _wrapped(self):
        return (self.position + math.pi) % math.tau - math.pi

    def _sample(self, is_back=False, has_jumped=False):
        takeovers, samples = self.loop.counts.takeovers, self.loop.counts.samples
        before = self.loop.following.reference
        rate_before = abs(before[1] - self.loop.estimation.velocity)
        self.sampled = self._wrapped()
        effort = self.loop.step(self.stamp_ns, self.sampled, self.velocity)
        assert self.loop.counts.samples == samples + 1
        rate = abs(self.loop.following.velocity - self.loop.estimation.velocity)
        if has_jumped:  # in control until now: the derivative term was there before
            rate += rate_before
        if self.loop.counts.takeovers > takeovers:
            assert abs(effort - self.active) <= 5.0 * rate + 1e-6
            self.taken_over_ns = self.answered_ns = self.stamp_ns
        elif not is_back:
            is_new = self.stamp_ns - self.taken_over_ns < 200 * MS
            moved = [
                abs(a - b) for a, b in zip(self.loop.following.reference, before, strict=True)
            ]
            ahead = self.values.get("feedforward.viscous_friction", 0.0)
            ahead += self.values.get("feedforward.coulomb_friction", 0.0) / FRICTION_VELOCITY
            allowed = 0.5 + self.integrated + 100.0 * moved[0] + (5.0 + ahead) * moved[1]
            if is_new:
                allowed += 5.0 * abs(self.velocity)
            assert abs(effort - self.active) <= allowed
        seconds = (self.stamp_ns - self.answered_ns) * 1e-9
        self.integrated = LAW["gains.i"] / LAW["gains.p"] * abs(self.loop.law.terms.p) * seconds
        self.active, self.answered_ns = effort, self.stamp_ns

    @rule(samples=st.integers(1, 60), acceleration=st.floats(-HARDEST, HARDEST))
    def samples(self, samples, acceleration):
        for _ in range(samples):
            self._move(1e-3, acceleration)
            self._sample()

    @rule(
        seconds=st.floats(0.0, 1.0),
        noticed=st.sampled_from(("never", "at its end", "in time")),
        counts=st.booleans(),
    )
    def freeze(self, seconds, noticed, counts):
        stamp_ns = self.stamp_ns
        self._move(seconds)
        if noticed == "in time":
            self.active = self.loop.note_timeout()
            assert self.active == FALLBACK
        elif noticed == "at its end":
            self.loop.note_unanswered()
        if noticed != "never" and counts:  # stamps that count samples do not show
            self.stamp_ns = stamp_ns
        self.stamp_ns += MS
        timeout_ns = self.values.get("state_timeout", 0.1) * 1e9
        if (
            self.loop.state.stamp_ns is not None
            and self.stamp_ns - self.loop.state.stamp_ns > timeout_ns
        ):
            assert self.loop.step(self.stamp_ns, self._wrapped(), 0.0) == self.active  # at first
            self._move(1e-3)
        # Within the timeout the loop goes on, and its reference has moved meanwhile.
        self._sample(is_back=seconds < self.values.get("state_timeout", 0.1))

    @rule(times=st.integers(1, 400))
    def unusable(self, times):
        for _ in range(times):
            self._move(1e-3)
            self.active = self.loop.step(self.stamp_ns, math.nan)
            assert self.active == FALLBACK
        self._move(1e-3)
        self._sample(is_back=True)

    @rule(has_timed_out=st.booleans())
    def repeat(self, has_timed_out):
        if self.loop.state.stamp_ns is not None:
            if has_timed_out:
                self.active = self.loop.note_timeout()
                assert self.active == FALLBACK
            assert self.loop.step(self.loop.state.stamp_ns, self.sampled, 0.0) == self.active

    @precondition(lambda self: self.stamp_ns > self.astray_ns + 10**9)
    @rule(jump=st.floats(1.0, 2.0) | st.floats(-2.0, -1.0), is_for_good=st.booleans())
    def jump(self, jump, is_for_good):
        """A glitch; or the encoder was set to another zero, say."""
        self.astray_ns = self.stamp_ns
        self.position += jump
        self._move(1e-3)
        is_checked = self.loop.state.stamp_ns is not None and not self.loop.is_on_fallback
        if is_checked:
            effort = self.loop.step(self.stamp_ns, self._wrapped(), self.velocity)
            assert effort == self.active
            self._move(1e-3)
        if not is_for_good:
            self.position -= jump
        self._sample(has_jumped=is_checked and is_for_good)

    @rule(
        distance=st.floats(-1.0, 1.0),
        efforts=st.none() | st.tuples(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0)),
    )
    def follow_smoothly(self, distance, efforts):
        """From where the reference stands, with no more than one rad/s, planned efforts or not."""
        first, last = efforts or (None, None)
        start_ns = self.stamp_ns + 500 * MS
        here = self.loop.following.position
        end = Knot(4 * 10**9, here + distance, 0.0, 0.0, last)
        self.loop.follow(Column("elbow", (Knot(0, here, 0.0, 0.0, first), end), start_ns))

    @rule(data=st.data(), name=st.sampled_from(sorted(BESIDE_THE_LAW)))
    def retune(self, data, name):
        self.values[name] = data.draw(BESIDE_THE_LAW[name])
        self.loop.retune(LoopSettings.from_parameters(self.values))


NothingKicks.TestCase.settings = examples(0.6, stateful_step_count=30)
TestNothingKicks = NothingKicks.TestCase
