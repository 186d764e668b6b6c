"""Worlds with the mobile manipulator at home, and a motion of it to the last bit."""

from harness.places import ROOT
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world import World

URDF = ROOT / "urdf" / "mobile_manipulator.urdf"
WHEELS = ("wheel_left_joint", "wheel_right_joint")
ARM = tuple(f"arm_joint_{number}" for number in range(1, 7))
JOINTS = WHEELS + ARM
HOME = {"arm_joint_2": -0.5, "arm_joint_3": 1.8, "arm_joint_5": 1.2}
START = tuple(HOME.get(name, 0.0) for name in JOINTS)  # [rad]
MILLISECOND = 1_000_000  # [ns]
FLYER = """<robot name="flyer">
  <link name="body"><inertial><origin xyz="0.1 0 0"/><mass value="2"/>
    <inertia ixx="0.02" iyy="0.03" izz="0.04" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="speck"/>
  <joint name="hinge" type="continuous"><parent link="body"/><child link="speck"/></joint>
</robot>"""


def settings(**changes: object) -> WorldSettings:
    """Return settings of the mobile manipulator at home."""
    defaults = {"robot_description": URDF, "joints": JOINTS, "initial_positions": HOME}
    return WorldSettings(**(defaults | changes))  # type: ignore[arg-type]


def bits_of_a_motion(engine: str) -> list[str]:
    """Return where the robot is after a while, every bit of it."""
    with World(settings(engine=engine, payload_mass=0.5)) as world:
        for period in range(60):
            world.step([0.3, -0.2, 1.0, 2.0, 1.5 - 0.01 * period, 0.5, 0.2, 0.1])
        pose = world.base_pose()
        return [
            each.hex() for each in (*world.true_positions(), *pose.position, *pose.orientation)
        ]
