"""Quality of service, Fast DDS's profile, and steady timers.

Publishers are reliable, so that any subscriber may ask for either; controllers and bridge
subscribe with best effort, which costs a third less per sample and loses nothing on one
machine. A recorder asks for reliability; the depth of the publishers is what it may fall
behind. What goes to a driver has no such depth: late commands are worse than none. Every profile
can be overridden by the standard ``qos_overrides`` parameters.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator
from enum import Enum
from functools import cache
from threading import Lock
from weakref import WeakKeyDictionary

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from rclpy.topic_endpoint_info import TopicEndpointInfo
from sensor_msgs.msg import JointState

from hpid_ros.base.names import PROFILE_FILES
from hpid_ros.base.resources import ResourceError, find_resource

_CLOCKS: WeakKeyDictionary[Node, Clock] = WeakKeyDictionary()


def steady_timer(
    node: Node, period: float, callback: Callable[[], object], *, is_rearmed: bool = False
) -> Timer:
    """Return a running timer on the steady clock.

    A node's own timers follow its ROS clock: they wait when the time is set back, and
    with ``use_sim_time`` while the simulation stands still.
    """
    # The executor has a thread for each clock, and warns from eight timers of one clock on, which
    # the controllers of a few joints have together: so there is one for each node. A timer that is
    # reset often has its own: with each reset EventsExecutor looks at all timers of that clock,
    # calls one that is due as often as it has looked, and lets it rest as many periods.
    own = Clock(clock_type=ClockType.STEADY_TIME)
    clock = own if is_rearmed else _CLOCKS.setdefault(node, own)
    return node.create_timer(period, callback, clock=clock)


_LOCK_WITHIN = 0.2  # [s]; whoever holds it longer is stuck in the middleware, as we would be


@contextlib.contextmanager
def held(lock: Lock) -> Iterator[bool]:
    """Hold a lock while a block runs, which gets False where its holder is stuck."""
    is_held = lock.acquire(timeout=_LOCK_WITHIN)
    try:
        yield is_held
    finally:
        if is_held:
            lock.release()


_BEHIND_AT_MOST = 4000  # messages that a reliable subscriber may fall behind
_STATES_AT_ONCE = 5  # that a controller may fall behind before it forgets the oldest
_COMMANDS_AT_ONCE = 256  # joints that may answer one state before the bridge has looked

# What a profile leaves out is as rmw has it: the last ones are kept, reliable and volatile.

OFFERED = QoSProfile(depth=_BEHIND_AT_MOST)
"""States and commands, as they are published."""

NEWEST_COMMAND = QoSProfile(depth=1)
"""Commands for a driver, as they are published: what is sent again after a loss is the newest.

It matches the subscribers of ros2_control (best effort), of Isaac Sim and of ros_gz_bridge (both
reliable and volatile).
"""

NEWEST_STATES = QoSProfile(depth=_STATES_AT_ONCE, reliability=ReliabilityPolicy.BEST_EFFORT)
"""States, as a controller takes them: a hiccup is caught up, anything older is the past."""

ALL_STATES = QoSProfile(depth=_BEHIND_AT_MOST, reliability=ReliabilityPolicy.BEST_EFFORT)
"""States, for who must not miss the first."""

NEWEST_REFERENCE = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""References of controllers: who has fallen behind looks at none that is old."""

