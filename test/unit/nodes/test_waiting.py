"""What is told of a wait: the words for what the graph shows, and when they are logged."""

from unittest.mock import MagicMock

import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.nodes.core.waiting import (
    PUBLISHER,
    SUBSCRIBER,
    Endpoint,
    SeenJoints,
    TopicView,
    Wait,
    Waiting,
    described,
    fits,
    qos_misfit,
    type_name,
    unseen,
)

STATE, TEXT = "sensor_msgs/msg/JointState", "std_msgs/msg/String"
HINT = "is a namespace or a remapping missing?"


def view(*ends, role=PUBLISHER, **known):
    return TopicView("/a/joint_states", STATE, role, ends, **known)


@pytest.mark.parametrize(
    ("seen", "line", "does_fit"),
    [
        (view(), "/a/joint_states has no publisher", False),
        (view(role=SUBSCRIBER), "/a/joint_states has no subscriber", False),
        (
            view(elsewhere=("/joint_states",), empty_domain=7),
            "/a/joint_states has no publisher; publishers are on /joint_states: "
            f"{HINT}; no other node is seen in the domain 7 (ROS_DOMAIN_ID)",
            False,
        ),
        (
            view(elsewhere=tuple(f"/{n}" for n in range(7))),
            "/a/joint_states has no publisher; publishers are on "
            f"/0, /1, /2, /3, /4 and 2 more: {HINT}",
            False,
        ),
        (
            view(Endpoint("/driver", STATE), Endpoint("/gripper", STATE)),
            "/a/joint_states has 2 publishers (/driver, /gripper)",
            True,
        ),
        (
            view(Endpoint("/driver", TEXT), Endpoint("/driver", TEXT)),
            f"/a/joint_states has 2 publishers (/driver); /driver publishes {TEXT}, not {STATE}",
            False,
        ),
        (
            view(Endpoint("/robot", TEXT), role=SUBSCRIBER),
            f"/a/joint_states has 1 subscriber (/robot); /robot subscribes to {TEXT}, not {STATE}",
            False,
        ),
        (
            view(Endpoint("/driver", STATE, "offers best effort"), Endpoint("/other", STATE)),
            "/a/joint_states has 2 publishers (/driver, /other); /driver offers best effort",
            True,
        ),
        (TopicView("/x", "", PUBLISHER, (Endpoint("/a", TEXT),)), "/x has 1 publisher (/a)", True),
    ],
)
def test_a_topic_is_described_by_who_is_there_and_what_does_not_fit(seen, line, does_fit):
    assert described(seen) == line
    assert fits(seen) is does_fit


@pytest.mark.parametrize(
    ("joints", "seen", "line"),
    [
        (["elbow"], [], ""),
        (["elbow"], ["elbow"], ""),
        (["elbow"], ["wheel"], "joints seen there: wheel"),
        (
            ["elbow"],
            ["wheel", "elbow_joint"],
            "joints seen there: elbow_joint, wheel; did you mean 'elbow_joint'?",
        ),
        (
            ["elbow", "x", "wrist"],
            ["l_elbow", "l_wrist", "x"],
            "joints seen there: l_elbow, l_wrist; "
            "did you mean 'l_elbow' for elbow, 'l_wrist' for wrist?",
        ),
        (["q"], [f"j{n:02}" for n in range(12)], None),
    ],
)
def test_joints_that_were_seen_instead_are_named_with_what_was_meant(joints, seen, line):
    if line is None:
        line = f"joints seen there: {', '.join(seen[:10])} and 2 more"
    assert unseen(joints, seen) == line


