"""A running graph as a live page sees it: found, watched, set and stopped."""

import itertools
import os
import signal
import threading
import time
from functools import partial

import numpy as np
import pytest
import rclpy
from harness.graph import ros_arguments
from harness.simulated_graph import loop_settings
from rcl_interfaces.msg import ParameterEvent
from rcl_interfaces.srv import GetParameters
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_parameter_events
from rclpy.task import Future
from sensor_msgs.msg import JointState

from hpid_bench.live import graph_client
from hpid_bench.live.graph_client import GraphClient, parameter
from hpid_bench.live.known_controllers import Answer, Samples
from hpid_bench.live.streams import controller_topics
from hpid_ros.control.settings import PARAMETERS
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.nodes.core.executor import ClosingNode
from hpid_ros.nodes.core.middleware import OFFERED
from hpid_ros.nodes.core.status import OK, Diagnostics

MS = 1_000_000
ELBOW, WRIST = "/elbow_controller", "/arm/wrist_controller"
MARK = 0.125  # [rad], nowhere else
NOTHING = Samples(np.zeros((0, 3)), np.zeros((0, 2)), np.zeros((0, 3)))
JOINTS = {ELBOW: "elbow", WRIST: "wrist"}


@pytest.fixture
def graph(harness):
    """Return a live graph whose node is spun beside the test."""
    node = ClosingNode("tuner", context=harness.context)
    graph = GraphClient(node)
    executor, end = EventsExecutor(context=harness.context), Future()
    executor.add_node(node)
    spin = partial(executor.spin_until_future_complete, end, 600.0)
    thread = threading.Thread(target=spin)
    thread.start()
    yield graph
    end.set_result(None)
    thread.join()
    graph.close()
    executor.shutdown()
    node.destroy_node()


class Robot:
    """Two controllers, one in a namespace whose topics are remapped, and their states."""

    def __init__(self, harness):
        self.harness = harness
        self.stamp_ns = 0
        self.start(ELBOW, introspection_rate=-1.0)
        self.start(WRIST, "-r", "joint_states:=/arm/all", "-r", "joint_commands:=efforts")
        self.topics = {
            ELBOW: harness.states,
            WRIST: harness.node.create_publisher(JointState, "/arm/all", OFFERED),
        }
        for publisher in self.topics.values():
            harness.wait(lambda each=publisher: each.get_subscription_count())
        self.tell(3)

    def start(self, node, *arguments, **parameters):
        space, _, name = node.rpartition("/")
        own = ros_arguments(
            joint=JOINTS[node],
            state_clock="simulated",
            state_watchdog=False,
            wait_for_command_subscribers=0,
            **parameters,
        )
        return self.harness.processes.start(
            name, "joint_controller", [*own, *arguments, "-r", f"__ns:={space or '/'}"]
        )

    def tell(self, count, positions=(0.1, 0.2)):
        """Publish so many states of both joints; each is answered before the next one.

        The first is published until it is: the match may have been seen on one side only.
        """
        for _ in range(count):
            states = {}
            for (node, publisher), position in zip(self.topics.items(), positions, strict=True):
                names = [JOINTS[node], "other"]
                template = JointStateTemplate(names, position=True, velocity=True)
                states[publisher] = template.encode(
                    self.stamp_ns, position=[position, 9.0], velocity=[0.5, 0.0]
                )
            if self.stamp_ns:
                self._publish(states)
            self.harness.wait(lambda states=states: self._is_answered(states), what="an answer")
            self.stamp_ns += MS

    def _publish(self, states):
        for publisher, state in states.items():
            publisher.publish(state)

    def _is_answered(self, states):
        if not self.stamp_ns:
            self._publish(states)
        commands = self.harness.commands
        return bool(commands) and commands[-1].stamp_ns == self.stamp_ns


@pytest.fixture
def robot(harness):
    return Robot(harness)


def found(harness, graph, *nodes):
    nodes = nodes or (ELBOW, WRIST)
    harness.wait(lambda: all(node in graph.controllers() for node in nodes), what="controllers")
    harness.wait(lambda: all(graph.controllers()[each].lifecycle == "active" for each in nodes))
    return graph.controllers()


def answered(harness, future):
    harness.wait(future.done, what="an answer")
    return future.result()


