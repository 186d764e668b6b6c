"""A person grips and lets go through the bridge's service, and everybody hears of it."""

import math

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray
from harness.graph import ros_arguments
from std_srvs.srv import SetBool, Trigger

from hpid_ros.base.files import share_folder
from hpid_ros.experiment.in_process import write_document
from hpid_ros.nodes.core.middleware import RARE
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.kinematics import Kinematics

ARM = Kinematics(
    RobotDescription.load(share_folder() / "urdf" / "mobile_manipulator.urdf"), "payload"
)
FOLDED = [0.0, -0.6, 1.9, 0.0, math.pi - 1.3, 0.0]


def scene(mass):
    """Return a world with a brick between the fingers, on a shelf."""
    x, y, z = ARM.pose(FOLDED).position.tolist()
    return {
        "robot": {
            "description": "urdf/mobile_manipulator.urdf",
            "driven": list(ARM.joints),
            "initial_positions": dict(zip(ARM.joints, FOLDED, strict=True)),
            "fixed_base": True,
        },
        "scene": {
            "bricks": {"brick": {"size": [0.06] * 3, "position": [x, y, z], "mass": mass}},
            "supports": {"shelf": {"size": [0.1, 0.1, 0.02], "position": [x, y, z - 0.04]}},
        },
    }


def test_a_person_grips_lets_go_and_begins_anew(harness, tmp_path):
    events, poses = [], []
    node = harness.node
    node.create_subscription(
        DiagnosticArray, "grip_events", lambda each: events.extend(each.status), RARE
    )
    node.create_subscription(PoseArray, "brick_poses", poses.append, RARE)
    write_document(tmp_path / "world.yaml", scene(0.5))
    arguments = ros_arguments(
        world_file=tmp_path / "world.yaml",
        mode="realtime",
        control_rate=100.0,
        wait_for_subscribers=0,
    )
    harness.processes.start("mujoco_bridge", "mujoco_bridge", arguments)
    grip = node.create_client(SetBool, "mujoco_bridge/grip")
    hold = node.create_client(SetBool, "mujoco_bridge/pause")
    reset = node.create_client(Trigger, "mujoco_bridge/reset")
    harness.wait(
        lambda: poses and all(each.service_is_ready() for each in (grip, hold, reset)),
        what="the bridge and its bricks",
    )

    def call(client, request):
        future = client.call_async(request)
        harness.wait(future.done, what="an answer")
        return future.result()

    call(hold, SetBool.Request(data=True))
    call(reset, Trigger.Request())  # the arm has no controller and has begun to sink
    taken = call(grip, SetBool.Request(data=True))
    assert taken.success
    assert taken.message.startswith("brick grasped at 0.000 s")
    assert "nothing changed" in call(grip, SetBool.Request(data=True)).message
    assert call(grip, SetBool.Request(data=False)).message.startswith("brick released")
    harness.wait(lambda: len(events) == 2, what="both events")
    assert [(each.name, each.message) for each in events] == [
        ("brick", "grasped"),
        ("brick", "released"),
    ]
    assert float(events[0].values[0].value) < 0.005
    call(hold, SetBool.Request(data=False))
    harness.wait(lambda: poses and poses[-1].header.stamp.sec >= 1, what="the arm to sink")
    missed = call(grip, SetBool.Request(data=True))
    assert not missed.success
    assert "brick missed at" in missed.message
    assert "away, at most 0.015 m" in missed.message
    harness.wait(lambda: len(events) == 3, what="the miss")
    assert events[-1].level == b"\x01"
