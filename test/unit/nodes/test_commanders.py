"""Who commands a joint: claims in their order, locks, the sender followed, limits, conflicts."""

import math
import os
import random
import socket
from dataclasses import replace
from unittest.mock import MagicMock

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.nodes.parts import bridge_commanders
from hpid_ros.nodes.parts.bridge_commanders import Commanders, HeldCommands
from hpid_ros.nodes.parts.claims import LEASE, Claim, ClaimState, HostLock, ReceivedClaims
from hpid_ros.simulation.lockstep import Barrier, FollowedSender

MS = 1_000_000
LIMITS = {"a": 2.0}


def barrier():
    return Barrier(["a"], LIMITS)


def held():
    return HeldCommands(["a"], 100 * MS, LIMITS)


@pytest.mark.parametrize("make", [barrier, held])
def test_commands_are_held_to_the_limit_of_the_joint(make):
    commands = make()
    commands.begin(MS)
    for effort, acts in ((5.0, 2.0), (-5.0, -2.0), (1.5, 1.5)):
        commands.answer(MS, ["a"], [effort])
        assert commands.finish() == [acts]
    assert commands.counts["a"].excessive == 2


@pytest.mark.parametrize("make", [barrier, held])
def test_answers_to_one_state_that_differ_are_a_conflict(make):
    commands = make()
    commands.begin(MS)
    commands.answer(MS, ["a"], [1.0])
    commands.answer(MS, ["a"], [1.0])  # asked again
    assert commands.counts["a"].conflicting == 0
    commands.answer(MS, ["a"], [-1.0])
    assert commands.counts["a"].conflicting == 1
    commands.answer(MS, ["a"], [0.0])  # the controller leaves
    assert commands.counts["a"].conflicting == 1


@pytest.mark.parametrize("make", [barrier, held])
def test_an_answer_to_the_state_before_that_differs_is_a_conflict(make):
    commands = make()
    for stamp_ns in (MS, 2 * MS):
        commands.begin(stamp_ns)
        commands.answer(stamp_ns, ["a"], [1.0])
    commands.answer(MS, ["a"], [-1.0])
    assert commands.counts["a"].conflicting == 1


def test_a_command_without_a_stamp_beside_a_controller_is_a_conflict():
    commands = held()
    commands.begin(5 * MS)
    commands.answer(5 * MS, ["a"], [1.0])
    commands.answer(0, ["a"], [1.5])
    assert commands.counts["a"].conflicting == 1


def test_commands_without_stamps_and_a_clock_that_went_back_are_none():
    commands = held()
    commands.begin(5 * MS)
    for effort in (1.0, 1.5, -1.0):
        commands.answer(0, ["a"], [effort])
    commands.answer(5 * MS, ["a"], [1.0])
    commands.begin(0)
    commands.answer(MS, ["a"], [1.5])
    assert commands.counts["a"].conflicting == 0


def held_after(*acts):
    """Return the commands of joint a after some acts: times of states, or answers in [ms]."""
    held = HeldCommands(["a"], 100 * MS)
    for act in acts:
        if isinstance(act, int):
            held.begin(act * MS)
        else:
            stamp, effort = act
            held.answer(stamp * MS, ["a"], [effort])
    return held.finish(), held.counts["a"]


@pytest.mark.parametrize(
    ("acts", "effort", "counts"),
    [
        ((5, (2, 1.5), 6), 1.5, {"stale": 1}),  # late, and stands until the next
        ((5, (2, 1.5), 6, (3, -2.0)), -2.0, {"stale": 2}),
        ((0, (0, 1.5), 100), 1.5, {}),
        ((0, (0, 1.5), 101), 0.0, {"unanswered": 1}),  # too old
        ((50, (50, 1.5), 0), 0.0, {}),  # a clock that goes back
        ((50, 0, (50, 1.5)), 0.0, {"outdated": 1}),  # from before it, and late
        ((50, 0, (0, 1.0), 1, (40, 1.5)), 1.0, {"outdated": 1}),
        ((50, 0, 60, (50, 1.5)), 1.5, {"outdated": 0}),  # the clock has come there again
        ((50, 0, (10**9, 1.5)), 1.5, {"outdated": 0}),  # who commands has a clock of its own
        ((0, (0, float("nan"))), 0.0, {"invalid": 1}),
    ],
)
def test_which_command_a_paced_robot_acts_on(acts, effort, counts):
    found, counted = held_after(*acts)
    assert found == [effort]
    for name, number in counts.items():
        assert getattr(counted, name) == number