def certain(harness, graph, node, values):
    """Return what a controller says to a set; who stood still is asked again."""
    while not (answer := answered(harness, graph.set(node, values))).is_certain:
        pass
    return answer


def taken(harness, graph, node, **least):
    """Return the samples of a node once it has so many of each kind."""
    parts = []

    def is_enough():
        parts.append(graph.take()[node])
        return all(
            sum(len(getattr(part, kind)) for part in parts) >= count
            for kind, count in least.items()
        )

    harness.wait(is_enough, what=f"{least} of {node}")
    parts.append(graph.take()[node])
    return [
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("states", "efforts", "references")
    ]


def watched(harness, graph, robot, *nodes):
    """Watch nodes, and return when everything that they are told and tell is taken."""
    graph.watch(nodes)
    lacks = {"states": set(nodes), "efforts": {nodes[0]}, "references": set(nodes)}

    def is_all_there():
        robot.tell(60)  # references come at 20 Hz
        for node, samples in graph.take().items():
            for name, without in lacks.items():
                if len(getattr(samples, name)):
                    without.discard(node)
        return not any(lacks.values())

    harness.wait(is_all_there, what="samples")
    robot.tell(1, positions=(MARK, MARK))
    seen = {node: {name: [] for name in lacks} for node in nodes}

    def is_mark_there():
        for node, samples in graph.take().items():
            for name, rows in seen[node].items():
                rows += getattr(samples, name).tolist()
        times = {name: {row[0] for row in seen[nodes[0]][name]} for name in lacks}
        marks = [[row[0] for row in seen[each]["states"] if row[1] == MARK] for each in nodes]
        return all(marks) and all(marks[0][0] in each for each in times.values())

    harness.wait(is_mark_there, what="the last of them")


def test_our_controllers_are_found_in_every_namespace_and_watched(harness, graph, robot):
    Node("bystander", context=harness.context)  # which has parameters, and none of a controller
    seen = found(harness, graph)
    assert list(seen) == [WRIST, ELBOW]
    assert [each.joint for each in seen.values()] == ["wrist", "elbow"]
    assert (seen[WRIST].namespace, seen[ELBOW].namespace) == ("/arm", "/")
    assert set(seen[ELBOW].values) == set(PARAMETERS)
    assert (seen[ELBOW].introspection_rate, seen[WRIST].introspection_rate) == (-1.0, 20.0)
    assert not seen[ELBOW].requires_certificate
    of = partial(graph.running, state_of=lambda _: (None, None))
    harness.wait(lambda: of([WRIST]).states == "/arm/all")
    assert of([ELBOW]).states == "/joint_states"
    harness.wait(lambda: all(each.health for each in graph.controllers().values()))
    assert graph.controllers()[ELBOW].health.values["lifecycle"] == "active"

    watched(harness, graph, robot, ELBOW, WRIST)
    robot.tell(300)
    robot.tell(1, positions=(7.0, 0.2))  # a peak of one sample
    robot.tell(300)
    states, efforts, references = taken(
        harness, graph, ELBOW, states=601, efforts=601, references=601
    )
    assert states[:, 0] - states[0, 0] == pytest.approx(np.arange(601) * 1e-3)
    assert np.flatnonzero(states[:, 1] == 7.0).tolist() == [300]
    assert set(states[:, 2]) == {0.5}
    told = [(each.stamp_ns * 1e-9, *each.effort) for each in harness.commands[-601:]]
    begin = [told[0][0] - states[0, 0], 0.0]
    assert efforts == pytest.approx(np.array(told) - begin)
    assert not harness.node.count_subscribers("/arm/efforts")  # which nobody else hears
    assert len(references) == 601
    assert references[:, 1] == pytest.approx(0.1)
    graph.watch([])
    for publisher in robot.topics.values():
        harness.wait(lambda each=publisher: each.get_subscription_count() == 1)
    assert graph.take() == {}


def test_another_node_of_the_same_name_does_not_hide_a_controllers_topics(harness):
    """As a dead one may, whose name the middleware keeps; which one it finds first is chance."""
    context = rclpy.Context()
    rclpy.init(args=[], context=context, domain_id=harness.context.get_domain_id())
    other = rclpy.create_node("elbow_controller", context=context)
    harness.start_controller()
    harness.wait(lambda: controller_topics(harness.node, ELBOW, "elbow")[1], what="its topics")
    other.destroy_node()
    rclpy.shutdown(context=context)


