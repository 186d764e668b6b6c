"""How one joint of the simulated robot settles for several degrees, without ROS.

The wrist starts 0.3 rad away from its setpoint; everything else is held where it is.
"""

import math

from hpid_ros.base.resources import find_resource
from hpid_ros.control import Gains, JointLoop, LoopSettings
from hpid_ros.control.reference import Setpoint
from hpid_ros.control.settings import EncoderSettings, NormSettings
from hpid_ros.simulation.engine import run_in_process
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world import World

JOINT, GAINS, INERTIA = "arm_joint_4", Gains(p=7.56, i=25.2, d=0.756), 0.0252
COUNTS = 16384  # of the encoder, per revolution


def response(degree):
    """Return time [s] and error [rad] of the joint for one degree."""
    settings = LoopSettings(
        joint=JOINT,
        gains=GAINS,
        mu=degree,
        norm=NormSettings(error_scale=0.3),
        inertia=INERTIA,
        encoder=EncoderSettings(encoder_resolution=math.tau / COUNTS),
    )
    loop = JointLoop(settings)
    loop.follow(Setpoint(0.3))
    samples = []
    world = WorldSettings(
        robot_description=str(find_resource("urdf/mobile_manipulator.urdf")),
        joints=(JOINT,),
        engine="mujoco",
        physics_steps=1,
        encoder_counts=COUNTS,
        fixed_base=True,
        gravity=0.0,
    )
    with World(world) as robot:
        run_in_process(robot, [loop], 2000, samples.append)
    return [(each.stamp_ns * 1e-9, 0.3 - each.positions[0]) for each in samples]


print("degree   overshoot    error after 1 s   error after 2 s")
for degree in (-0.2, -0.1, 0.0, 0.1, 0.2):
    errors = response(degree)
    overshoot = max(-error for _, error in errors)
    print(
        f"{degree:+.1f}      {overshoot:.4f} rad   {abs(errors[1000][1]):.5f} rad       "
        f"{abs(errors[-1][1]):.5f} rad"
    )
