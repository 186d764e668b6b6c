"""A trajectory by code, sent to the controllers of its joints.

    python examples/ros/send_trajectory.py

The message is latched: a controller that comes later, or is started again, gets it, too. Stamp 0
is *begin with your next state*. Each controller takes its own joint. Where nobody hears it within
PATIENCE this says so.
"""

import rclpy
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from hpid_ros.motion import minimum_jerk

PATIENCE = 0.5  # [s]
MOTION = minimum_jerk(
    times=[0.0, 1.5, 3.0], positions={"shoulder": [0.0, 0.4, 0.4], "elbow": [0.0, -0.2, 0.3]}
)


def message(motion):
    """Return a trajectory as its message."""
    return JointTrajectory(
        joint_names=list(motion.joint_names),
        points=[
            JointTrajectoryPoint(
                positions=list(point.positions),
                velocities=list(point.velocities),
                accelerations=list(point.accelerations),
                time_from_start=Duration(nanoseconds=point.time_from_start_ns).to_msg(),
            )
            for point in motion.points
        ],
    )


if __name__ == "__main__":
    rclpy.init()
    node = rclpy.create_node("planner")
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = node.create_publisher(JointTrajectory, "joint_trajectory", latched)
    publisher.publish(message(MOTION))
    rclpy.spin_once(node, timeout_sec=PATIENCE)
    takers = publisher.get_subscription_count()
    joints = ", ".join(MOTION.joint_names)
    print(f"{len(MOTION.points)} points for {joints}, heard by {takers or 'no'} controllers")
    publisher.wait_for_all_acked(Duration(seconds=PATIENCE))
    node.destroy_node()
    rclpy.shutdown()
