"""What rclpy keeps to itself: the real one has it; its absence is one line, not a traceback."""

import time

import pytest
from rclpy.experimental import EventsExecutor
from rclpy.lifecycle import LifecycleNode
from rclpy.parameter import Parameter
from std_msgs.msg import Empty
from std_srvs.srv import Trigger

from hpid_ros.base.errors import SettingError
from hpid_ros.nodes.core import rclpy_internals
from hpid_ros.nodes.core.middleware import steady_timer


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
