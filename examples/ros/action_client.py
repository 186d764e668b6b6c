"""A goal for ``follow_joint_trajectory``, as MoveIt sends it, and how it ends.

    ros2 run hpid_ros follow_joint_trajectory --ros-args -p joints:="[shoulder, elbow]"
    python examples/ros/action_client.py

The action's messages are those of control_msgs, which ROS has and PyPI has not: without them, or
without a server, one line says so.
"""

import sys

import rclpy
from rclpy.action import ActionClient
from rclpy.duration import Duration
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

try:
    from control_msgs.action import FollowJointTrajectory
except ImportError:
    print("control_msgs is not installed (ros-jazzy-control-msgs): no goal can be sent")
    sys.exit()

SERVER = "joint_trajectory_controller/follow_joint_trajectory"
JOINTS, WAYPOINTS = ["shoulder", "elbow"], {2.0: [0.4, -0.2], 4.0: [0.0, 0.0]}  # [s]: [rad]


def goal():
    """Return the goal: positions alone, which are joined linearly."""
    points = [
        JointTrajectoryPoint(positions=positions, time_from_start=Duration(seconds=time).to_msg())
        for time, positions in WAYPOINTS.items()
    ]
    wanted = FollowJointTrajectory.Goal()
    wanted.trajectory = JointTrajectory(joint_names=JOINTS, points=points)
    return wanted


def main():
    """Send the goal, tell the largest error on the way, and how it ended."""
    node = rclpy.create_node("goal_sender")
    client = ActionClient(node, FollowJointTrajectory, SERVER)
    if not client.wait_for_server(timeout_sec=3.0):
        print(f"no server of {SERVER}")
        return
    errors = [0.0]

    def on_feedback(message):
        errors.extend(map(abs, message.feedback.error.positions))

    sending = client.send_goal_async(goal(), feedback_callback=on_feedback)
    rclpy.spin_until_future_complete(node, sending)
    handle = sending.result()
    if not handle.accepted:
        print("the goal was refused: the server's log says why")
        return
    ending = handle.get_result_async()
    rclpy.spin_until_future_complete(node, ending)
    result = ending.result().result
    reason = result.error_string or "it succeeded"
    print(f"ended with {result.error_code}: {reason}; largest error {max(errors):.4f} rad")


if __name__ == "__main__":
    rclpy.init()
    main()
    rclpy.shutdown()
