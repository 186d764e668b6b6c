"""The simulated robot against mechanics, whatever engine it has; to the last bit; refusals."""

import math
import re
import subprocess
import sys
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pinocchio
import pytest
from harness.engines import HAS_BULLET, needs_bullet
from harness.places import ROOT
from harness.worlds import (
    FLYER,
    HOME,
    JOINTS,
    MILLISECOND,
    START,
    URDF,
    WHEELS,
    bits_of_a_motion,
    settings,
)

from hpid_bench.cli.options import load_robot
from hpid_ros.base.errors import RobotDescriptionError, RunError, SettingError
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.dynamics import Dynamics
from hpid_ros.robot.kinematics import Kinematics
from hpid_ros.simulation.physics import Twist
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world import World
from hpid_ros.simulation.world_file import world_of

if HAS_BULLET:
    from hpid_ros.simulation.bullet import bullet_robot, geared, rotor_name

PERIOD = 1e-3  # [s]


def frictionless(damping: bool = True) -> str:
    """Return the mobile manipulator's URDF without Coulomb friction."""
    text = re.sub(r'friction="[^"]*"', 'friction="0"', URDF.read_text())
    return text if damping else re.sub(r'damping="[^"]*"', 'damping="0"', text)


def loaded(mass: float) -> str:
    """Return the frictionless URDF with a point mass at the payload link."""
    head, tail = frictionless().split('<link name="payload">')
    return head + '<link name="payload">' + tail.replace('"1e-6"', f'"{mass}"', 1)


def efforts_of(description: RobotDescription, period: int) -> np.ndarray:
    """Return lively efforts that hold the arm about where it is."""
    torques = np.array([0.0, 0.0, 0.0, 0.15, -3.34, 0.0, -0.33, 0.0])
    swing = np.array([1.0, 1.0, 4.0, 6.0, 4.0, 1.0, 0.6, 0.3])
    assert len(description.joints) == len(swing)
    return torques + swing * np.sin(15.0 * period * PERIOD + np.arange(8))


