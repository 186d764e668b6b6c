"""A second commander of a joint is named and not obeyed."""

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from harness.graph import ros_arguments
from sensor_msgs.msg import JointState

from hpid_ros.messages.joint_state import JointStateTemplate, decode_joint_state
from hpid_ros.nodes.core.middleware import OFFERED, RARE

COUNTED = {
    "commands of second senders, not obeyed",
    "commands for other joints",
    "misread commands",
}


def test_a_forger_beside_a_controller_is_named_and_not_obeyed(harness, faults):
    """Efforts beyond the limit, for foreign joints, without names, and for a joint that is led."""
    reports, efforts = [], []
    node = harness.node
    node.create_subscription(DiagnosticArray, "/diagnostics", reports.append, RARE)
    node.create_subscription(
        JointState,
        "joint_states",
        lambda raw: efforts.append(decode_joint_state(raw).effort[0]),
        OFFERED,
        raw=True,
    )
    harness.processes.start(
        "arm_joint_6_controller",
        "joint_controller",
        ros_arguments(joint="arm_joint_6", gains__p=1.0, u_clamp_max=1.0, u_clamp_min=-1.0),
    )
    harness.processes.start(
        "mujoco_bridge",
        "mujoco_bridge",
        ros_arguments(
            mode="realtime",
            joints="[arm_joint_6]",
            control_rate=100.0,
            fixed_base=True,
            command_timeout=5.0,  # a busy machine is no reason to follow the forger
            wait_for_publishers=1,
            wait_for_subscribers=2,
        ),
    )
    harness.wait(lambda: len(efforts) > 20, what="the controller at work")
    forger = node.create_publisher(JointState, "joint_commands", OFFERED)
    forged = JointStateTemplate(["arm_joint_6"], effort=True).encode(1, effort=[1e9])
    foreign = JointStateTemplate(["neck"], effort=True).encode(1, effort=[1.0])
    nameless = JointStateTemplate([], effort=True).encode(1)

    effortless = JointStateTemplate(["arm_joint_6"]).encode(1)

    def told():
        for message in (forged, foreign, nameless, effortless):
            forger.publish(message)
        faults.count("commands forged", 4)
        return next(
            (
                status
                for report in reports
                for status in report.status
                if status.name == "/mujoco_bridge" and "commanded twice" in status.message
                if all(int(each.value) for each in status.values if each.key in COUNTED)
            ),
            None,
        )

    harness.wait(told, what="the forger to be named")
    status = told()
    assert status.level == DiagnosticStatus.ERROR
    assert status.message == (
        "commanded twice: arm_joint_6 by /arm_joint_6_controller and /robot, "
        "following /arm_joint_6_controller"
    )
    values = {each.key: each.value for each in status.values}
    assert values.keys() >= COUNTED
    assert max(map(abs, efforts)) <= 1.0  # what the controller may command; the forger would 4
    count = len(efforts)
    harness.wait(lambda: len(efforts) > count + 20, what="the bridge to go on")
