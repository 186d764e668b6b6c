"""Answers whose clients are not matched yet: they are sent again, and nothing waits for that."""

import math
import statistics
import time
import warnings
from contextlib import contextmanager
from types import SimpleNamespace
from xml.etree import ElementTree

import pytest
from harness.goals import goal_of, needs_control_msgs
from rcl_interfaces.srv import GetParameters
from rclpy.qos import DurabilityPolicy, QoSProfile

from benchmarks.surroundings import LOOPBACK
from hpid_ros.base.resources import find_resource
from hpid_ros.nodes.core import services
from hpid_ros.nodes.core.services import Answers

LOST = "failed to send response (timeout): client will not receive response"
# A client's reader of answers that wants what no server offers: it is never matched.
UNMATCHED = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
REQUESTS = 100
WAIT = 0.1  # [s] of Fast DDS for each of them, where no profile says otherwise


class Sender:
    """Sends something, which is lost the first few times."""

    def __init__(self, losses):
        self.losses, self.calls = losses, 0

    def __call__(self):
        self.calls += 1
        if self.calls <= self.losses:
            warnings.warn(LOST, RuntimeWarning, stacklevel=1)


def send(answers, sender):
    with answers.sent(sender):
        sender()


def test_what_is_lost_is_sent_again_until_it_is_not(harness, monkeypatch):
    monkeypatch.setattr(services, "_BLOCKED", math.inf)  # a busy machine is no middleware
    answers, senders = Answers(harness.node), [Sender(losses) for losses in (0, 1, 3)]
    for sender in senders:
        send(answers, sender)
    assert [sender.calls for sender in senders] == [1, 1, 1]
    harness.wait(lambda: senders[-1].calls == 4, what="the last one to be sent")
    later = Sender(1)
    send(answers, later)
    harness.wait(lambda: later.calls == 2, what="one that is lost later")
    assert [sender.calls for sender in senders] == [1, 2, 4]


def test_of_answers_that_nobody_takes_the_newest_hundred_wait_ten_seconds(harness, monkeypatch):
    monkeypatch.setattr(services, "_BLOCKED", math.inf)
    answers, senders = Answers(harness.node), [Sender(1000) for _ in range(150)]
    for sender in senders:
        send(answers, sender)
    harness.wait(lambda: senders[-1].calls > 1, what="another try")
    assert [sender.calls > 1 for sender in senders] == [False] * 50 + [True] * 100
    now = time.monotonic() + 10.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    answers._send_again()
    tried = [sender.calls for sender in senders]
    answers._send_again()
    assert [sender.calls for sender in senders] == tried


def test_where_the_middleware_has_waited_itself_it_is_not_asked_again(harness, monkeypatch):
    answers, sender = Answers(harness.node), Sender(1)
    clock = iter([0.0, 0.1])
    monkeypatch.setattr(time, "monotonic", lambda: next(clock))
    send(answers, sender)
    monkeypatch.undo()
    monkeypatch.setattr(services, "_BLOCKED", math.inf)
    later = Sender(1)
    send(answers, later)
    harness.wait(lambda: later.calls == 2, what="one that was lost at once")
    assert sender.calls == 1


@pytest.mark.parametrize("file", ["fastdds.xml", "fastdds_nodes.xml"])
def test_with_our_profiles_no_answer_waits_for_its_client(file):
    """The test below has the suite's own, of which the others have all but the transports."""
    paths = LOOPBACK, find_resource(f"config/{file}")
    suites, ours = (ElementTree.parse(path).iterfind(".//{*}data_writer") for path in paths)
    assert [*map(ElementTree.tostring, ours)] == [*map(ElementTree.tostring, suites)]


@pytest.mark.alone  # it keeps the time
def test_a_client_that_is_never_matched_stops_no_controller(harness):
    """Its requests arrive: with a wait for each, the samples below take twice what they may."""
    harness.start_controller()
    client = harness.node.create_client(
        GetParameters, "elbow_controller/get_parameters", qos_profile=UNMATCHED
    )
    harness.ask_newcomer(1_000_000, 0.1)
    durations = []
    for sample in range(2, REQUESTS + 2):
        begun = time.monotonic()
        client.call_async(GetParameters.Request(names=["joint"]))
        harness.ask(sample * 1_000_000, 0.1)
        durations.append(time.monotonic() - begun)
    assert statistics.median(durations) < WAIT / 2


@needs_control_msgs
@pytest.mark.parametrize("is_refused", [False, True])
def test_each_answer_of_an_action_is_sent_again_as_it_was(harness, is_refused):
    from control_msgs.action import FollowJointTrajectory
    from rclpy.action import ActionClient, CancelResponse, GoalResponse

    from hpid_ros.nodes.parts.goal_server import DeferringServer

    lost, sent_again, handles = [], [], []

    class Handle:
        """Keeps what is sent again."""

        def __getattr__(self, name):
            return lambda header, answer: sent_again.append(answer)

    @contextmanager
    def sent(again):
        yield
        lost.append(again)

    server = DeferringServer(
        sent,
        harness.node,
        FollowJointTrajectory,
        "follow",
        lambda handle: FollowJointTrajectory.Result(),
        goal_callback=lambda _: GoalResponse.REJECT if is_refused else GoalResponse.ACCEPT,
        handle_accepted_callback=handles.append,
        cancel_callback=lambda _: CancelResponse.ACCEPT,
    )
    client = ActionClient(harness.node, FollowJointTrajectory, "follow")
    harness.wait(client.server_is_ready, what="the server")
    goal = client.send_goal_async(goal_of({"elbow": [1.0]}, [1.0]))
    harness.wait(goal.done, what="the answer to the goal")
    answers = [SimpleNamespace(accepted=not is_refused)]
    if not is_refused:
        ended = goal.result().get_result_async()
        cancelled = goal.result().cancel_goal_async()
        harness.wait(cancelled.done, what="the answer to the cancel")

        def conclude(handle):
            handle.canceled()
            return FollowJointTrajectory.Result(error_string="as asked")

        server.notify_execute(handles[0], conclude)
        harness.wait(ended.done, what="the result")
        cancel = lost.pop(1)
        assert cancel.args[1] == cancelled.result()
        cancel()  # which the client ignores, as it has its answer
        answers.append(ended.result())
    real, server._handle = server._handle, Handle()
    for again in lost:
        again()
    server._handle = real
    assert sent_again[0].accepted is answers[0].accepted
    assert sent_again[1:] == answers[1:]
    server.destroy()
