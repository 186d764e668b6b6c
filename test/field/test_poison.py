"""Messages that ended nodes or filled their memory: each is refused, and the nodes go on."""

import time

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import WrenchStamped
from harness import poison
from harness.goals import SUCCEEDED, Client, Joints, goal_of, needs_control_msgs
from harness.graph import NAME, Told, ros_arguments
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.nodes.core.middleware import LATCHED, OFFERED, RARE

MS = 1_000_000
MOST_MEMORY = 700.0  # [MiB]; a node has some 120, rclpy makes 60 of a message of 1.6 MB
GARBAGE = [
    bytes(4),
    b"\0\1\0\0",
    b"\0\1\0\0" + b"\xff" * 64,
    b"\x07" * 64,
    b"\0\1\0\0" + bytes(99),
]


def send(harness, kind, topic, messages, qos=RARE):
    """Publish serialised messages once somebody subscribes."""
    publisher = harness.node.create_publisher(kind, topic, qos)
    harness.wait(publisher.get_subscription_count, what=f"a subscriber of {topic}")
    for raw in messages:
        publisher.publish(raw)
    return publisher


def test_a_controller_lives_and_answers_after_each(harness):
    started = harness.start_controller(law="pid", gains__p=10.0, gains__d=1.0)
    process = started.process
    told = Told(harness)
    harness.ask(0, 0.0)
    expected = harness.ask(MS, -0.1)
    trajectories = list(poison.trajectories("elbow").items())
    for number, (what, raw) in enumerate(trajectories[:1] + trajectories[-4:], 1):
        send(harness, JointTrajectory, "joint_trajectory", [raw], LATCHED if number % 2 else RARE)
        harness.wait(
            lambda number=number: told.count("refused references") >= number,
            what=f"the refusal of {what}",
        )
    before = told.count("rejected samples")
    states = poison.states("elbow").values()
    for raw in states:
        harness.states.publish(raw)
    harness.wait(lambda: told.count("rejected samples") > before, what="refused states")
    for kind, topic in (
        (Float64MultiArray, f"{NAME}/relay"),
        (DiagnosticStatus, "joint_commands/_claim_elbow"),
    ):
        send(harness, kind, topic, GARBAGE, LATCHED if kind is DiagnosticStatus else RARE)
    send(harness, Float64, f"{NAME}/setpoint", GARBAGE[:2])  # no longer one can be sent
    effort = harness.ask(2 * MS, -0.1)
    assert effort == pytest.approx(expected, rel=0.5)
    assert process.poll() is None
    assert poison.memory_of(process.pid) < MOST_MEMORY
    assert max(map(len, started.log.read_text().splitlines())) < 1500


@needs_control_msgs
def test_an_action_server_lives_and_follows_goals_after_each(harness):
    joints = Joints(harness)
    started = joints.start()
    client = Client(joints)
    none = goal_of({"shoulder": [], "elbow": []}, [])
    none.trajectory.points = [JointTrajectoryPoint() for _ in range(20_000)]
    none.trajectory.joint_names = ["shoulder", "elbow", *[""] * 20_000]
    status = client.follow(none)
    assert "must" in status[2] or "may have" in status[2]
    large = goal_of({"shoulder": [0.0], "elbow": [0.0]}, [1.0])
    large.trajectory.points[0].positions = [0.0] * 1_000_000
    rejected = [not client.send(large).accepted for _ in range(12)]
    assert 0 < sum(rejected) < 12  # 64 MiB of them are kept
    send(harness, JointTrajectory, "joint_trajectory", poison.trajectories("elbow").values())
    for raw in poison.states("elbow").values():
        harness.states.publish(raw)
    until = time.monotonic() + 60.0
    good = goal_of({"shoulder": [0.05], "elbow": [-0.05]}, [0.5])
    while (ended := client.follow(good))[0] != SUCCEEDED:  # the large ones are kept for a while
        assert time.monotonic() < until, ended
    for process in (started.action.process, started.controllers.process):
        assert process.poll() is None
        assert poison.memory_of(process.pid) < MOST_MEMORY


def test_a_merger_lives_and_merges_after_each(harness):
    arguments = ros_arguments(joints="[shoulder, elbow]")
    started = harness.processes.start("merger", "joint_command_merger", arguments)
    told, merged = Told(harness, "merger"), []
    harness.node.create_subscription(Float64MultiArray, "merger/commands", merged.append, OFFERED)
    commands = harness.node.create_publisher(JointState, "joint_commands", OFFERED)
    templates = {
        joint: JointStateTemplate([joint], f"/{joint}_controller", effort=True)
        for joint in ("shoulder", "elbow")
    }
    second = harness.node.create_publisher(JointState, "joint_commands", OFFERED)
    stamp_ns = 0

    def is_merged():
        nonlocal stamp_ns
        stamp_ns += MS
        for effort, (publisher, template) in enumerate(
            zip((commands, second), templates.values(), strict=True), 1
        ):
            publisher.publish(template.encode(stamp_ns, effort=[float(effort)]))
        return bool(merged) and list(merged[-1].data) == [1.0, 2.0]

    harness.wait(is_merged, what="merged commands")
    for topic, kind in (
        ("/diagnostics", DiagnosticArray),
        ("merger/commands/_claim_all_joints", DiagnosticStatus),
    ):
        qos = RARE if topic == "/diagnostics" else LATCHED
        if harness.node.count_subscribers(topic):
            send(harness, kind, topic, GARBAGE, qos)
    for raw in (*poison.states("elbow").values(), *GARBAGE):
        commands.publish(raw)
    harness.wait(
        lambda: is_merged() and told.count("misread commands") >= 5, what="refused commands"
    )
    merged.clear()
    harness.wait(is_merged, what="merged commands again")
    assert started.process.poll() is None
    assert poison.memory_of(started.process.pid) < MOST_MEMORY


def test_a_bridge_lives_and_steps_after_each(harness, experiment_file):
    world = experiment_file(duration=60.0)
    arguments = ros_arguments(world_file=world, mode="realtime", wait_for_publishers=0)
    started = harness.processes.start("mujoco_bridge", "mujoco_bridge", arguments)
    told = Told(harness, "mujoco_bridge")
    harness.wait(lambda: told.newest(), what="the bridge")
    commands = harness.node.create_publisher(JointState, "joint_commands", OFFERED)
    harness.wait(commands.get_subscription_count, what="the bridge to listen")
    for raw in (*poison.states("arm_joint_1").values(), *GARBAGE):
        commands.publish(raw)
    send(harness, WrenchStamped, "mujoco_bridge/wrench", GARBAGE)
    harness.wait(lambda: told.count("misread commands") >= 5, what="refused commands")
    before = float(told.newest()["simulated time [s]"])
    harness.wait(
        lambda: float(told.newest()["simulated time [s]"]) > before, what="the simulation to go on"
    )
    assert started.process.poll() is None
