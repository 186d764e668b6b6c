"""A recording computed anew agrees exactly where the law was the law."""

import random
import struct

import pytest
from harness.loops import pure_loop
from hypothesis import given
from hypothesis import strategies as st

from hpid_bench.tuning.recorded_loops import controllers_of
from hpid_bench.tuning.replay import (
    Instruction,
    RecordedCommand,
    RecordedLoop,
    RecordedState,
    driven,
    following,
    replay_joint,
)
from hpid_ros.base.errors import SettingError
from hpid_ros.control import JointLoop
from hpid_ros.control.overrides import RelayRequest
from hpid_ros.control.reference import Setpoint
from hpid_ros.motion import Column, Knot

MS = 1_000_000
SETTINGS = pure_loop(
    joint="elbow",
    law="hpid",
    mu=-0.3,
    **{"gains.p": 300.0, "gains.i": 1000.0, "gains.d": 30.0, "norm.effort_scale": 3.0},
    velocity_source="measured",
    state_timeout=0.1,
).settings


def answer(stamp_ns, position, velocity):
    return lambda loop: loop.step(stamp_ns, position, velocity)


def change(**values):
    """Return what makes other settings, with dots for double underscores."""
    named = {key.replace("__", "."): value for key, value in values.items()}
    return lambda loop: loop.retune(loop.settings.with_parameters(named))


class Recorder:
    """Plays a controller and a recorder that hears some things earlier or later than it."""

    def __init__(self, seed=0):
        self.random = random.Random(seed)
        self.loop = JointLoop(SETTINGS)
        self.states, self.commands, self.instructions = [], [], []
        self.stamp_ns, self.place = 0, 0

    def state(self, is_heard=True, is_recorded=True, is_answer_recorded=True, later_ns=MS):
        """Publish one state, a period later."""
        self.stamp_ns += later_ns
        self.place += 1000
        noise = self.random.gauss
        sample = self.stamp_ns, 0.1 + noise(0.0, 1e-3), noise(0.0, 0.1)
        if is_recorded:
            self.states.append(
                RecordedState(self.stamp_ns, self.place, self.stamp_ns, answer(*sample))
            )
        if is_heard:
            effort = self.loop.step(*sample)
            if is_answer_recorded:
                self.command(self.stamp_ns, effort)

    def command(self, stamp_ns, effort, sender="/elbow_controller"):
        self.commands.append(RecordedCommand(self.place + 1, stamp_ns, effort, sender))

    def tell(self, what, text, states_apart=0):
        """Tell the controller something; the recorder hears it so many states later."""
        place = self.place + 1000 * states_apart + 500
        self.instructions.append(Instruction(place, what, text))
        what(self.loop)

    def replay(self):
        instructions = sorted(self.instructions, key=lambda each: each.place)
        return replay_joint(
            RecordedLoop(
                SETTINGS, self.states, self.commands, instructions, self.states[0].stamp_ns
            )
        )


def recorded(count=200, seed=0, **options):
    recorder = Recorder(seed)
    recorder.tell(following(Column("elbow", (Knot(0, 0.1), Knot(100 * MS, 0.5)))), "a trajectory")
    for _ in range(count):
        recorder.state(**options)
    return recorder


def flipped(number, bit):
    """Return a number with one of its 64 bits changed."""
    (bits,) = struct.unpack("<Q", struct.pack("<d", number))
    return struct.unpack("<d", struct.pack("<Q", bits ^ (1 << bit)))[0]


@given(st.integers(0, 199), st.integers(0, 63))
def test_one_changed_bit_of_one_command_is_found_where_it_is(at, bit):
    recorder = recorded()
    before = recorder.commands[at]
    recorder.commands[at] = before._replace(effort=flipped(before.effort, bit))
    verdict = recorder.replay()
    assert not verdict.is_the_law
    assert (verdict.equal, verdict.different) == (199, 1)
    (difference,) = verdict.differences
    assert (difference.stamp_ns, difference.computed) == (before.stamp_ns, before.effort)
    assert difference.time == pytest.approx(at * 1e-3)


def test_what_the_law_did_is_the_law_from_when_the_controller_listens():
    recorder = recorded(10, is_heard=False)
    for _ in range(20):
        recorder.state()
    verdict = recorder.replay()
    assert verdict.is_the_law
    assert (verdict.equal, verdict.different, verdict.unanswered) == (20, 0, 0)