def silent_then_late(times):
    """Return a barrier that gave its joint up and heard answers to states that were over."""
    commands = Barrier(["a", "b"])
    commands.begin(0)
    commands.answer(0, ["b"], [1.0])
    commands.time_out()
    for k in range(1, times + 1):
        commands.begin(k)
        commands.answer(k, ["b"], [1.0])
        commands.answer(k - 1, ["a"], [1.0])
    return commands


def test_a_controller_that_answers_too_late_is_waited_for_again():
    """Nobody waits for a silent joint: without this it would have to win a race to come back."""
    commands = silent_then_late(1)
    commands.begin(10)
    assert commands.missing == ("a", "b")
    commands.answer(10, ["a"], [2.0])
    commands.answer(10, ["b"], [1.0])
    assert (commands.silent, commands.finish()) == ((), [2.0, 1.0])


def test_one_that_is_always_too_late_is_believed_ever_more_rarely():
    commands = silent_then_late(1)
    waited = 0
    for k in range(10, 1010):
        commands.begin(k)
        commands.answer(k, ["b"], [1.0])
        if commands.missing:
            waited += 1
            commands.time_out()
        commands.answer(k - 1, ["a"], [1.0])
    assert 5 < waited < 12


def test_commands_of_foreign_joints_are_counted():
    held = HeldCommands(["a", "b"], 100 * MS)
    held.begin(0)
    held.answer(0, ["a", "c"], [1.0, 1.0])
    assert (held.foreign, held.silent) == (1, ("b",))


# --- claims, and whom a robot follows

OWNERS = [("here", "a", 1, "/c"), ("there", "b", 1, "/c"), ("there", "b", 2, "/c")]
claims = st.builds(
    lambda owner, since, state: Claim(
        "elbow", "/joint_commands", owner[3], owner[1], owner[2], since, owner[0], state
    ),
    st.sampled_from(OWNERS),
    st.integers(0, 2),
    st.sampled_from([ClaimState.WISHED, ClaimState.HELD]),
)


@given(claims, claims)
def test_of_two_claims_exactly_one_yields(one, other):
    if one.owner != other.owner:
        assert one.yields_to(other) is not other.yields_to(one)


@given(claims, claims)
def test_a_wish_never_displaces_a_holder(one, other):
    if one.state is ClaimState.HELD and other.state is ClaimState.WISHED:
        assert not one.yields_to(other)


class Side:
    """One host's controller as joint_claim drives it: it wishes, settles, and yields for good."""

    def __init__(self, claim):
        self.claim, self.told = claim, [claim]

    def settle(self):
        if self.claim is not None and self.claim.state is ClaimState.WISHED:
            self.claim = replace(self.claim, state=ClaimState.HELD)
            self.told.append(self.claim)

    def receive(self, claim):
        if self.claim is not None and claim is not None and self.claim.yields_to(claim):
            self.claim = None


@given(st.data())
def test_whatever_comes_when_exactly_one_of_two_is_left(data):
    """Messages are late by any amount and sides settle at any time; in the end one has it."""
    since = data.draw(st.tuples(st.integers(0, 2), st.integers(0, 2)))
    sides = [
        Side(Claim("elbow", "/t", owner[3], owner[1], owner[2], start, owner[0]))
        for owner, start in zip(OWNERS, since, strict=False)
    ]
    heard = [0, 0]
    steps = data.draw(st.lists(st.tuples(st.integers(0, 1), st.booleans()), max_size=12))
    for index, settles in steps:
        me, other = sides[index], sides[1 - index]
        if settles:
            me.settle()
        elif heard[index] < len(other.told):
            me.receive(other.told[heard[index]])
            heard[index] += 1
        assert any(side.claim for side in sides)
    for _ in range(2):  # then the network works: everything is told again, in order
        for index, me in enumerate(sides):
            for claim in sides[1 - index].told[heard[index] :]:
                me.receive(claim)
            heard[index] = len(sides[1 - index].told)
            if sides[1 - index].claim is not None:
                me.receive(sides[1 - index].claim)
            me.settle()
    assert [side.claim is not None for side in sides].count(True) == 1


