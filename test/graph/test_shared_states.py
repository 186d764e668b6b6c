"""Controllers of one process that read each state once."""

from harness.graph import ros_arguments
from harness.health import Told, change
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64

from hpid_ros.wire import JointStateTemplate

MS = 1_000_000
JOINTS = ("elbow", "wrist")


def start(harness, *more):
    """Start two controllers in one process with shared states."""
    arguments = ros_arguments(share_states=True, law="pid", gains__p=10.0, state_watchdog=False)
    arguments += ["-p", "joints:=[elbow, wrist]", *more]
    name = "joint_controllers"
    return harness.processes.start(name, name, arguments, is_renamed=False)


def tell(harness, stamp_ns, position):
    """Publish one state of both joints."""
    template = JointStateTemplate(JOINTS, position=True, velocity=True)
    raw = template.encode(stamp_ns, position=[position] * 2, velocity=[0.0] * 2)
    harness.states.publish(raw)


def answers(harness, stamp_ns):
    """Return the efforts that answer a state, by joint."""
    return {
        each.names[0]: each.effort[0] for each in harness.commands if each.stamp_ns == stamp_ns
    }


def listeners(harness):
    return harness.states.get_subscription_count()


def test_one_subscription_serves_every_joint_whatever_the_others_do(harness):
    start(harness)
    harness.wait(lambda: listeners(harness) > 0, what="the process to listen")
    tell(harness, 0, 0.5)
    harness.wait(lambda: len(answers(harness, 0)) == 2, what="both joints")
    assert listeners(harness) == 1

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


def test_a_controller_with_another_topic_listens_to_that(harness):
    start(harness, "-r", "elbow_controller:joint_states:=others")
    others = harness.node.create_publisher(JointState, "others", qos_profile_sensor_data)
    harness.wait(lambda: listeners(harness) == 1, what="the wrist to listen")
    harness.wait(lambda: others.get_subscription_count() == 1, what="the elbow to listen")
    tell(harness, 0, 0.5)
    harness.wait(lambda: answers(harness, 0), what="the wrist")
    assert set(answers(harness, 0)) == {"wrist"}