class Reference:
    """The same robot in Pinocchio: equations of motion, integrated far more finely.

    With ``rotors`` each rotor is a body and q = G q_joints removes its freedom, which is exact;
    without, Jr N^2 is put on the mass matrix's diagonal ("armature").
    """

    def __init__(self, description: RobotDescription, rotors: bool) -> None:
        xml = bullet_robot(description).urdf if rotors else description.xml
        self.model = pinocchio.buildModelFromXML(xml)
        self.data = self.model.createData()
        joints = description.select(JOINTS)
        self.damping = np.array([joint.damping for joint in joints])
        self.armature = (not rotors) * np.diag([joint.reflected_inertia for joint in joints])
        self.map = np.zeros((self.model.nv, len(joints)))
        for column, joint in enumerate(joints):
            self.map[self._row(joint.name), column] = 1.0
            if rotors:
                self.map[self._row(rotor_name(joint)), column] = joint.gear_ratio

    def _row(self, name: str) -> int:
        return self.model.joints[self.model.getJointId(name)].idx_v

    def acceleration(self, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> np.ndarray:
        whole = pinocchio.integrate(self.model, pinocchio.neutral(self.model), self.map @ q)
        upper = np.triu(pinocchio.crba(self.model, self.data, whole))
        mass = self.map.T @ (upper + np.triu(upper, 1).T) @ self.map + self.armature
        bias = pinocchio.nonLinearEffects(self.model, self.data, whole, self.map @ v)
        return np.linalg.solve(mass, tau - self.map.T @ bias - self.damping * v)

    def swing(self, start: np.ndarray, efforts: Callable[[int], np.ndarray], periods: int):
        """Return the positions after some control periods; Runge-Kutta 4, efforts held."""
        q, v, h = start.copy(), np.zeros(len(start)), PERIOD / 2
        for step in range(2 * periods):
            tau = efforts(step // 2)
            a1 = self.acceleration(q, v, tau)
            a2 = self.acceleration(q + h / 2 * v, v + h / 2 * a1, tau)
            a3 = self.acceleration(q + h / 2 * (v + h / 2 * a1), v + h / 2 * a2, tau)
            a4 = self.acceleration(q + h * (v + h / 2 * a2), v + h * a3, tau)
            q = q + h * v + h * h / 6 * (a1 + a2 + a3)
            v = v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        return q


def simulated_swing(physics_steps: int, periods: int) -> np.ndarray:
    """Return the positions of the frictionless robot on its stand after some periods."""
    with World(
        settings(robot_description=frictionless(), fixed_base=True, physics_steps=physics_steps)
    ) as world:
        for period in range(periods):
            world.step(efforts_of(world.description, period).tolist())
        return np.array(world.true_positions())


def test_a_swing_converges_to_the_equations_of_motion_with_the_physics_step(engine):
    description = RobotDescription.load(frictionless())
    periods = 200
    exact = Reference(description, rotors=engine == "pybullet").swing(  # which has no armature
        np.array(START), lambda period: efforts_of(description, period), periods
    )
    travel = np.abs(exact - START)
    assert travel.min() > 0.01
    errors = [np.abs(simulated_swing(steps, periods) - exact).max() for steps in (1, 2, 4, 8)]
    # The step of either is of first order: half the step, half the error.
    assert all(1.8 < coarse / fine < 2.2 for coarse, fine in pairwise(errors))
    assert errors[-1] < 1e-3 * travel.max()


def test_the_robot_starts_where_it_was_asked_to_and_at_rest():
    with World(settings()) as world:
        assert world.true_positions() == pytest.approx(START, abs=0.0)
        assert world.true_velocities() == (0.0,) * 8
        assert np.abs(world.base_velocity().linear).max() == 0.0
        before = np.array(world.base_pose().position)
        assert np.abs(before[:2]).max() < 1e-5
        for _ in range(5):
            world.step([0.0] * 8)
        # No jump: in 5 ms a robot that was let fall would drop 120 micrometres.
        assert abs(world.base_pose().position[2] - before[2]) < 2e-6


def test_an_encoder_quantises_what_is_read_and_not_what_moves():
    counts = (0, 64, 128, 256, 512, 1024, 2048, 4096)
    with (
        World(settings(encoder_counts=counts, fixed_base=True)) as coarse,
        World(settings(fixed_base=True)) as ideal,
    ):
        for _ in range(100):
            for world in (coarse, ideal):
                world.step([1.0, 1.0, 2.0, 1.0, 1.0, 0.5, 0.5, 0.5])
        assert coarse.true_positions() == ideal.true_positions() == ideal.read()
        error = np.abs(np.subtract(coarse.read(), coarse.true_positions()))
        assert error[0] == 0.0
        assert all(error[1:] <= math.pi / np.array(counts[1:]))
        assert error[1:].max() > 0.0


def test_friction_holds_below_breakaway_and_lets_go_above(engine):
    friction = RobotDescription.load(URDF).joints["wheel_left_joint"].friction
    with World(settings(fixed_base=True)) as world:
        for _ in range(500):
            world.step([0.95 * friction, 1.05 * friction, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        held, moved = world.true_positions()[:2]
    inertia = Dynamics(RobotDescription.load(URDF)).joint_inertias(WHEELS, {})[WHEELS[1]]
    assert abs(held) < {"pybullet": 1e-9, "mujoco": 1e-7}[engine]  # in half a second
    assert moved == pytest.approx(0.5 * 0.05 * friction / inertia * 0.5**2, rel=0.5)


def test_an_effort_is_held_to_the_limit_of_the_urdf_and_told_as_applied():
    def after(effort: float) -> tuple[float, ...]:
        with World(settings(fixed_base=True, control_period_ns=333_333)) as world:
            assert world.applied_efforts() == (0.0,) * 8
            for _ in range(20):
                world.step([effort, -1.5, *[0.0] * 6])
            assert world.time_ns == 20 * 333_333
            assert world.applied_efforts() == (min(effort, 6.0), -1.5, *[0.0] * 6)
            speeds = world.true_velocities()
            world.reset()
            assert world.applied_efforts() == (0.0,) * 8
            return speeds

    assert after(6.0) == after(600.0) != after(5.0)


@pytest.mark.parametrize("change", ["at the start", "later"])
def test_the_payload_hangs_at_the_payload_link(change: str):
    mass = 2.0
    carrying = Dynamics(RobotDescription.load(loaded(mass)))
    torques = carrying.gravity_torques(JOINTS, HOME)
    with World(
        settings(
            robot_description=frictionless(),
            fixed_base=True,
            payload_mass=mass if change == "at the start" else 0.0,
        )
    ) as world:
        if change == "later":
            world.set_payload(mass)
        for _ in range(100):
            world.step([torques[name] for name in JOINTS])
        assert np.abs(np.subtract(world.true_positions(), START)).max() < 1e-6
        world.set_payload(0.0)
        for _ in range(100):
            world.step([torques[name] for name in JOINTS])
        assert np.abs(np.subtract(world.true_positions(), START)).max() > 1e-2


def fly(force: tuple[float, float, float], torque: tuple[float, float, float]) -> Twist:
    """Return the velocity of the flyer 10 ms after a pulse of 10 ms."""
    with World(WorldSettings(FLYER, ("hinge",), gravity=0.0)) as world:
        assert world.base_pose().position == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)
        world.apply_wrench("body", force, torque, 10 * MILLISECOND)
        for _ in range(20):
            world.step([0.0])
        return world.base_velocity()


def test_a_wrench_is_a_pulse_on_the_origin_of_the_link():
    # The origin lies 0.1 m behind the centre of mass: a force across x turns the body.
    linear, angular = fly((0.0, 4.0, 0.0), (0.0, 0.0, 0.0))
    turn = -0.1 * 4.0 * 0.01 / 0.04
    assert angular == pytest.approx((0.0, 0.0, turn), abs=1e-5)
    assert linear[1] == pytest.approx(4.0 * 0.01 / 2.0 - 0.1 * turn, rel=1e-3)
    linear, angular = fly((0.0, 0.0, 3.0), (0.0, 0.0, 0.0))
    turn = 0.1 * 3.0 * 0.01 / 0.03
    assert angular == pytest.approx((0.0, turn, 0.0), abs=1e-5)
    assert linear[2] == pytest.approx(3.0 * 0.01 / 2.0 + 0.1 * turn, rel=1e-3)
    linear, angular = fly((2.0, 0.0, 0.0), (0.2, 0.0, 0.0))
    assert angular == pytest.approx((0.2 * 0.01 / 0.02, 0.0, 0.0), abs=1e-5)
    assert linear[0] == pytest.approx(2.0 * 0.01 / 2.0, rel=1e-3)


def test_the_velocity_of_the_base_is_given_in_its_own_frame():
    with World(WorldSettings(FLYER, ("hinge",), gravity=0.0)) as world:
        world.apply_wrench("body", (20.0, 0.0, 0.0), (3.0, 1.0, 4.0), 20 * MILLISECOND)
        for _ in range(600):
            before = np.array(world.base_pose().position)
            world.step([0.0])
        pose = world.base_pose()
        x, y, z, w = pose.orientation
        assert abs(w) < 0.8  # well turned away from where it started
        velocity = (np.array(pose.position) - before) / PERIOD
        inverse = pinocchio.Quaternion(w, x, y, z).matrix().T
        assert world.base_velocity().linear == pytest.approx(inverse @ velocity, abs=2e-3)


def test_a_link_is_where_and_turned_as_kinematics_say_at_rest_and_in_motion():
    arm = Kinematics(RobotDescription.load(URDF), "payload")
    with World(settings(fixed_base=True)) as world:
        for steps in (0, 50):
            for _ in range(steps):
                world.step([0.5] * len(JOINTS))
            known = dict(zip(JOINTS, world.true_positions(), strict=True))
            wanted, found = (
                arm.pose([known[joint] for joint in arm.joints]),
                world.link_pose("payload"),
            )
            x, y, z, w = found.orientation
            assert found.position == pytest.approx(wanted.position, abs=1e-6)
            turn = pinocchio.Quaternion(w, x, y, z).matrix()
            assert turn == pytest.approx(np.asarray(wanted.rotation), abs=1e-6)


def test_a_robot_is_set_down_on_the_ground_wherever_its_root_is():
    ball = """<robot name="ball">
      <link name="post"><inertial><mass value="1"/>
        <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial>
        <collision><origin xyz="0 0 -0.7"/><geometry><sphere radius="0.2"/></geometry></collision>
      </link><link name="speck"/>
      <joint name="hinge" type="continuous"><parent link="post"/><child link="speck"/></joint>
    </robot>"""
    with World(WorldSettings(ball, ("hinge",))) as world:
        assert world.base_pose().position[2] == pytest.approx(0.9, abs=1e-3)


@needs_bullet
def test_rotors_turn_about_their_joints_axes_and_are_added_for_bullet_only():
    description = RobotDescription.load(URDF)
    simulated = RobotDescription.load(bullet_robot(description).urdf)
    assert len(geared(description.joints.values())) == 8
    for joint in geared(description.joints.values()):
        rotor = simulated.joints[rotor_name(joint)]
        assert (rotor.parent, rotor.axis) == (joint.parent, joint.axis)
        assert rotor.child in simulated.links
        assert rotor.child not in description.links


def test_two_worlds_fed_the_same_give_the_same_to_the_last_bit_looked_at_or_not():
    generator = np.random.default_rng(7)
    efforts = generator.normal(0.0, 3.0, (80, 8)).tolist()

    def run(world: World, *, is_looked_at: bool = False) -> list[tuple[float, ...]]:
        readings = []
        for period, effort in enumerate(efforts):
            if period == 20:
                world.apply_wrench("base_link", (5.0, 3.0, 0.0), (0.0, 0.0, 1.0), 20 * MILLISECOND)
            if period == 50:
                world.set_payload(1.0)
            if is_looked_at:
                world.base_velocity()
                world.link_pose("tool0")
            world.step(effort)
            readings.append(world.true_positions() + world.read() + world.base_pose().position)
        return readings

    with World(settings(encoder_counts=4096)) as first, World(settings(encoder_counts=4096)) as w:
        once = run(first)
        assert run(w, is_looked_at=True) == once
        w.reset()
        assert (w.time_ns, w.true_positions()) == (0, START)
        assert run(w) == once


@pytest.mark.slow
def test_another_process_gives_the_same_to_the_last_bit(engine: str):
    program = (
        "import sys; from harness import worlds; print(*worlds.bits_of_a_motion(sys.argv[1]))"
    )
    printed = subprocess.run(
        [sys.executable, "-c", program, engine],
        cwd=ROOT,
        env={"PYTHONPATH": f"{ROOT}:{ROOT / 'test'}"},
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert printed.split() == bits_of_a_motion(engine)
    assert "nan" not in printed
    assert len(printed.split()) == 15


def test_a_robot_that_cannot_be_loaded_is_one_clear_line(
    capfd: pytest.CaptureFixture[str], engine: str
):
    line = {"pybullet": "PyBullet cannot load", "mujoco": "'speck' has a collision without geom"}
    shapeless = "<collision><geometry/></collision>"
    ghost = FLYER.replace('<link name="speck"/>', f'<link name="speck">{shapeless}</link>')
    with pytest.raises(RobotDescriptionError, match=line[engine]) as caught:
        World(WorldSettings(ghost, ("hinge",)))
    assert "\n" not in str(caught.value)
    assert tuple(capfd.readouterr()) == ("", "")


def test_a_link_with_a_negative_moment_is_refused():
    """Bullet would go on without its inertia."""
    wrong = FLYER.replace('izz="0.04"', 'izz="-0.04"')
    with pytest.raises(RobotDescriptionError, match="link 'body': its inertia has a negative"):
        World(WorldSettings(wrong, ("hinge",)))


def test_a_simulation_that_diverges_ends_with_a_line():
    with World(settings(velocity="differences")) as world:
        world.set_payload(1e200)
        with pytest.raises(RunError, match=r"PyBullet: the simulation diverged|MuJoCo: "):
            world.step([0.0] * len(JOINTS))


def test_a_joint_starts_within_its_limits_also_where_nothing_says_where(tmp_path):
    hinged = FLYER.replace("continuous", "revolute").replace(
        "</joint>", '<limit lower="-2" upper="-0.5" effort="1" velocity="1"/></joint>'
    )
    with World(WorldSettings(hinged, ("hinge",), fixed_base=True)) as world:
        assert world.true_positions() == (-0.5,)
    (tmp_path / "hinged.urdf").write_text(hinged)
    robot = str(tmp_path / "hinged.urdf")  # and what is designed for the start knows it
    world = world_of({"robot": {"description": robot}}, None).world
    assert world.initial_positions == load_robot(robot).initial_positions == {"hinge": -0.5}


def test_bad_requests_are_one_clear_line():
    with pytest.raises(RobotDescriptionError, match="did you mean 'arm_joint_2'"):
        World(settings(joints=("arm_joint2",)))
    with pytest.raises(SettingError, match=r"arm_joint_2 = 9.0 is not within its limits \[-1.9"):
        World(settings(initial_positions={"arm_joint_2": 9.0}))
    with pytest.raises(SettingError, match="did you mean 'arm_joint_2'"):
        World(settings(initial_positions={"arm_joint_22": 0.0}))
    with pytest.raises(RobotDescriptionError, match="unknown link 'hook'"):
        World(settings(payload_mass=1.0, payload_link="hook"))
    with World(settings(fixed_base=True)) as world:
        with pytest.raises(SettingError, match="7 efforts for 8"):
            world.step([0.0] * 7)
        with pytest.raises(SettingError, match="effort nan of joint 'arm_joint_6'"):
            world.step([0.0] * 7 + [math.nan])
        with pytest.raises(RobotDescriptionError, match="did you mean 'base_link'"):
            world.apply_wrench("base_lnk", (0, 0, 0), (0, 0, 0), MILLISECOND)
        with pytest.raises(SettingError, match="force"):
            world.apply_wrench("base_link", (0, math.inf, 0), (0, 0, 0), MILLISECOND)
        with pytest.raises(SettingError, match="payload_mass"):
            world.set_payload(-1.0)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"control_period_ns": 0}, "control_period_ns 0"),
        ({"physics_steps": 1.5}, "physics_steps 1.5"),
        ({"joints": ()}, "joints must name"),
        ({"payload_mass": math.nan}, "payload_mass nan"),
        ({"gravity": -1.0}, "gravity -1.0"),
        ({"encoder_counts": (1, 2)}, "2 entries for 8 joints"),
    ],
)
def test_impossible_settings_are_refused(changes: dict[str, object], says: str):
    with pytest.raises(SettingError, match=says):
        settings(**changes)


def test_a_closed_world_stays_closed():
    first = World(settings(fixed_base=True))
    first.close()
    first.close()
    with World(settings(fixed_base=True)) as second:
        # PyBullet gives the second world the first one's number.
        with pytest.raises(Exception, match=r"connected|NoneType"):
            first.step([1.0] * 8)
        assert second.true_positions() == START
