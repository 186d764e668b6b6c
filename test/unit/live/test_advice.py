"""Advice equals what the nodes' own checks say, and a response settles when the loop does."""

import json
import math
import sys
import threading
from dataclasses import asdict

import pytest
from harness.simulated_graph import loop_settings

from hpid_bench.live.advice import UNKNOWN_INERTIA, Advice, AdviceClient, Adviser, response_to
from hpid_bench.live.page.panel import _joint_advice
from hpid_ros.stability.gain_check import check_gains

PATIENCE = 60.0  # [s]


@pytest.fixture(scope="module")
def adviser():
    return Adviser()


@pytest.mark.slow
def test_the_interval_is_that_of_check_gains(adviser):
    settings = loop_settings("elbow", **{"gains.i": 1500.0})
    *_, advice = adviser.advise(settings, 0.1)
    assert 20.0 < advice.phase < 90.0
    assert 0.0 < advice.delay < 1.0
    assert advice.sensitivity >= 1.0
    assert advice.interval == check_gains([(settings, (0.5, 0.5))])[0].interval
    assert 0.0 < advice.interval[1] < 0.49  # so that a page has something to shade


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"inertia": 0.0}, UNKNOWN_INERTIA),
        ({"gains.i": 0.0}, "integral action"),
        ({"inertia": 0.0, "compensation": "decoupling"}, "decoupling needs the inertia"),
    ],
)
def test_where_nothing_can_be_certified_it_says_why(adviser, changes, reason):
    settings = loop_settings("elbow").with_parameters(changes)
    *_, advice = adviser.advise(settings, 0.1)
    assert advice.interval is None
    assert reason in advice.reason
    again = Advice.from_mapping(json.loads(json.dumps(asdict(advice))))
    assert repr(again) == repr(advice)  # nan equals nothing


def test_the_margins_of_several_joints_are_the_least_of_all_also_where_one_has_no_certificate():
    certified = Advice((-0.1, 0.2), "", 40.0, 0.01, 1.5)
    found = _joint_advice([certified, Advice(None, "no", 60.0, 0.03, 1.2)])
    assert found == Advice(None, "no", 40.0, 0.01, 1.5)
    assert _joint_advice([certified, Advice((-0.2, 0.1), "", 60.0)]).interval == (-0.1, 0.1)
    assert math.isnan(_joint_advice([certified, Advice()]).phase)


def test_a_negative_degree_is_faster_close_by():
    """What the page shows people is the very thing that the homogeneous law is for."""
    settle = {mu: response_to(loop_settings("elbow", mu=mu), 0.01).settling for mu in (-0.3, 0.0)}
    assert settle[-0.3] < 0.6 * settle[0.0]


def test_a_response_begins_with_the_whole_step_and_ends_settled():
    found = response_to(loop_settings("elbow", mu=0.0), 0.2)
    assert found.errors[0] == 1.0
    assert math.isfinite(found.settling)
    late = [e for t, e in zip(found.times, found.errors, strict=True) if t > found.settling]
    assert max(map(abs, late)) <= 0.02
    assert found.overshoot == pytest.approx(-min(found.errors), abs=1e-3)


def test_of_questions_that_wait_the_newest_is_answered():
    client, heard, done = AdviceClient(), [], threading.Event()
    values = loop_settings("elbow").to_parameters()

    def hear(number, advice):
        heard.append((number, advice.interval))
        if number == 29 and not advice.is_pending:
            done.set()

    try:
        for number in range(30):
            client.ask("a", values, 0.1, lambda advice, number=number: hear(number, advice))
        assert done.wait(PATIENCE)
    finally:
        client.close()
    assert len(heard) <= 6  # each question is answered twice
    assert heard[-1][1] == (-0.495, 0.495)


def test_a_process_that_dies_is_an_answer_and_the_next_question_has_another_one():
    client, heard = AdviceClient([sys.executable, "-c", "pass"]), []
    arrived = threading.Semaphore(0)
    try:
        for _ in range(2):
            client.ask("a", {}, 0.1, lambda advice: (heard.append(advice), arrived.release()))
            assert arrived.acquire(timeout=PATIENCE)
    finally:
        client.close()
    assert [each.reason for each in heard] == ["the computation failed"] * 2