def test_nothing_that_could_be_computed_is_no_proof():
    assert not recorded(10, is_answer_recorded=False).replay().is_the_law
    command = RecordedCommand(0, MS, 1.0, "somebody")
    verdict = replay_joint(RecordedLoop(SETTINGS, [], [command], [], 0))
    assert (verdict.equal, verdict.different, verdict.outside) == (0, 0, 1)
    assert not verdict.is_the_law


def test_a_changed_state_is_seen_in_its_own_answer_and_all_after():
    recorder = recorded()
    stamp_ns = recorder.states[50].stamp_ns
    recorder.states[50] = recorder.states[50]._replace(answer=answer(stamp_ns, 0.2, 0.0))
    (difference,) = recorder.replay().differences
    assert difference.stamp_ns == stamp_ns
    assert difference.commands == 150


@given(
    st.integers(0, 2**32),
    st.lists(st.tuples(st.integers(5, 40), st.integers(-20, 20)), min_size=1, max_size=4),
)
def test_what_was_heard_earlier_or_later_than_recorded_is_found(seed, told):
    recorder = recorded(60, seed)
    whats = [
        ("mu = -0.1", change(mu=-0.1)),
        ("a setpoint", following(Setpoint(0.3))),
        ("gains.p = 250", change(gains__p=250.0)),
        ("a trajectory", following(Column("elbow", (Knot(0, 0.1), Knot(50 * MS, -0.2))))),
    ]
    for (text, what), (after, apart) in zip(whats, told, strict=False):
        recorder.tell(what, text, apart)
        for _ in range(after + 40):
            recorder.state()
    verdict = recorder.replay()
    assert verdict.is_the_law, verdict.differences


def test_a_change_that_was_not_recorded_is_not_the_law():
    recorder = recorded(100)
    change(mu=-0.1)(recorder.loop)
    for _ in range(100):
        recorder.state()
    verdict = recorder.replay()
    assert (verdict.equal, verdict.different) == (100, 100)


@pytest.mark.parametrize(
    ("lost", "unanswered", "without_state"),
    [
        ({"is_heard": False}, 2, 0),
        ({"is_answer_recorded": False}, 2, 0),
        ({"is_recorded": False}, 0, 2),
    ],
)
def test_losses_are_told_and_explained_where_they_can_be(lost, unanswered, without_state):
    recorder = recorded(50)
    for _ in range(2):
        recorder.state(**lost)
        for _ in range(50):
            recorder.state()
    verdict = recorder.replay()
    assert (verdict.unanswered, verdict.without_state) == (unanswered, without_state)
    assert (verdict.different == 0) == (without_state == 0)  # the loop has seen what we have not


def test_another_sender_is_told_apart():
    recorder = recorded(50)
    recorder.command(recorder.stamp_ns, 3.0, "/rival")
    verdict = recorder.replay()
    assert (verdict.equal, verdict.different, verdict.foreign) == (50, 0, 1)
    assert verdict.senders == ("/elbow_controller", "/rival")
    assert not verdict.is_the_law


def test_a_joint_that_was_left_begins_again_with_the_parameters_set_meanwhile():
    recorder = recorded(50)
    recorder.command(recorder.stamp_ns, 0.0)
    for k in range(20):
        recorder.state(is_heard=False)
        if k == 10:
            recorder.tell(change(gains__p=200.0), "gains.p")
            recorder.tell(following(Column("elbow", (Knot(0, 0.2),))), "a trajectory")
    recorder.loop.release()
    for _ in range(50):
        recorder.state()
    verdict = recorder.replay()
    assert (verdict.equal, verdict.different, verdict.zeros) == (100, 0, 1)
    assert verdict.is_the_law


@pytest.mark.parametrize("is_noticed", [True, False])
def test_after_a_silence_the_loop_takes_over_as_it_did(is_noticed):
    recorder = recorded(50)
    if is_noticed:
        recorder.command(recorder.stamp_ns + 1, recorder.loop.note_timeout())
    else:
        recorder.loop.note_unanswered()
    recorder.state(later_ns=200 * MS)
    for _ in range(50):
        recorder.state()
    verdict = recorder.replay()
    assert (verdict.equal, verdict.different, verdict.fallbacks) == (101, 0, int(is_noticed))


