"""Why nothing is sent to a receiver: nobody, an unknown order, another interface, deactivated."""

from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest

from hpid_ros.nodes.parts.merger import Merged, Receiver
from hpid_ros.nodes.parts.merger_output import ARRAY, GroupOutput, ReceiverWatch

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


@pytest.fixture
def output():
    """An output that has sent efforts to two joints."""
    found = GroupOutput(MagicMock(), ARRAY, TOPIC, "a test", False, lambda: None)
    found.set_joints(["b", "a"])
    assert found.send(Merged(1, (1.0, 2.0)))
    found.publisher.publish.reset_mock()
    return found


def test_the_last_zeros_are_sent_whoever_has_subscribed_meanwhile(output):
    output.settle((0, 1))  # there is one that has not been looked at
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
    for _ in course:
        watch.look()
    assert output.zero(is_last=False) is is_sent
