"""Controllers of one process that read each state once and answer it with one message."""

import threading
from unittest.mock import MagicMock

from harness.graph import Told, change, ros_arguments
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64

from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.nodes.parts.joint_topics import SharedTopics

MS = 1_000_000
JOINTS = ("elbow", "wrist")


def start(harness, *more):
    """Start two controllers in one process with shared states."""
    arguments = ros_arguments(share_messages=True, law="pid", gains__p=10.0, state_watchdog=False)
    arguments += ["-p", "joints:=[elbow, wrist]", *more]
    name = "joint_controllers"
    return harness.processes.start(name, name, arguments, is_renamed=False)


def tell(harness, stamp_ns, position, publisher=None):
    """Publish one state of both joints."""
    template = JointStateTemplate(JOINTS, position=True, velocity=True)
    raw = template.encode(stamp_ns, position=[position] * 2, velocity=[0.0] * 2)
    (publisher or harness.states).publish(raw)


def answers(harness, stamp_ns):
    """Return the efforts that answer a state, by joint."""
    given = [each for each in harness.commands if each.stamp_ns == stamp_ns]
    return {
        name: effort
        for each in given
        for name, effort in zip(each.names, each.effort, strict=True)
    }


def listeners(harness):
    return harness.states.get_subscription_count()


def test_one_subscription_serves_every_joint_whatever_the_others_do(harness):
    start(harness)
    harness.wait(lambda: listeners(harness) > 0, what="the process to listen")
    tell(harness, 0, 0.5)
    harness.wait(lambda: len(answers(harness, 0)) == 2, what="both joints")
    assert listeners(harness) == 1
    assert [each.names for each in harness.commands if each.stamp_ns == 0] == [JOINTS]
    topic = harness.states.topic_name.rpartition("/")[0] + "/joint_commands"
    assert harness.node.count_publishers(topic) == 1

    assert change(harness, "deactivate", "elbow_controller")
    harness.commands.clear()
    tell(harness, MS, 0.25)
    harness.wait(lambda: answers(harness, MS).get("wrist") == 2.5, what="the other joint alone")
    assert "elbow" not in answers(harness, MS)

    assert change(harness, "activate", "elbow_controller")
    stamps = iter(range(2 * MS, 100_000 * MS, MS))

    def is_answered_for_both():
        stamp_ns = next(stamps)
        tell(harness, stamp_ns, 0.25)
        return any(len(answers(harness, each.stamp_ns)) == 2 for each in harness.commands[-4:])

    harness.wait(is_answered_for_both, what="both joints again")
    assert listeners(harness) == 1
    for joint in JOINTS:
        assert change(harness, "deactivate", f"{joint}_controller")
    harness.wait(lambda: listeners(harness) == 0, what="nobody to listen")


def test_no_state_is_read_before_every_joint_is_ready(harness):
    told = Told(harness, "wrist_controller")
    start(harness, "-p", "elbow_controller:wait_for_reference:=true")
    harness.wait(lambda: "first state" in told.newest().get("message", ""), what="the wrist")
    assert listeners(harness) == 0
    setpoint = harness.node.create_publisher(Float64, "elbow_controller/setpoint", 10)
    harness.wait(lambda: setpoint.get_subscription_count() > 0, what="the elbow")
    setpoint.publish(Float64(data=0.5))
    harness.wait(lambda: listeners(harness) == 1, what="the process to listen")
    tell(harness, 0, 0.5)
    harness.wait(lambda: len(answers(harness, 0)) == 2, what="both joints")


def test_what_has_a_topic_of_its_own_is_not_shared(harness):
    """The elbow's states, the wrist's commands; the other topic of each is the shared one."""
    remaps = ("elbow_controller:joint_states:=states", "wrist_controller:joint_commands:=efforts")
    start(harness, *(part for remap in remaps for part in ("-r", remap)))
    others = harness.node.create_publisher(JointState, "states", qos_profile_sensor_data)
    taken = []
    harness.node.create_subscription(JointState, "efforts", taken.append, qos_profile_sensor_data)
    harness.wait(lambda: listeners(harness) == 1, what="the wrist to listen")
    harness.wait(lambda: others.get_subscription_count() == 1, what="the elbow to listen")
    tell(harness, 0, 0.5)
    harness.wait(lambda: taken, what="the wrist")
    assert [list(each.name) for each in taken] == [["wrist"]]
    assert not answers(harness, 0)
    tell(harness, MS, 0.5, others)
    harness.wait(lambda: answers(harness, MS), what="the elbow")
    assert set(answers(harness, MS)) == {"elbow"}
    tell(harness, 2 * MS, 0.5)
    harness.wait(lambda: len(taken) > 1, what="the wrist again")
    assert {tuple(each.name) for each in taken} == {("wrist",)}
    assert not answers(harness, 2 * MS)


def test_efforts_that_answer_no_state_go_out_at_once_and_end_in_zeros(harness):
    watched = ("state_watchdog:=true", "state_timeout:=0.2", "fallback_effort:=1.5")
    process = start(harness, *(part for each in watched for part in ("-p", each)))
    stamps = iter(range(0, 100_000 * MS, MS))

    def are_answered():
        tell(harness, next(stamps), 0.5)
        return {name: after_ns for name, (after_ns, _) in last(harness).items()} == answered

    # A stall is a silence, after which the fallback stays in force: the stamps tell what answers.
    answered, fallen_back = dict.fromkeys(JOINTS, 0), dict.fromkeys(JOINTS, (1, 1.5))
    harness.wait(are_answered, what="both joints")
    harness.wait(lambda: last(harness) == fallen_back, what="silence")
    harness.wait(are_answered, what="answers again")
    harness.commands.clear()
    process.process.terminate()
    zeros = dict.fromkeys(JOINTS, 0.0)
    harness.wait(
        lambda: {name: effort for name, (_, effort) in last(harness).items()} == zeros,
        what="zeros",
    )


def last(harness):
    """Return of each joint's newest command its stamp's distance from a state and its effort."""
    return {
        name: (each.stamp_ns % MS, effort)
        for each in harness.commands
        for name, effort in zip(each.names, each.effort, strict=True)
    }


def test_what_another_thread_gives_takes_the_place_of_an_answer_that_waits(harness):
    shared = SharedTopics(harness.node)
    elbow, wrist = (shared.sink(harness.node, joint, "/robot#1") for joint in JOINTS)

    def take(raw):
        elbow.send(MS, 3.0)
        supervisor = threading.Thread(target=elbow.send, args=(MS + 1, 0.0))
        supervisor.start()
        supervisor.join()
        wrist.send(MS, 4.0)

    controller = MagicMock(guarded=lambda topic, callback: callback)
    shared.listen(controller, take)
    harness.wait(lambda: listeners(harness) > 0, what="the subscription to match")
    tell(harness, 0, 0.5)
    harness.wait(lambda: len(harness.commands) == 2, what="the answers")
    wrist.send(2 * MS, 5.0)
    harness.wait(lambda: len(harness.commands) == 3, what="all that was sent")
    sent = [(each.stamp_ns, tuple(each.names), tuple(each.effort)) for each in harness.commands]
    assert sent == [
        (MS + 1, ("elbow",), (0.0,)),
        (MS, ("wrist",), (4.0,)),
        (2 * MS, ("wrist",), (5.0,)),
    ]
