"""A trajectory by code, followed by two joints of the simulated robot, without ROS.

Waypoints become a quintic of least jerk. The same object, encoded, is the message that nodes take:
examples/ros/send_trajectory.py.
"""

from hpid_ros.base.resources import find_resource
from hpid_ros.control import Gains, JointLoop, LoopSettings
from hpid_ros.motion import minimum_jerk
from hpid_ros.simulation.engine import record_run
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world import World

GAINS = {
    "arm_joint_4": Gains(p=7.56, i=25.2, d=0.756),
    "arm_joint_5": Gains(p=7.56, i=25.2, d=0.756),
}
MOTION = minimum_jerk(
    times=[0.0, 0.6, 1.0],  # [s]
    positions={"arm_joint_4": [0.0, 0.4, 0.3], "arm_joint_5": [0.0, -0.5, -0.5]},  # [rad]
)

world = WorldSettings(
    robot_description=str(find_resource("urdf/mobile_manipulator.urdf")),
    joints=tuple(GAINS),
    engine="mujoco",
    physics_steps=1,
    fixed_base=True,
    gravity=0.0,
)
loops = [JointLoop(LoopSettings(joint=joint, gains=gains)) for joint, gains in GAINS.items()]
for joint, loop in zip(GAINS, loops, strict=True):
    loop.follow(MOTION.column(joint))

with World(world) as robot:
    run = record_run(robot, loops, periods=1000)
for column, joint in enumerate(GAINS):
    error = abs(run.references - run.positions)[:, column]
    print(
        f"{joint}: at {run.positions[-1, column]:+.4f} rad, "
        f"largest error on the way {error.max():.4f} rad, at the end {error[-1]:.4f} rad"
    )