def test_numbers_are_sent_in_the_types_that_controllers_declare():
    assert parameter("gains.p", 12).type_ == Parameter.Type.DOUBLE
    assert parameter("multi_turn", True).type_ == Parameter.Type.BOOL


def test_who_watches_is_not_the_one_that_a_controller_waits_for(harness, graph):
    arguments = [*ros_arguments(joint="elbow"), "-r", "joint_commands:=/drive"]
    harness.processes.start("elbow_controller", "joint_controller", arguments)
    graph.watch([ELBOW])
    waiting = "waiting for a subscriber of the commands"

    def told(after=0.0):
        seen = graph.controllers().get(ELBOW)
        return seen and seen.health and seen.health.heard_at > after and seen.health

    for _ in range(3):
        last = told().heard_at if told() else 0.0
        harness.wait(lambda last=last: told(last), what="its health")
        assert told().message in (waiting, "waiting for other claims of the joint")
    graph.watch([ELBOW])
    assert not harness.node.count_subscribers("/drive")
    assert not harness.states.get_subscription_count()
    harness.node.create_subscription(JointState, "/drive", lambda _: None, OFFERED)
    harness.wait(lambda: harness.states.get_subscription_count(), what="it to listen")

    def is_watched():
        robot_stamp[0] += MS
        harness.publish(robot_stamp[0], 0.1)
        return len(graph.take().get(ELBOW, NOTHING).efforts)

    robot_stamp = [0]
    harness.wait(is_watched, what="efforts")


def test_a_set_is_taken_or_refused_as_a_whole_and_changes_by_anybody_are_seen(
    harness, graph, robot
):
    before = found(harness, graph)[ELBOW]
    watched(harness, graph, robot, ELBOW)
    robot.tell(101)
    robot_time, _, _ = taken(harness, graph, ELBOW, states=101)
    answer = certain(harness, graph, ELBOW, {"gains.p": 12, "mu": -0.1})
    assert answer == Answer(True)
    seen = graph.controllers()[ELBOW]
    assert (seen.values["gains.p"], seen.settings.gains.p, seen.settings.mu) == (12.0, 12.0, -0.1)
    assert before.values["gains.p"] != 12.0

    answer = certain(harness, graph, ELBOW, {"gains.p": 13.0, "mu": 0.9})
    assert not answer.is_taken
    assert "mu out of range" in answer.reason
    assert graph.controllers()[ELBOW].values["gains.p"] == 12.0
    answer = certain(harness, graph, ELBOW, {"gains.q": 13.0})
    assert "gains.q" in answer.reason
    answer = answered(harness, graph.set("/nobody", {"mu": 0.0}))
    assert "/nobody" in answer.reason

    assert harness.set_parameters(ELBOW, gains__d=2.5) == (True, "")
    harness.wait(lambda: graph.controllers()[ELBOW].settings.gains.d == 2.5)
    mine, other = graph.changes()
    assert mine.values == {"gains.p": 12.0, "mu": -0.1}
    assert (other.node, other.values) == (ELBOW, {"gains.d": 2.5})
    assert mine.time == pytest.approx(robot_time[-1, 0])
    assert graph.changes() == ()


