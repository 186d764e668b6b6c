"""A robot of one's own: a URDF, what it says, gains by its inertias, a motion under gravity.

On the command line the same is ``hpid robot FILE``, ``hpid gains`` and ``hpid compare``;
docs/robots/first_arm.md goes that way with a UR5.
"""

import numpy as np

from hpid_ros.control import Gains, JointLoop, LoopSettings
from hpid_ros.control.reference import Setpoint
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.dynamics import Dynamics
from hpid_ros.simulation.engine import record_run
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world import World

LINK = """
  <link name="{child}"><inertial><origin xyz="0 0 {reach}"/><mass value="{mass}"/>
    <inertia ixx="{inertia}" iyy="{inertia}" izz="0.001" ixy="0" ixz="0" iyz="0"/>
  </inertial></link>
  <joint name="{joint}" type="revolute"><parent link="{parent}"/><child link="{child}"/>
    <origin xyz="0 0 {offset}"/><axis xyz="0 1 0"/>
    <limit lower="-3" upper="3" effort="40" velocity="6"/><dynamics damping="0.2"/></joint>"""
UPPER = {"joint": "shoulder", "parent": "base", "child": "upper", "offset": 0.0}
LOWER = {"joint": "elbow", "parent": "upper", "child": "lower", "offset": 0.3}
URDF = (
    '<robot name="two_links"><link name="base"/>'
    + LINK.format(**UPPER, reach=0.15, mass=2.0, inertia=0.02)
    + LINK.format(**LOWER, reach=0.1, mass=1.0, inertia=0.005)
    + "</robot>"
)
TARGETS = {"shoulder": 0.6, "elbow": -0.9}  # [rad], from upright
CLOSED_LOOP_TIME = 0.08  # [s]


def gains(inertia):
    """Return gains that put the three poles of a joint's loop at -1 / CLOSED_LOOP_TIME."""
    rate = 1.0 / CLOSED_LOOP_TIME
    return Gains(p=3.0 * inertia * rate**2, i=inertia * rate**3, d=3.0 * inertia * rate)


robot = RobotDescription.load(URDF)
model = Dynamics(robot)
ranges = model.inertia_range(TARGETS, samples=100, seed=1)
weights = model.gravity_torques(TARGETS, TARGETS)
loops = []
for joint, target in TARGETS.items():
    inertia = ranges[joint]
    print(
        f"{joint:8} inertia {inertia.minimum:.4f} to {inertia.maximum:.4f} kg m^2, "
        f"its weight at the target {weights[joint]:+.2f} N m"
    )
    settings = LoopSettings(joint=joint, gains=gains(inertia.maximum), inertia=inertia.maximum)
    loops.append(JointLoop(settings))
    loops[-1].follow(Setpoint(target))

world = WorldSettings(
    robot_description=URDF,
    joints=tuple(TARGETS),
    engine="mujoco",
    physics_steps=1,
    fixed_base=True,
)
with World(world) as simulated:
    run = record_run(simulated, loops, periods=1500)
for column, joint in enumerate(TARGETS):
    error = np.abs(run.references - run.positions)[:, column]
    late = np.flatnonzero(error > 0.01)[-1] + 1
    print(
        f"{joint:8} within 0.01 rad after {late * 1e-3:.3f} s, holds with "
        f"{run.efforts[-1, column]:+.2f} N m"
    )
