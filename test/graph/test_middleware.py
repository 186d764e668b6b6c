"""What rclpy keeps to itself, and qualities of service: newest commands, overrides of a topic."""

import itertools
import time
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest
from harness.graph import ros_arguments
from rcl_interfaces.srv import GetParameters
from rclpy.duration import Duration
from rclpy.experimental import EventsExecutor
from rclpy.lifecycle import LifecycleNode
from rclpy.parameter import Parameter
from rclpy.qos import ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Empty
from std_srvs.srv import Trigger

from hpid_ros.base.errors import SettingError
from hpid_ros.nodes.core import middleware, rclpy_internals
from hpid_ros.nodes.core.executor import ClosingNode
from hpid_ros.nodes.core.middleware import NEWEST_STATES, OFFERED, overridable, steady_timer

MS = 1_000_000


@pytest.fixture
def node(module_harness):
    node = LifecycleNode(
        "watched",
        context=module_harness.context,
        parameter_overrides=[Parameter("given", value=1)],
    )
    yield node
    node.destroy_node()


def test_what_is_given_for_a_parameter_is_what_it_is_declared_with(node):
    given = rclpy_internals.given_parameters(node)
    assert given["given"].value == 1
    given["given"] = Parameter("given", value=2.5)
    node.declare_parameter("given", 0.0)
    assert node.get_parameter("given").value == 2.5


def test_the_state_is_that_of_the_lifecycle(node):
    assert rclpy_internals.lifecycle_state(node) == "unconfigured"
    node.trigger_configure()
    assert rclpy_internals.lifecycle_state(node) == "inactive"


def test_a_service_answers_with_what_it_was_given(node):
    service = node.create_service(Trigger, "~/ask", lambda request, response: "as made")
    assert rclpy_internals.service_callback(service)(None, None) == "as made"
    rclpy_internals.answer_with(service, lambda request, response: "replaced")
    assert rclpy_internals.service_callback(service)(None, None) == "replaced"


def test_matches_are_counted_when_they_happen_and_never_forgotten(node):
    """Also where nobody spins, and one subscription has taken another's place."""
    publisher = node.create_publisher(Empty, "~/topic", 1)
    count = rclpy_internals.MatchCounter(publisher)
    assert count() == (0, 0)
    for matches in (1, 2, 3):
        subscription = node.create_subscription(Empty, "~/topic", print, 1)
        assert (*count(), publisher.get_subscription_count()) == (matches, 1, 1)
        node.destroy_subscription(subscription)
        assert (*count(), publisher.get_subscription_count()) == (matches, 0, 0)


def test_a_timer_that_is_reset_again_and_again_leaves_the_others_alone(node):
    """Others were called as often as it had been reset meanwhile, and rested as many periods."""
    executor, period, calls = EventsExecutor(context=node.context), 0.1, []
    begun = time.monotonic()
    steady_timer(node, period, lambda: calls.append(time.monotonic()))
    rearmed = steady_timer(node, 10.0, lambda: None, is_rearmed=True)
    executor.add_node(node)

    def reset_again():
        rearmed.reset()
        if not calls:
            executor.create_task(reset_again)

    for _ in range(50):
        executor.create_task(reset_again)
    while not calls or time.monotonic() - calls[0] < period / 2.0:
        executor.spin_once(timeout_sec=period)
    assert len(calls) <= (time.monotonic() - begun) / period
    executor.shutdown()


def test_all_nodes_of_a_process_wait_for_acknowledgements_as_long_as_one_of_them_would(
    monkeypatch,
):
    publisher, granted, now = MagicMock(), [], itertools.count(0.0, 0.1)
    publisher.wait_for_all_acked = granted.append
    monkeypatch.setattr(middleware.time, "monotonic", lambda: next(now))
    middleware._acknowledged_by.cache_clear()
    for _ in range(2):
        middleware.wait_until_acknowledged(MagicMock(), publisher, "the last command")
    middleware._acknowledged_by.cache_clear()
    assert granted[1] < granted[0]


@pytest.mark.parametrize(("until", "ends_at"), [(0.0, 0.03), (0.4, 0.43), (9.0, 1.0)])
def test_a_node_goes_when_nobody_has_come_or_gone_for_a_while(monkeypatch, until, ends_at):
    now = 0.0

    def sleep(seconds):
        nonlocal now
        now += seconds

    monkeypatch.setattr(middleware, "time", SimpleNamespace(monotonic=lambda: now, sleep=sleep))
    node = MagicMock()
    node.get_topic_names_and_types = lambda no_demangle: min(now, until)
    node.destroy_node = lambda: node.ended(now)
    middleware.destroy_when_quiet(node)
    node.ended.assert_called_once_with(pytest.approx(ends_at, abs=0.011))


@pytest.mark.parametrize(
    ("use", "lacks"),
    [
        (rclpy_internals.given_parameters, "_parameter_overrides"),
        (rclpy_internals.lifecycle_state, "_state_machine"),
        (rclpy_internals.service_callback, "callback"),
        (lambda owner: rclpy_internals.answer_with(owner, print), "callback"),
    ],
)
def test_another_rclpy_that_lacks_it_is_named(use, lacks):
    class Other:
        """Of a version that has nothing of this."""

    with pytest.raises(SettingError, match=rf"Other has no {lacks}; known to work is 7\.1"):
        use(Other())


@pytest.fixture
def overridden(harness):
    overrides = {
        "qos_overrides./a.publisher.depth": 7,
        "qos_overrides./a.publisher.lifespan": 50 * MS,
        "qos_overrides./a.subscription.reliability": "reliable",
    }
    node = ClosingNode(
        "overridden",
        context=harness.context,
        parameter_overrides=[Parameter(name, value=value) for name, value in overrides.items()],
    )
    yield node
    node.destroy_node()


def test_an_override_is_in_force_on_its_topic_alone(overridden):
    first, second = (
        overridden.create_publisher(
            JointState, topic, OFFERED, qos_overriding_options=overridable()
        )
        for topic in ("a", "b")
    )
    assert (first.qos_profile.depth, second.qos_profile.depth) == (7, OFFERED.depth)
    (told,) = overridden.get_publishers_info_by_topic("/a")
    assert told.qos_profile.lifespan == Duration(nanoseconds=50 * MS)
    (told,) = overridden.get_publishers_info_by_topic("/b")
    assert told.qos_profile.lifespan > Duration(seconds=10**6)
    heard = [
        overridden.create_subscription(
            JointState, topic, print, NEWEST_STATES, qos_overriding_options=overridable()
        )
        for topic in ("a", "b")
    ]
    policies = [each.qos_profile.reliability for each in heard]
    assert policies == [ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT]


@pytest.mark.parametrize(
    ("interface", "depth"), [("float64_multi_array", 1), ("float64", 1), ("joint_state", 4000)]
)
def test_a_driver_is_sent_the_newest_command_and_a_recorder_all_of_them(harness, interface, depth):
    topic = {"joint_state": "/joint_commands", "float64": "/elbow_controller/command"}
    topic = topic.get(interface, "/elbow_controller/commands")
    name = f"qos_overrides.{topic}.publisher.depth"
    harness.processes.start(
        "elbow_controller",
        "joint_controller",
        ros_arguments(joint="elbow", command_interface=interface, claim="none"),
    )
    request = GetParameters.Request(names=[name])
    answer = harness.call(GetParameters, "elbow_controller/get_parameters", request)
    assert [value.integer_value for value in answer.values] == [depth]