ALL_COMMANDS = QoSProfile(depth=_COMMANDS_AT_ONCE, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Commands, as the bridge takes them."""

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""The reference: subscribers that come later get it too."""

RARE = QoSProfile(depth=10)
"""Messages that come rarely: setpoints, diagnostics, poses."""


def overridable() -> QoSOverridingOptions:
    """Return the option that lets ``qos_overrides`` parameters replace a profile.

    History, depth and reliability, as by default; of a publisher also the lifespan in [ns]. Fast
    DDS sends a message that is older than that no more, and does not take back what a
    subscriber has got; other middlewares do, by the clock of the subscriber's host. It is not
    limited by default: a last zero is worth being sent again.
    """
    kinds = QoSPolicyKind
    return QoSOverridingOptions((kinds.HISTORY, kinds.DEPTH, kinds.RELIABILITY, kinds.LIFESPAN))


def declare_overrides(node: Node, topic: str, profile: QoSProfile) -> None:
    """Declare the overrides of a subscription that is made later, as rclpy does when it is.

    Dumps of parameters have them, and what is given for them is read, whether it is there or not.
    """
    full = node.resolve_topic_name(topic)
    for kind in overridable().policy_kinds:
        policy = kind.name.lower()
        name = f"qos_overrides.{full}.subscription.{policy}"
        if kind is QoSPolicyKind.LIFESPAN or node.has_parameter(name):
            continue
        value = getattr(profile, policy)
        described = ParameterDescriptor(description=f"{policy} on {full}", read_only=True)
        default = value.name.lower() if isinstance(value, Enum) else value
        node.declare_parameter(name, default, described)


def subscribe_raw(
    node: Node, topic: str, callback: Callable[[bytes], None], profile: QoSProfile
) -> Subscription:
    """Subscribe to joint states or commands as bytes, with a profile that can be overridden."""
    return node.create_subscription(
        JointState, topic, callback, profile, raw=True, qos_overriding_options=overridable()
    )


_ACKNOWLEDGED_WITHIN = 0.5  # [s]


@cache
def _acknowledged_by() -> float:
    """Return until when all nodes of a process wait that ends: as long as one of them would."""
    return time.monotonic() + _ACKNOWLEDGED_WITHIN


def wait_until_acknowledged(node: Node, publisher: Publisher, what: str) -> None:
    """Wait until every reliable subscriber has acknowledged what was sent last, for a while."""
    within = Duration(seconds=max(0.0, _acknowledged_by() - time.monotonic()))
    if not publisher.wait_for_all_acked(within):
        node.get_logger().warning(
            f"{what} was not acknowledged by every subscriber within {_ACKNOWLEDGED_WITHIN:g} s"
        )


_QUIET, _QUIET_WITHIN, _LOOK_PERIOD = 0.03, 1.0, 0.005  # [s]


def destroy_when_quiet(node: Node) -> None:
    """Destroy a context's last node while nobody comes or goes: Fast DDS could block for good.

    It waits for callbacks of discovery that are under way with a lock that they need
    (docs/faults.md). Where it is never quiet, the node is destroyed after a second.
    """
    begun = quiet_since = time.monotonic()
    known = _graph(node)
    while (now := time.monotonic()) < min(begun + _QUIET_WITHIN, quiet_since + _QUIET):
        time.sleep(_LOOK_PERIOD)
        if (found := _graph(node)) != known:
            known, quiet_since = found, now
    node.destroy_node()


def _graph(node: Node) -> tuple[object, ...]:
    return node.get_topic_names_and_types(no_demangle=True), node.get_node_names_and_namespaces()


UNNAMED = "_NODE_NAME_UNKNOWN_"
"""What rmw calls a node that has not published its endpoints yet."""


def full_name(endpoint: TopicEndpointInfo) -> str:
    """Return the full name of the node that has a publisher or a subscription."""
    return f"{endpoint.node_namespace.rstrip('/')}/{endpoint.node_name}"


def load_profile() -> None:
    """Let Fast DDS load ``config/fastdds_nodes.xml``, and leave shared memory out.

    Nothing is changed where the user named a file of profiles or transports. In shared memory a
    process that is killed stalls the discovery of all others, or ends it (docs/faults.md); sockets
    go with their process. To be called before the middleware is loaded; other ones ignore both.
    Without the file acknowledgements take longer: no reason to end.
    """
    if any(os.environ.get(name) for name in PROFILE_FILES):
        return
    os.environ.setdefault("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")
    with contextlib.suppress(ResourceError):
        profile = str(find_resource("config/fastdds_nodes.xml"))
        os.environ.update(dict.fromkeys(PROFILE_FILES, profile))


def has_shared_memory_alone() -> bool:
    """Return whether the nodes of this process reach no other host and no other user.

    As in the closed mode of docs/security.md: Fast DDS talks through shared memory alone, and does
    not meet those that talk through a network, even in the same domain of the same host.
    """
    return (
        os.environ.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp").startswith("rmw_fastrtps")
        and os.environ.get("FASTDDS_BUILTIN_TRANSPORTS") == "SHM"
        and os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET") == "SUBNET"
        and os.environ.get("ROS_LOCALHOST_ONLY", "0") != "1"
    )
