"""What is merged, when, and for whom: whole rounds at once, stragglers late, fallbacks."""

import math
from types import SimpleNamespace
from unittest.mock import MagicMock, call

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import SettingError
from hpid_ros.control.settings import Timing
from hpid_ros.nodes import joint_command_merger
from hpid_ros.nodes.joint_command_merger import JointCommandMerger, MergerParameters
from hpid_ros.nodes.parts import merger_output
from hpid_ros.nodes.parts.command_interfaces import ARRAY
from hpid_ros.nodes.parts.merger import (
    CommandMerger,
    Merged,
    MergedJoint,
    MergerSettings,
    Receiver,
    joints_of,
)
from hpid_ros.nodes.parts.merger_output import GroupOutput, MergedStream, ReceiverWatch

MS = 1_000_000
PERIOD = 2 * MS
TIMEOUT = 50 * MS
NAMES = ("shoulder", "elbow", "wrist")
FALLBACKS = (0.0, 5.0, -2.0)


class Robot:
    """Commands that come to a merger, and somebody who looks exactly when it says."""

    def __init__(self, *, missing=False, wait=0.5, fade_in=0.0, joints=NAMES):
        self.joints = joints
        self.merger = CommandMerger(
            MergerSettings(
                tuple(
                    MergedJoint(name, TIMEOUT / 1e9, fallback, missing)
                    for name, fallback in zip(joints, FALLBACKS, strict=False)
                ),
                wait,
                fade_in,
            )
        )
        self.now = 10**12
        self.sent = []  # (time, message)

    def wait(self, duration_ns):
        """Let time pass, with a look whenever one is due."""
        end = self.now + duration_ns
        while (within := self.merger.time_left(self.now)) * 1e9 < end - self.now + 0.5:
            self.now += round(within * 1e9)
            self._note(self.merger.look(self.now))
        self.now = max(self.now, end)

    def take(self, joint, stamp_ns, effort):
        merged = self.merger.take(joint, stamp_ns, effort, self.now)
        self._note(merged)
        return merged

    def _note(self, merged):
        if merged is not None:
            self.sent.append((self.now, merged))

    @property
    def efforts(self):
        """The efforts in force by joint."""
        return dict(zip(self.joints, self.sent[-1][1].efforts, strict=True))

    def state(self, stamp_ns, efforts, delays=None):
        """One state: each joint answers after its delay; return the messages of the period."""
        begin, before = self.now, len(self.sent)
        delays = delays or dict.fromkeys(efforts, 0)
        for joint in sorted(efforts, key=lambda name: delays[name]):
            self.wait(begin + delays[joint] - self.now)
            self.take(joint, stamp_ns, efforts[joint])
        self.wait(begin + PERIOD - self.now)
        return [merged for _, merged in self.sent[before:]]

    def warm(self, rounds=10):
        """Let it learn the period."""
        for k in range(rounds):
            self.state((k + 1) * PERIOD, dict.fromkeys(self.joints, 1.0))
        self.stamp = (rounds + 1) * PERIOD
        return self


ORDERS = st.permutations(NAMES)
EFFORTS = st.floats(-100.0, 100.0)