def test_a_claim_stands_for_its_lease_or_until_it_is_released():
    claim = Claim("elbow", "/t", "/c", "b", 1, 0, "there", ClaimState.HELD)
    heard = ReceivedClaims()
    heard.receive(claim, 10.0)
    assert heard.standing(10.0 + LEASE) == claim
    assert heard.standing(10.1 + LEASE) is None
    heard.receive(claim, 20.0)
    heard.receive(replace(claim, state=ClaimState.RELEASED), 20.1)
    assert heard.standing(20.1) is None
    for pid in range(5):  # each is killed, and nobody asks what stands
        heard.receive(replace(claim, pid=pid), 30.0 + 2.0 * LEASE * pid)
    assert len(heard._received) == 1


def test_a_lock_has_one_holder_and_names_it():
    key = f"test {os.getpid()} {random.random()}"
    first, second = HostLock(key, "/one"), HostLock(key, "/" + "deep/" * 30 + "two")
    assert (first.take(), first.take()) == ("", "")
    assert second.take() == f"/one (process {os.getpid()} of this host)"
    first.release()
    assert second.take() == ""
    assert first.take().endswith("deep/two " + f"(process {os.getpid()} of this host)")
    second.release()
    other = HostLock(key + " other", "/three")
    assert other.take() == ""
    other.release()


def test_nobody_can_send_anything_to_a_lock():
    key = f"test {os.getpid()} {random.random()}"
    lock = HostLock(key, "/one")
    lock.take()
    other = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    with other, pytest.raises(ConnectionRefusedError):
        other.connect("\0" + lock._name)
    lock.release()


def test_the_first_sender_is_followed_until_it_is_silent():
    followed = FollowedSender(0.2)
    assert followed.takes("a", 1.0, 0.0)
    assert not followed.takes("b", 1.0, 0.19)
    assert followed.takes("a", 1.0, 0.2)
    assert not followed.takes("b", 1.0, 0.4)
    assert followed.takes("b", 1.0, 0.41)
    assert not followed.takes("a", 1.0, 0.5)
    assert followed.takes("b", 0.0, 0.51)  # leaves, or rests
    assert not followed.takes("a", 1.0, 0.55)
    assert followed.takes("a", 1.0, 0.57)
    assert (followed.sender, followed.others, followed.changes) == ("a", 4, 2)
    followed.wait(10.0)  # time stood still: nobody was silent
    assert not followed.takes("b", 1.0, 10.1)


@pytest.mark.parametrize(
    ("effort", "times", "is_followed"),
    [
        (1.0, [0.04 * k for k in range(1, 13)], False),
        (1.0, [0.04 * k for k in range(1, 14)], True),
        (0.0, [0.04 * k for k in range(1, 4)], False),  # it leaves, or rests
        (0.0, [0.04 * k for k in range(1, 5)], True),
        # The merger stood still, and is slow with what has waited for it.
        (1.0, [10.0, 10.3, 10.6, 10.9], False),
        (0.0, [10.0, 10.3, 10.6, 10.9], False),
        (1.0, [10.0, *(10.02 + 0.09 * k for k in range(1, 7))], True),
        (1.0, [0.2 * k for k in range(1, 6)], False),  # commands come rarely
        (1.0, [0.2 * k for k in range(1, 7)], True),
    ],
)
def test_a_second_sender_is_followed_when_the_first_is_silent_while_it_is_listened_to(
    monkeypatch, effort, times, is_followed
):
    clock = MagicMock(perf_counter=iter([5.0, *(5.0 + each for each in times)]).__next__)
    monkeypatch.setattr(bridge_commanders, "time", clock)
    commanders = Commanders(MagicMock(), ["a"], {}, 0.5, longest_gap=0.1)

    def is_obeyed(effort, sender):
        return bool(commanders.heed(("a",), (effort,), sender, commanders.move())[0])

    assert is_obeyed(effort, "/a_controller")
    obeyed = [is_obeyed(9.0, "/rival") for _ in times]
    assert obeyed == [False] * (len(times) - 1) + [is_followed]


def test_a_sender_of_what_is_not_finite_is_silent():
    followed = FollowedSender(0.2)
    assert followed.takes("a", math.nan, 1.0)
    assert followed.takes("b", 1.0, 1.01)
    assert not followed.takes("a", math.nan, 1.1)
    assert followed.takes("b", math.inf, 1.2)
    assert followed.takes("a", 1.0, 1.22)
