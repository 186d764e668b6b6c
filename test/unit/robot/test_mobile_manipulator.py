"""The robot that the package brings along: is it one that could be built, and does it stand?"""

import math
import subprocess
import sys
from collections.abc import Callable
from xml.etree import ElementTree

import numpy as np
import pytest
from harness.engines import needs_bullet
from harness.worlds import ARM, HOME, JOINTS, URDF, WHEELS

from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.dynamics import Dynamics
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world import World

pytestmark = pytest.mark.slow

STRETCHED = {"arm_joint_2": math.pi / 2}
PAYLOAD_LIMIT = 2.0  # [kg]
# A stiff joint controller, by joint: [N m/rad] and [N m s/rad].
STIFFNESS = np.array([60.0, 60.0, 900.0, 1500.0, 900.0, 200.0, 200.0, 60.0])
DAMPING = np.array([2.0, 2.0, 60.0, 90.0, 60.0, 10.0, 10.0, 3.0])

LINKS = [
    link
    for link in ElementTree.parse(URDF).getroot().findall("link")
    if link.find("visual") is not None
]


def numbers(element: ElementTree.Element, attribute: str) -> list[float]:
    return [float(word) for word in element.get(attribute, "").split()]


def moments_of(geometry: ElementTree.Element, mass: float) -> list[float]:
    """Return the principal moments of a solid homogeneous primitive, in [kg m^2]."""
    shape = geometry[0]
    if shape.tag == "box":
        x, y, z = numbers(shape, "size")
        return [mass * (b * b + c * c) / 12.0 for b, c in ((y, z), (x, z), (x, y))]
    radius = float(shape.get("radius", "nan"))
    if shape.tag == "sphere":
        return [0.4 * mass * radius**2] * 3
    length = float(shape.get("length", "nan"))
    across = mass * (3.0 * radius**2 + length**2) / 12.0
    return [across, across, mass * radius**2 / 2.0]


def hold(world: World, seconds: float, see: Callable[[], None] = lambda: None) -> None:
    """Hold the initial pose with stiff joint controllers."""
    initial = world.settings.initial_positions
    start = np.array([initial.get(name, 0.0) for name in JOINTS])
    for _ in range(round(seconds * 1e9 / world.settings.control_period_ns)):
        error = start - world.true_positions()
        world.step((STIFFNESS * error - DAMPING * world.true_velocities()).tolist())
        see()


def tilt(world: World) -> float:
    """Return the angle between the robot's z axis and the vertical, in [rad]."""
    x, y, _, _ = world.base_pose().orientation
    return 2.0 * math.asin(math.hypot(x, y))


def test_the_motors_are_two_wheels_and_six_arm_joints():
    description = RobotDescription.load(URDF)
    assert sorted(description.joints) == sorted(JOINTS)
    assert all(description.joints[name].type == "continuous" for name in WHEELS)
    assert all(description.joints[name].type == "revolute" for name in ARM)
    for joint in description.joints.values():
        assert 0.0 < joint.effort < 100.0
        assert 0.0 < joint.velocity < 20.0
        assert joint.damping > 0.0
        assert joint.friction > 0.0
        assert 1e-6 <= joint.rotor_inertia <= 1e-5
        assert 50.0 <= joint.gear_ratio <= 150.0


@pytest.mark.parametrize("link", LINKS, ids=lambda link: link.get("name"))
def test_a_link_has_the_inertia_of_its_first_primitive(link: ElementTree.Element):
    inertial, visual = link.find("inertial"), link.find("visual")
    mass = float(inertial.find("mass").get("value"))
    inertia = inertial.find("inertia")
    given = [float(inertia.get(name)) for name in ("ixx", "iyy", "izz")]
    assert given == pytest.approx(moments_of(visual.find("geometry"), mass), rel=1e-4)
    assert all(float(inertia.get(name)) == 0.0 for name in ("ixy", "ixz", "iyz"))
    assert inertial.find("origin").attrib == visual.find("origin").attrib


@pytest.mark.parametrize(
    "load",
    [
        pytest.param(
            "import pybullet as b; b.connect(b.DIRECT);"
            "b.loadURDF({0!r}, flags=b.URDF_USE_INERTIA_FROM_FILE)",
            id="pybullet",
            marks=needs_bullet,
        ),
        pytest.param("import pinocchio; pinocchio.buildModelFromUrdf({0!r})", id="pinocchio"),
    ],
)
def test_parsers_have_nothing_to_complain_about(load: str):
    done = subprocess.run(
        [sys.executable, "-c", load.format(str(URDF))], capture_output=True, text=True, check=True
    )
    said = [line for line in done.stderr.splitlines() if "build time" not in line]
    assert (done.stdout, said) == ("", [])


def test_motors_lift_the_payload_in_any_pose_with_a_third_to_spare():
    carrying = URDF.read_text().split('<link name="payload">')
    carrying[1] = carrying[1].replace('"1e-6"', f'"{PAYLOAD_LIMIT}"', 1)
    description = RobotDescription.load('<link name="payload">'.join(carrying))
    dynamics = Dynamics(description)
    generator = np.random.default_rng(0)
    poses = [STRETCHED, HOME] + [
        {
            name: generator.uniform(description.joints[name].lower, description.joints[name].upper)
            for name in ARM
        }
        for _ in range(300)
    ]
    for pose in poses:
        for name, torque in dynamics.gravity_torques(ARM, pose).items():
            assert abs(torque) < 0.67 * description.joints[name].effort


def test_the_robot_at_rest_sags_a_little_and_does_not_creep():
    with World(WorldSettings(URDF, JOINTS, initial_positions=HOME)) as world:
        start = world.base_pose().position
        hold(world, 0.5)
        settled, joints = world.base_pose().position, world.true_positions()
        hold(world, 0.2)
        assert math.dist(world.base_pose().position, settled) < 1e-5
        assert math.dist(settled, start) < 1e-3
        assert np.abs(np.subtract(world.true_positions(), joints)).max() < 1e-5


@pytest.mark.parametrize("turn", [0.0, math.pi / 2])
def test_the_robot_does_not_tip_with_the_payload_at_full_reach(turn: float):
    pose = STRETCHED | {"arm_joint_1": turn}
    settings = WorldSettings(URDF, JOINTS, initial_positions=pose, payload_mass=PAYLOAD_LIMIT)
    with World(settings) as world:
        tool = world.link_pose("payload").position
        base = world.base_pose().position
        assert math.dist(tool[:2], base[:2]) > 0.65
        tilts = []
        hold(world, 0.3, lambda: tilts.append(tilt(world)))
        assert max(tilts) < 0.01