RELIABLE, BEST_EFFORT = (
    QoSProfile(depth=1, reliability=each)
    for each in (ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT)
)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@pytest.mark.parametrize(
    ("offered", "asked", "by_this_node", "line"),
    [
        (RELIABLE, BEST_EFFORT, False, ""),
        (LATCHED, RELIABLE, False, ""),
        (
            BEST_EFFORT,
            RELIABLE,
            False,
            "offers best effort, this node asks for reliable delivery",
        ),
        (BEST_EFFORT, RELIABLE, True, "asks for reliable delivery, this node offers best effort"),
        (
            RELIABLE,
            LATCHED,
            False,
            "offers volatile durability, this node asks for transient local durability",
        ),
    ],
)
def test_a_quality_of_service_that_lets_nothing_pass_is_named(offered, asked, by_this_node, line):
    assert qos_misfit(offered, asked, by_this_node=by_this_node) == line


def test_a_message_type_has_the_name_that_the_graph_gives_it():
    assert type_name(JointState) == STATE


def test_joints_are_remembered_from_each_message_that_was_looked_at():
    seen = SeenJoints()
    for names in (["a", "b"], ["c"]):
        seen.newest = JointStateTemplate(names, position=True).encode(
            1, position=[0.0] * len(names)
        )
        known = seen.names()
    assert known == {"a", "b", "c"}
    seen.newest = b"no state"
    assert seen.names() == {"a", "b", "c"}
    assert seen.newest is None


class Log:
    """A node's log, and waits whose sources the test sets."""

    def __init__(self, *waits):
        self.lines, self.waits, self.looks = [], list(waits), []
        node = MagicMock()
        node.get_logger().warning = node.get_logger().info = self.lines.append
        self.waiting = Waiting(node)
        for at in range(len(waits)):
            self.waiting.add(lambda at=at: self.waits[at])

    def at(self, *times):
        """Return the lines that looks at these times log."""
        del self.lines[:]
        for now in times:
            self.waiting.look(now)
        return list(self.lines)


def wait(*joints, what="states", **changes):
    def found(joints):
        return f"nothing of {len(joints)}"

    return Wait(what, "come", "/joint_states", found, joints)._replace(**changes)


def test_a_wait_is_told_once_after_its_patience_and_its_end_with_how_long_it_took():
    log = Log(wait("a"))
    assert log.at(0.0, 1.0, 1.9) == []
    assert log.at(2.0, 3.0, 99.0) == ["waiting for states of a: nothing of 1"]
    log.waits = [None]
    assert log.at(112.3, 113.0) == ["states of a come now, after 112.3 s"]


def test_a_short_wait_and_one_that_was_given_up_are_not_told_to_be_over():
    log = Log(wait("a"))
    log.at(0.0, 1.0)
    log.waits = [None]
    assert log.at(1.5) == []
    log.waits = [wait("a", has_come=lambda: False)]
    assert len(log.at(10.0, 12.0)) == 1
    log.waits = [None]
    assert log.at(13.0) == []


def test_joints_that_wait_for_the_same_are_one_line_and_other_waits_others():
    log = Log(wait("a"), wait("b"), wait("c", what="commands"), None)
    assert log.at(0.0, 2.0) == [
        "waiting for states of a, b: nothing of 2",
        "waiting for commands of c: nothing of 1",
    ]
    log.waits = [None, wait("b"), None, None]
    assert log.at(5.0) == ["commands of c come now, after 5.0 s"]
    log.waits = [None] * 4
    assert log.at(6.0) == ["states of a, b come now, after 6.0 s"]


def test_what_flaps_is_told_ever_more_rarely():
    log, now = Log(wait("a")), 0.0
    for patience in (2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 64.0):
        log.waits = [wait("a")]
        assert log.at(now, now + patience - 0.1) == []
        assert len(log.at(now + patience)) == 1
        log.waits = [None]
        now += patience + 1.0
        assert len(log.at(now)) == 1
        now += 1.0


def test_it_looks_only_while_there_is_something_to_wait_for():
    log = Log(wait("a"))
    node = log.waiting._node
    log.waiting.begin()
    log.waiting.begin()
    node.create_timer.assert_called_once()
    log.at(0.0)
    node.destroy_timer.assert_not_called()
    log.waits = [None]
    log.at(1.0)
    node.destroy_timer.assert_called_once()
    log.waiting.begin()
    assert node.create_timer.call_count == 2
