"""Who commands a joint, without a graph: claims in their order, locks, the sender followed."""

import math
import os
import random
import socket
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.nodes.parts.claims import LEASE, Claim, ClaimState, HostLock, ReceivedClaims
from hpid_ros.simulation.lockstep import FollowedSender

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


def test_a_sender_of_what_is_not_finite_is_silent():
    followed = FollowedSender(0.2)
    assert followed.takes("a", math.nan, 1.0)
    assert followed.takes("b", 1.0, 1.01)
    assert not followed.takes("a", math.nan, 1.1)
    assert followed.takes("b", math.inf, 1.2)
    assert followed.takes("a", 1.0, 1.22)