def test_controllers_are_stopped_and_come_back_with_the_parameters_that_they_have(
    harness, graph, robot, monkeypatch
):
    monkeypatch.setattr(graph_client, "_STOPS_WITHIN", 60.0)  # discovery takes its time
    found(harness, graph)
    assert answered(harness, graph.change_state(ELBOW, "deactivate")) == Answer(True)
    harness.wait(lambda: graph.controllers()[ELBOW].lifecycle == "inactive")
    refused = answered(harness, graph.change_state(ELBOW, "deactivate"))
    assert refused == Answer(True, f"{ELBOW} is inactive already")
    assert answered(harness, graph.change_state(ELBOW, "activate")) == Answer(True)
    assert "explode" in answered(harness, graph.change_state(ELBOW, "explode")).reason

    assert certain(harness, graph, ELBOW, {"gains.p": 12.0}).is_taken
    process = harness.processes.nodes["elbow_controller"].process
    process.terminate()
    harness.wait(lambda: process.poll() is not None)
    harness.wait(lambda: not graph.controllers()[ELBOW].is_here)
    assert graph.controllers()[ELBOW].values["gains.p"] == 12.0
    robot.start(ELBOW, gains__p=3.0)
    harness.wait(lambda: graph.controllers()[ELBOW].is_here)
    assert found(harness, graph)[ELBOW].values["gains.p"] == 3.0
    # Whoever is frozen before it has found the client never gets what is asked.
    harness.wait(lambda: answered(harness, graph.set(ELBOW, {"gains.p": 3.5})).is_taken)

    monkeypatch.setattr(graph_client, "_SET_WITHIN", 0.5)
    process = harness.processes.nodes["elbow_controller"].process
    values = itertools.count(4.0)

    def takes_late():
        """Return whether a frozen controller took a set: not if it found its client late."""
        value = next(values)
        os.kill(process.pid, signal.SIGSTOP)
        answer = answered(harness, graph.set(ELBOW, {"gains.p": value}))
        line = "no answer within 0.5 s: it may have been taken"
        assert answer == Answer(False, line, is_certain=False)
        os.kill(process.pid, signal.SIGCONT)
        until = time.monotonic() + 10.0

        def is_shown():
            return graph.controllers()[ELBOW].values["gains.p"] == value

        harness.wait(lambda: is_shown() or time.monotonic() > until)
        return is_shown()

    harness.wait(takes_late)


class Forgetful:
    """A controller that is set while it answers what its parameters are, and that tells late."""

    NAME = "/late_controller"

    def __init__(self, harness):
        self.node = Node(self.NAME[1:], context=harness.context, start_parameter_services=False)
        harness.executor.add_node(self.node)
        self.values = {
            **{name: each.default for name, each in PARAMETERS.items()},
            **loop_settings("elbow").to_parameters(),
            **{"robot_description": "", "introspection_rate": 20.0, "require_certificate": False},
        }
        self.told = []  # while it answers
        self._events = self.node.create_publisher(
            ParameterEvent, "/parameter_events", qos_profile_parameter_events
        )
        self._diagnostics = Diagnostics(self.node, "elbow")
        self.node.create_service(GetParameters, f"{self.NAME}/get_parameters", self._answer)

    def _answer(self, request, response):
        values = [self._message(name).value for name in request.names]
        if self.told:
            self.values["gains.p"] = self.told.pop()
            changed = [self._message("gains.p")]
            self._events.publish(ParameterEvent(node=self.NAME, changed_parameters=changed))
        response.values = values
        return response

    def _message(self, name):
        return parameter(name, self.values[name]).to_parameter_msg()

    def tell_health(self, samples=0):
        figures = {"samples": samples, "missed samples": 0, "certified degrees": "none"}
        self._diagnostics.publish(OK, "", figures)


@pytest.fixture
def late(harness, graph):
    made = Forgetful(harness)
    harness.wait(lambda: made.NAME in graph.controllers(), what="it")
    return made


def has_gain(harness, graph, value):
    seen = graph.controllers
    harness.wait(lambda: seen()[Forgetful.NAME].values["gains.p"] == value, within=15.0)


def test_what_was_read_before_a_set_does_not_hide_it(harness, graph):
    made = Forgetful(harness)
    made.told = [111.0]
    harness.wait(lambda: made.NAME in graph.controllers(), what="it")
    has_gain(harness, graph, 111.0)


@pytest.mark.parametrize("was_silent", [True, False])
def test_a_controller_that_may_be_another_process_is_read_again(
    harness, graph, late, monkeypatch, was_silent
):
    """As it was not heard for a while, or has counted fewer samples than before."""
    monkeypatch.setattr(graph_client, "SILENT_AFTER", 60.0)

    def is_told(samples):
        late.tell_health(samples)
        health = graph.controllers()[late.NAME].health
        return health is not None and health.values["samples"] == str(samples)

    harness.wait(lambda: is_told(100))
    late.values["gains.p"] = 112.0  # and nobody hears of it
    until = time.monotonic() + 0.5
    harness.wait(lambda: is_told(101) and time.monotonic() > until)
    assert graph.controllers()[late.NAME].values["gains.p"] != 112.0
    if was_silent:
        monkeypatch.setattr(graph_client, "SILENT_AFTER", 0.0)
    harness.wait(lambda: is_told(102 if was_silent else 7))
    has_gain(harness, graph, 112.0)