def test_states_that_waited_for_a_stopped_controller_have_the_effort_in_force():
    recorder = recorded()
    effort = recorder.loop.law.effort
    waiting = recorder.stamp_ns
    for _ in range(600):
        recorder.state(is_heard=False)
    recorder.loop.note_unanswered()
    for k in range(1, 600, 40):
        recorder.command(waiting + k * MS, effort)
    for _ in range(50):
        recorder.state()
    verdict = recorder.replay()
    assert verdict.is_the_law
    assert (verdict.equal, verdict.different) == (200 + 15 + 50, 0)
    recorder.commands[205] = recorder.commands[205]._replace(effort=effort + 1e-9)
    assert not recorder.replay().is_the_law


def test_a_state_that_was_repeated_has_an_answer_of_its_own():
    recorder = recorded(20)
    recorder.states.append(recorder.states[-1]._replace(place=recorder.place + 500))
    recorder.place += 1000
    recorder.command(recorder.stamp_ns, recorder.loop.law.effort)
    for _ in range(20):
        recorder.state()
    verdict = recorder.replay()
    assert (verdict.equal, verdict.different, verdict.zeros) == (41, 0, 0)


def with_relay(apart=0, is_told=True):
    """Return a recording in which a relay drives the joint for a while."""
    recorder = Recorder(3)
    for _ in range(60):
        recorder.state()
    relay = driven(RelayRequest(2.0, 1e-3, 1.0, 100.0, 5.0))
    if is_told:
        recorder.tell(relay, "a relay", apart)
    else:
        relay(recorder.loop)
    for _ in range(400):
        recorder.state()
    recorder.tell(driven(None), "the end of a relay", apart)
    for _ in range(340):
        recorder.state()
    assert recorder.loop.relay.weight == 0.0 < recorder.loop.relay.ending.count("told")
    return recorder


@pytest.mark.parametrize("apart", [-20, 0, 20])
def test_a_relay_that_was_asked_for_is_the_laws(apart):
    verdict = with_relay(apart).replay()
    assert verdict.is_the_law, verdict.differences
    assert verdict.equal == 800
    unrecorded = with_relay(is_told=False).replay()
    assert unrecorded.equal < 100
    assert unrecorded.equal + unrecorded.different == 800


def test_a_relay_that_the_controller_refused_is_left_out_and_noted():
    recorder = recorded()  # a joint that moves
    relay = driven(RelayRequest(2.0, 1e-3, 1.0, 5.0, 5.0))
    recorder.instructions.append(Instruction(50_500, relay, "a relay"))
    verdict = recorder.replay()
    assert verdict.is_the_law
    assert verdict.notes == ("a relay was left out: no relay now: the reference moves",)


PD = {"gains": {"p": 2.0, "d": 3.0}}


def nodes_of(**joints):
    return {node: {"ros__parameters": {"joint": joint, **PD}} for node, joint in joints.items()}


def test_each_joint_has_the_controller_that_names_it():
    found = controllers_of(nodes_of(a="elbow", b="wrist"), "file")
    assert {joint: each.node for joint, each in found.items()} == {"elbow": "a", "wrist": "b"}


def test_of_two_controllers_of_a_joint_none_is_taken_by_chance():
    with pytest.raises(SettingError, match=r"two controllers of 'elbow': a and b; .*--pa"):
        controllers_of(nodes_of(a="elbow", b="elbow"), "file")


def test_another_robots_controller_of_the_same_name_does_not_count():
    document = {
        **nodes_of(**{"/left/arm": "elbow"}),
        **nodes_of(**{"/right/arm": "elbow"}),
    }
    with pytest.raises(SettingError, match="/left/arm and /right/arm"):
        controllers_of(document, "file")
    assert controllers_of(document, "file", "/right").keys() == {"elbow"}


def test_a_relay_is_allowed_only_where_the_parameters_say_so():
    document = nodes_of(a="elbow", b="wrist")
    document["a"]["ros__parameters"]["allow_relay"] = True
    allowed = [each.allows_relay for each in controllers_of(document, "file").values()]
    assert allowed == [True, False]
    document["/**"] = {"ros__parameters": {"allow_relay": True}}
    assert all(each.allows_relay for each in controllers_of(document, "file").values())