@given(st.lists(st.tuples(ORDERS, st.tuples(EFFORTS, EFFORTS, EFFORTS)), min_size=1, max_size=20))
def test_whoever_answers_first_each_state_gives_one_message_with_its_efforts(states):
    robot = Robot()
    for k, (order, efforts) in enumerate(states):
        for position, joint in enumerate(order):
            merged = robot.take(joint, k * PERIOD, efforts[NAMES.index(joint)])
            assert (merged is None) is (position < len(NAMES) - 1)
            robot.wait(PERIOD // 100)
        assert merged == (k * PERIOD, efforts)
        robot.wait(PERIOD)
    assert len(robot.sent) == len(states)
    assert robot.merger.sent_whole == len(states)


EVENTS = st.lists(
    st.tuples(
        st.sampled_from(NAMES),
        st.integers(-3, 3),  # of the stamp, in periods
        st.one_of(EFFORTS, st.sampled_from([math.nan, math.inf, -math.inf])),
        st.integers(0, 3 * TIMEOUT // 2),
    ),
    max_size=30,
)


@given(EVENTS, st.booleans(), st.sampled_from([0.25, 0.5, 1.0]))
def test_whatever_comes_in_whatever_order(events, missing, wait):
    """Sizes, finite numbers, the newest command or the fallback; no command waits for long."""
    robot = Robot(missing=missing, wait=wait)
    newest, heard, due, stamp = {}, {}, {}, 100 * PERIOD
    for joint, steps, effort, pause in events:
        stamp += steps * PERIOD
        before, had_begun = len(robot.sent), robot.merger.has_begun
        robot.take(joint, stamp, effort)
        if math.isfinite(effort):
            newest[joint], heard[joint] = effort, robot.now
            last = [joint] if had_begun else newest
            due |= dict.fromkeys(last, robot.now + robot.merger.rounds.wait_ns)
        robot.wait(pause)
        for time, merged in robot.sent[before:]:
            assert len(merged.efforts) == len(NAMES)
            for name, fallback, sent in zip(NAMES, FALLBACKS, merged.efforts, strict=True):
                is_silent = name not in heard or time - heard[name] > TIMEOUT
                assert sent == (fallback if is_silent else newest[name])
        if robot.merger.has_begun:
            for name, time in due.items():
                if robot.now >= time:
                    assert robot.sent[-1][0] >= heard[name]
    if not missing and set(newest) != set(NAMES):
        assert not robot.sent


@given(st.integers(1, 300), st.sampled_from(NAMES))
def test_a_straggler_delays_nobody_for_longer_than_the_stated_part(late, straggler):
    """Its own answer is sent when it comes."""
    robot = Robot(wait=0.4).warm()
    begin, stamp = robot.now, robot.stamp
    efforts = {name: float(k) for k, name in enumerate(NAMES)}
    delay = PERIOD * late // 400
    robot.state(stamp, efforts, {**dict.fromkeys(NAMES, 0), straggler: delay})
    sent = [(time - begin, merged) for time, merged in robot.sent if time >= begin]
    wait = robot.merger.rounds.wait_ns
    assert wait == pytest.approx(0.4 * PERIOD)
    if delay < wait:
        assert sent == [(delay, (stamp, tuple(efforts.values())))]
        assert robot.merger.counts[straggler].late == 0
        return
    (first, early), (second, whole) = sent
    assert (first, second) == (pytest.approx(wait, abs=2), delay)
    others = [k for k, name in enumerate(NAMES) if name != straggler]
    assert all(early.efforts[k] == efforts[NAMES[k]] for k in others)
    assert early.efforts[NAMES.index(straggler)] == 1.0  # its last one
    assert whole == (stamp, tuple(efforts.values()))
    assert robot.merger.counts[straggler].late == 1


def test_one_that_is_always_late_is_waited_for_once_and_again_when_it_is_in_time():
    robot = Robot().warm()
    efforts = dict.fromkeys(NAMES, 2.0)
    late = {**dict.fromkeys(NAMES, 0), "elbow": 6 * PERIOD // 10}
    first = []
    for _ in range(4):
        begin, before = robot.now, len(robot.sent)
        robot.state(robot.stamp, efforts, late)
        first.append(robot.sent[before][0] - begin)
        assert len(robot.sent) - before == 2
        robot.stamp += PERIOD
    assert first == [PERIOD // 2, 0, 0, 0]
    assert robot.merger.counts["elbow"].late == 4
    for messages in (2, 1, 1):  # it answers in time again, and the next round waits for it
        in_time = {**dict.fromkeys(NAMES, 0), "elbow": PERIOD // 10}
        assert len(robot.state(robot.stamp, efforts, in_time)) == messages
        robot.stamp += PERIOD


def test_answers_to_states_that_are_over_are_sent_with_what_comes_next():
    """A process that stood still answers what it has missed in one go."""
    robot = Robot().warm()
    for _ in range(3):
        robot.state(robot.stamp, {"shoulder": 3.0, "wrist": 3.0})
        robot.stamp += PERIOD
    before = len(robot.sent)
    for k in (3, 2, 1):
        robot.take("elbow", robot.stamp - k * PERIOD, 4.0 - k)
    assert len(robot.sent) - before == 1  # the newest one completes the newest state
    assert robot.efforts == {"shoulder": 3.0, "elbow": 3.0, "wrist": 3.0}


def test_a_joint_that_falls_silent_gets_its_fallback_within_its_timeout_and_is_named():
    robot = Robot().warm()
    died = robot.now - PERIOD  # its last command
    while not robot.merger.silent:
        robot.state(robot.stamp, {"shoulder": 1.0, "wrist": 1.0})
        robot.stamp += PERIOD
        assert robot.now - died < 2 * TIMEOUT
    times = [time for time, merged in robot.sent if merged.efforts[1] == 5.0]
    assert 0 <= times[0] - died - TIMEOUT <= 2
    assert [joint.name for joint in robot.merger.silent] == ["elbow"]
    assert robot.merger.counts["elbow"].silences == 1
    begin, before = robot.now, len(robot.sent)
    robot.state(robot.stamp, {"shoulder": 1.0, "wrist": 1.0})
    assert [time for time, _ in robot.sent[before:]] == [begin]  # nobody waits for it
    robot.stamp += PERIOD
    late = robot.merger.counts["elbow"].late  # as long as it was not known to be silent
    delays = {"shoulder": 0, "wrist": 6 * PERIOD // 10}
    for _ in range(2):  # nor waits another straggler for it
        begin, before = robot.now, len(robot.sent)
        robot.state(robot.stamp, {"shoulder": 1.0, "wrist": 1.0}, delays)
        robot.stamp += PERIOD
        assert robot.sent[-1][0] - begin == delays["wrist"]
    assert robot.merger.counts["elbow"].late == late


def test_when_nobody_commands_any_more_the_fallbacks_are_repeated():
    """Nobody acknowledges a best-effort message, and nothing else would carry them."""
    robot = Robot().warm()
    robot.wait(TIMEOUT)
    before = len(robot.sent)
    robot.wait(TIMEOUT)
    assert 3 <= len(robot.sent) - before <= 5
    assert all(merged.efforts == FALLBACKS for _, merged in robot.sent[before:])


@given(st.floats(0.01, 0.2), EFFORTS)
def test_a_joint_that_comes_back_is_faded_in_from_its_fallback(fade_in, effort):
    robot = Robot(fade_in=fade_in).warm()
    others = {"shoulder": 1.0, "wrist": 1.0}
    for _ in range(2 * TIMEOUT // PERIOD):
        robot.state(robot.stamp, others)
        robot.stamp += PERIOD
    assert robot.efforts["elbow"] == 5.0
    begin = robot.now
    told = []
    while robot.now - begin <= fade_in * 1e9 + 2 * PERIOD:
        robot.state(robot.stamp, {**others, "elbow": effort})
        robot.stamp += PERIOD
        told += [(robot.sent[-1][0] - begin, robot.efforts["elbow"])]
    assert told[0][1] == pytest.approx(5.0)  # no jump
    for time, sent in told:
        part = min(time / 1e9 / fade_in, 1.0)
        assert sent == pytest.approx(5.0 + part * (effort - 5.0), abs=1e-5)  # of whole [ns]
    assert told[-1][1] == effort
    assert robot.merger.counts["elbow"].returns == 1


def test_a_number_that_is_none_is_silence():
    robot = Robot().warm()
    for _ in range(2 * TIMEOUT // PERIOD):
        robot.state(robot.stamp, {"shoulder": 1.0, "elbow": math.nan, "wrist": 1.0})
        robot.stamp += PERIOD
    assert robot.efforts["elbow"] == 5.0
    assert robot.merger.counts["elbow"].invalid == 2 * TIMEOUT // PERIOD


def test_it_starts_with_the_last_joint_and_not_with_one_that_has_gone_meanwhile():
    robot = Robot()
    assert robot.merger.missing == NAMES
    robot.state(PERIOD, {"shoulder": 1.0, "elbow": 1.0})
    robot.wait(2 * TIMEOUT)
    robot.state(2 * PERIOD, {"wrist": 1.0})
    assert (robot.sent, robot.merger.missing) == ([], ("shoulder", "elbow"))
    assert robot.state(3 * PERIOD, dict.fromkeys(NAMES, 2.0))
    assert robot.efforts == dict.fromkeys(NAMES, 2.0)


def test_joints_that_may_be_missing_get_their_fallback_from_the_start():
    robot = Robot(missing=True)
    assert robot.state(PERIOD, {"shoulder": 1.0})
    assert robot.efforts == {"shoulder": 1.0, "elbow": 5.0, "wrist": -2.0}


def test_a_last_zero_is_sent_without_a_new_state():
    robot = Robot().warm()
    robot.take("elbow", robot.stamp - PERIOD, 0.0)  # its controller leaves
    robot.wait(PERIOD // 2)
    assert robot.efforts == {"shoulder": 1.0, "elbow": 0.0, "wrist": 1.0}


@given(st.lists(ORDERS, min_size=1, max_size=5))
def test_answers_to_a_repeated_state_are_merged_once_more(orders):
    robot = Robot().warm()
    for k, order in enumerate(orders):
        before = len(robot.sent)
        for name in order:
            robot.take(name, robot.stamp - PERIOD, float(k))
        assert len(robot.sent) - before == 1
        assert robot.efforts == dict.fromkeys(NAMES, float(k))
        robot.wait(PERIOD)


def test_a_clock_that_goes_back_and_one_that_jumps_ahead_stop_nothing():
    robot = Robot().warm()
    for k, stamp in enumerate((PERIOD, 2 * PERIOD, 10**15, 3 * PERIOD, 4 * PERIOD)):
        assert len(robot.state(stamp, dict.fromkeys(NAMES, float(k)))) == 1
        assert robot.efforts == dict.fromkeys(NAMES, float(k))


def over_a_reset():
    """Return a robot whose wrist falls silent, and whose clock then begins again."""
    robot = Robot(joints=NAMES).warm(100)
    robot.stamp += 10 * TIMEOUT
    two = NAMES[:2]
    for k in range(TIMEOUT // PERIOD + 2):
        robot.state(robot.stamp + k * PERIOD, dict.fromkeys(two, 1.0))
    assert [joint.name for joint in robot.merger.silent] == ["wrist"]
    for k in range(3):
        robot.state(k * PERIOD, dict.fromkeys(two, 2.0))
    return robot


@pytest.mark.parametrize(
    ("stamp", "acts"),
    [(10 * TIMEOUT, False), (2 * TIMEOUT, False), (3 * PERIOD, True), (100 * TIMEOUT, True)],
)
def test_a_joint_that_was_silent_over_a_reset_comes_back_with_the_new_clock_alone(stamp, acts):
    robot = over_a_reset()
    robot.take("wrist", stamp, 9.0)
    robot.wait(PERIOD)
    assert (robot.efforts["wrist"] == 9.0) is acts
    assert robot.merger.counts["wrist"].outdated == (not acts)
    robot.state(3 * PERIOD, dict.fromkeys(NAMES, 3.0))
    assert robot.efforts == dict.fromkeys(NAMES, 3.0)


def test_stamps_of_a_second_sender_are_no_reset():
    """It stamps nothing: the others are believed as before."""
    robot = Robot()
    for k in range(50):
        stamp = 10 * TIMEOUT + k * PERIOD
        robot.take("shoulder", stamp, 1.0)
        robot.take("shoulder", 0, 2.0)
        robot.take("wrist", stamp - PERIOD, 1.0)
        robot.take("elbow", stamp, 1.0)
        robot.wait(PERIOD if k % 10 else 2 * TIMEOUT)
    assert not any(each.outdated for each in robot.merger.counts.values())
    assert not robot.merger.silent


def test_commands_without_stamps_are_merged_round_by_round():
    robot = Robot().warm()
    for k in range(5):
        assert len(robot.state(0, dict.fromkeys(NAMES, float(k)))) == 1


def test_one_that_stood_still_itself_is_patient_anew():
    """Its own freeze is no silence of the joints: it could not hear them."""
    robot = Robot().warm()
    robot.merger.time_left(robot.now)
    robot.now += 100 * TIMEOUT
    assert robot.merger.look(robot.now) is None
    assert not robot.merger.silent
    robot.merger.time_left(robot.now)
    robot.now += 100 * TIMEOUT
    assert robot.merger.look(robot.now).efforts == FALLBACKS  # a second time without a command


def test_what_was_sent_in_place_of_the_joints_is_where_they_come_back_from():
    robot = Robot(fade_in=0.01).warm()
    robot.merger.supersede(0.0, robot.now)
    robot.state(robot.stamp, dict.fromkeys(NAMES, 8.0))
    assert robot.efforts == dict.fromkeys(NAMES, 0.0)
    robot.wait(20 * MS)
    robot.state(robot.stamp + PERIOD, dict.fromkeys(NAMES, 8.0))
    assert robot.efforts == dict.fromkeys(NAMES, 8.0)


def stream(delays, is_first=False, **joint):
    """Return the stream of one joint."""
    output = MagicMock(is_first=is_first)
    stream = MergedStream(MagicMock(), output, delays.append, MagicMock())
    stream.begin(MergerSettings((MergedJoint("elbow", 0.5, **joint),)))
    return stream


@pytest.mark.parametrize("is_first", [True, False])
def test_a_receiver_that_has_got_nothing_is_sent_efforts_that_begin_at_zero(is_first):
    """Controllers may have wound up while one of them kept the others waiting."""
    merged = stream([], is_first)
    merged.take("elbow", MS, 40.0)
    (first,) = merged.output.send.call_args.args
    assert first.efforts == (0.0 if is_first else 40.0,)


def test_what_answers_nothing_has_no_delay():
    delays = []
    merged = stream(delays, may_be_missing=True)
    merged.check()
    assert merged.output.send.called
    assert not delays
    merged.take("elbow", MS, 1.0)
    assert len(delays) == 1


def test_a_controller_says_what_its_joint_falls_back_to_before_the_merger_does():
    assert MergerParameters().command_timeout > Timing().state_timeout


def test_who_commanded_a_joint_first_is_followed_for_as_long_as_any_joint_may_be_silent(
    monkeypatch,
):
    monkeypatch.setattr(joint_command_merger, "Commanders", lambda *given: given)
    joints = MergedJoint("elbow"), MergedJoint("wrist", 0.7)
    node = MagicMock(_commanders=None, **{"_wanted.settings.return_value": MergerSettings(joints)})
    JointCommandMerger._start_merging(node)
    assert node._commanders[3] == 0.7


def test_a_last_zero_that_nobody_acknowledges_is_reported():
    node = MagicMock(_zeros_left=0)
    node._output.publisher.wait_for_all_acked.return_value = False
    JointCommandMerger.close(node)
    (line,) = node.get_logger().warning.call_args.args
    assert "of zero efforts, was not acknowledged" in line


def test_a_receiver_that_does_not_answer_is_asked_again_and_no_request_is_kept():
    node = MagicMock()
    client = node.create_client.return_value
    watch = ReceiverWatch(node, Receiver(NAME, (), TOPIC), MagicMock(), "/manager", print)
    for _ in range(2):
        watch._ask()
        watch._asked_at -= 10.0
    assert client.remove_pending_request.call_args_list == [call(client.call_async.return_value)]


def test_two_sources_of_one_joint_give_themselves_away():
    robot = Robot().warm()
    counts = robot.merger.counts["elbow"]
    for stamp, effort, conflicts in (
        (robot.stamp, 2.0, 0),
        (robot.stamp, 2.0, 0),  # it repeats itself
        (robot.stamp, -3.0, 1),
        (robot.stamp - PERIOD, 2.0, 2),
        (robot.stamp - PERIOD, 0.0, 2),  # it leaves
    ):
        robot.merger.take("elbow", stamp, effort, robot.now, is_signed=False)
        assert counts.conflicting == conflicts
        robot.merger.take("wrist", stamp, effort, robot.now)
    assert robot.merger.counts["wrist"].conflicting == 0  # its sender says who it is


def test_what_must_not_wait_is_sent_without_those_that_are_missing():
    robot = Robot().warm()
    assert robot.take("elbow", robot.stamp, 0.0) is None
    assert robot.merger.flush(robot.now).efforts == (1.0, 0.0, 1.0)
    assert robot.merger.flush(robot.now) is None
    robot.take("shoulder", robot.stamp, 2.0)
    assert robot.take("wrist", robot.stamp, 2.0).efforts == (2.0, 0.0, 2.0)


def test_commands_for_other_joints_are_counted():
    robot = Robot()
    assert robot.take("wheel", 0, 1.0) is None
    assert robot.merger.foreign == 1


@pytest.mark.parametrize(
    ("values", "line"),
    [
        ({"order": []}, "named once each, not none"),
        ({"order": ["a", "a"]}, "named once each, not a, a"),
        ({"timeouts": {"c": 0.2}}, "timeout is given for the unknown joint 'c'; known: a, b"),
        ({"fallbacks": {"c": 1.0}}, "fallback is given for the unknown joint 'c'; known: a, b"),
        ({"order": ["a", ""]}, "must have a name"),
    ],
)
def test_joints_that_cannot_be_used_are_refused(values, line):
    arguments = {"order": ["a", "b"], "timeout": 0.1, "timeouts": {}, "fallbacks": {}} | values
    with pytest.raises(SettingError, match=line):
        joints_of(**arguments)


def test_a_joint_with_a_fallback_may_be_missing_and_others_have_zero():
    a, b = joints_of(["a", "b"], 0.1, {"a": 0.2}, {"b": 3.0})
    assert (a.timeout, a.fallback, a.may_be_missing) == (0.2, 0.0, False)
    assert (b.timeout, b.fallback, b.may_be_missing) == (0.1, 3.0, True)


@pytest.mark.parametrize("ratio", [1, 2, 10])
def test_joints_whose_states_are_on_two_topics_wait_for_each_other_within_the_share_alone(ratio):
    """The stamps of a gripper are never those of the arm: every command is sent soon after it."""
    robot, came = Robot(), {}
    for k in range(400):
        stamp_ns = (k + 1) * PERIOD
        for joint in NAMES[:2]:
            robot.take(joint, stamp_ns, float(k))
            came[joint, float(k)] = robot.now
            robot.wait(100_000)
        if k % ratio == 0:
            robot.take("wrist", stamp_ns - 700_000, float(k))
            came["wrist", float(k)] = robot.now
        robot.wait(PERIOD - 200_000)
    first_sent = {}
    for time_ns, merged in robot.sent:
        for joint, effort in zip(NAMES, merged.efforts, strict=True):
            first_sent.setdefault((joint, effort), time_ns)
    begun = max(came[joint, 0.0] for joint in NAMES)
    for key, time_ns in came.items():
        if time_ns > begun and key in first_sent:
            assert first_sent[key] - time_ns <= 0.5 * PERIOD
    assert len(first_sent) >= len(came) - len(NAMES)
    assert not robot.merger.silences


@pytest.mark.parametrize("ahead_ns", [1, 10**6 * PERIOD])
def test_a_joint_whose_stamps_are_ahead_keeps_nobody_waiting_for_longer_than_a_period(ahead_ns):
    """Its answers begin the rounds, a twentieth as often: without its own pace for the others."""
    robot, came, first_sent = Robot().warm(), {}, {}
    for k in range(1, 400):
        stamp_ns = robot.stamp + k * PERIOD
        if k % 20 == 0:
            robot.take("shoulder", stamp_ns + 20 * PERIOD + ahead_ns, 1.0)
        came[float(k)] = robot.now
        for joint in NAMES[1:]:
            robot.take(joint, stamp_ns, float(k))
        robot.wait(PERIOD)
    for time_ns, merged in robot.sent:
        assert merged.efforts[1] in came | {1.0: 0} | {FALLBACKS[1]: 0}
        first_sent.setdefault(merged.efforts[1], time_ns)
    late = [first_sent[key] - came[key] for key in came if key > 1.0 and key in first_sent]
    assert max(late) <= PERIOD
    assert len(late) > 0.4 * len(came)


# --- why nothing is sent to a receiver

NONE, ONE, OTHER = frozenset(), frozenset([b"1"]), frozenset([b"2"])
NAME, TOPIC = "/arm_controller", "/arm_controller/commands"


def heard(joints=("b", "a"), interface="effort", given=()):
    """Return a receiver that has subscribed and said what it has."""
    receiver = Receiver(NAME, given, TOPIC)
    receiver.note_endpoints(ONE)
    receiver.note_joints(joints, interface)
    return receiver


def test_whoever_subscribes_gets_the_order_that_was_given():
    receiver = Receiver("", ("b", "a"), "/commands")
    assert receiver.reason == "waiting for somebody to subscribe to /commands"
    receiver.note_endpoints(ONE)
    assert (receiver.reason, receiver.joints, receiver.must_be_asked) == ("", ("b", "a"), False)


def test_a_controller_is_asked_for_its_joints_before_it_gets_anything():
    receiver = Receiver(NAME, (), TOPIC)
    assert receiver.reason == f"waiting for {NAME} to subscribe to {TOPIC}"
    assert not receiver.must_be_asked
    receiver.note_endpoints(ONE)
    assert receiver.must_be_asked
    assert receiver.reason == f"waiting for {NAME} to say which joints it has"
    receiver.note_joints(["b", "a"], "effort")
    assert (receiver.reason, receiver.joints, receiver.must_be_asked) == ("", ("b", "a"), False)


@pytest.mark.parametrize("steps", [[OTHER], [frozenset(), ONE], [ONE | OTHER]])
def test_a_new_one_of_its_name_is_asked_again(steps):
    receiver = heard()
    assert [receiver.note_endpoints(endpoints) for endpoints in steps][-1]
    assert receiver.must_be_asked
    assert receiver.reason


def test_one_that_stays_is_not_asked_again():
    receiver = heard()
    receiver.note_endpoints(ONE | OTHER)
    receiver.note_joints(["b", "a"], "effort")
    assert not receiver.note_endpoints(OTHER)
    assert receiver.reason == ""


@pytest.mark.parametrize("state", ["inactive", "unconfigured", "finalized"])
def test_a_controller_that_is_deactivated_gets_nothing_until_it_is_active_again(state):
    receiver = heard()
    receiver.note_state(state)
    assert receiver.is_deactivated
    assert receiver.reason == f"{NAME} is {state}, and discards what it is sent"
    receiver.note_state("active")
    assert receiver.reason == ""


def test_what_was_known_of_one_that_has_gone_is_forgotten():
    receiver = heard()
    receiver.note_state("inactive")
    receiver.note_endpoints(frozenset())
    receiver.note_endpoints(OTHER)
    receiver.note_joints(["c"], None)
    assert (receiver.reason, receiver.joints) == ("", ("c",))


@pytest.mark.parametrize(
    ("told", "line"),
    [
        ({"joints": None}, "it has no parameter joints"),
        ({"joints": []}, "must be named once each, not none"),
        *(({"joints": odd}, "is no list of names") for odd in (5, "ab", [1.0, 2.0], True)),
        ({"joints": ["a", "a"]}, "must be named once each, not a, a"),
        ({"interface": "position"}, "it commands the position of its joints, not their effort"),
        ({"given": ("a", "b")}, "its joints are b, a, those that were given a, b"),
        ({"given": ("b",)}, "its joints are b, a, those that were given b"),
    ],
)
def test_one_that_cannot_be_used_is_told_and_not_asked_all_the_time(told, line):
    receiver = heard(**told)
    assert receiver.reason == f"nothing is sent to {NAME}: " + receiver.reason.partition(": ")[2]
    assert line in receiver.reason
    assert not receiver.must_be_asked


class Matches:
    """What a middleware says of one subscription, whose place another takes before some look."""

    def __init__(self):
        self.ever = 1
        self.looks_left = math.inf

    def __call__(self):
        self._look()
        return self.ever, 1

    def count_known(self, _):
        self._look()
        return 1

    def _look(self):
        self.ever += self.looks_left == 0
        self.looks_left -= 1


@pytest.fixture
def matches(monkeypatch):
    found = Matches()
    monkeypatch.setattr(merger_output, "MatchCounter", lambda _: found)
    return found


@pytest.fixture
def output(matches):
    """An output that has sent efforts to two joints."""
    node = MagicMock(count_subscribers=matches.count_known)
    found = GroupOutput(node, ARRAY, TOPIC, "a test", True, lambda: None)
    found.settle(found.matches)
    found.set_joints(["b", "a"])
    assert found.send(Merged(1, (1.0, 2.0)))
    found.publisher.publish.reset_mock()
    return found


@pytest.mark.parametrize("looks", range(3))
def test_nothing_is_sent_to_one_that_took_the_place_of_another_during_the_looks(
    output, matches, looks
):
    matches.looks_left = looks
    assert not output.send(Merged(2, (3.0, 4.0)))
    output.settle(None)
    assert not output.send(Merged(2, (3.0, 4.0)))
    output.settle((1, 0))  # as it was before
    assert not output.send(Merged(2, (3.0, 4.0)))
    output.settle(output.matches)
    assert output.send(Merged(2, (3.0, 4.0)))
    assert output.publisher.publish.call_count == 1


def test_the_last_zeros_are_sent_whoever_has_subscribed_meanwhile(output, matches):
    matches.ever += 1  # there is one that has not been looked at
    assert not output.send(Merged(2, (3.0, 4.0)))
    assert not output.zero(is_last=False)
    assert not output.publisher.publish.called
    assert output.zero(is_last=True)
    assert output.publisher.publish.call_count == 1
    output.forget()
    assert not output.zero(is_last=True)


@pytest.mark.parametrize(
    ("course", "is_sent"),
    [([ONE | OTHER], True), ([OTHER], False), ([NONE, ONE], True), ([ONE | OTHER, OTHER], False)],
)
def test_zeros_are_due_as_long_as_somebody_is_there_who_was_sent_efforts(output, course, is_sent):
    node = MagicMock()
    endpoints = iter((ONE, *course))
    node.get_subscriptions_info_by_topic.side_effect = lambda _: [
        SimpleNamespace(endpoint_gid=gid, node_namespace="/", node_name=NAME[1:])
        for gid in next(endpoints)
    ]
    receiver = Receiver(NAME, (), TOPIC)
    watch = ReceiverWatch(node, receiver, output, "/controller_manager", lambda: None)
    watch.start()
    watch.look()
    output.send(Merged(2, (1.0, 2.0)))
    assert not output.is_first
    for _ in course:
        watch.look()
    assert output.is_first  # for who has come since
    assert output.zero(is_last=False) is is_sent
