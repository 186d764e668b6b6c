"""What public robot descriptions hold that no engine takes, or that each takes otherwise."""

import json
import logging
import re

import numpy as np
import pytest
import yaml
from harness.engines import ENGINE, needs_bullet
from harness.examples import examples
from hypothesis import given
from hypothesis import strategies as st

from hpid_bench.cli.main import main
from hpid_ros.base.errors import HpidError, RunError, SettingError
from hpid_ros.base.records import Section
from hpid_ros.robot import mending
from hpid_ros.robot.amendments import amended
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.dynamics import Dynamics, build_model
from hpid_ros.robot.kinematics import Kinematics
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world import World

BOTH = pytest.mark.parametrize("engine", [pytest.param("pybullet", marks=needs_bullet), "mujoco"])


def inertial(mass: float, moments: str = "0.01 0 0 0.01 0 0.01") -> str:
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    values = " ".join(f'{n}="{v}"' for n, v in zip(names, moments.split(), strict=True))
    return f'<inertial><origin xyz="0 0 0.2"/><mass value="{mass}"/><inertia {values}/></inertial>'


def arm(rest: str = "", axis: str = "0 1 0", base: str = "", limit: str = "") -> str:
    """Return a pendulum, and what hangs on it."""
    limit = limit or 'lower="-2" upper="2" effort="50" velocity="3"'
    return f"""<robot name="arm"><link name="base">{base or inertial(1)}</link>
<joint name="j1" type="revolute"><parent link="base"/><child link="l1"/>
<origin xyz="0 0 0.1"/><axis xyz="{axis}"/><limit {limit}/></joint>
<link name="l1">{inertial(1)}</link>
{rest}</robot>"""


def tool(inside: str, kind: str = "fixed", more: str = "") -> str:
    return f"""<joint name="tj" type="{kind}"><parent link="l1"/><child link="tool"/>
<origin xyz="0 0 0.4"/>{more}</joint><link name="tool">{inside}</link>"""


def swung(urdf: str, engine: str) -> tuple[float, ...]:
    """Return where the joints that move are after a tenth of a second."""
    joints = tuple(RobotDescription.load(urdf).joints)
    with World(WorldSettings(urdf, joints, fixed_base=True, engine=engine)) as world:
        for _ in range(100):
            world.step((1.0,) * len(joints))
        return world.true_positions()


def experiment(urdf, **controllers):
    reference = {"kind": "minimum_jerk", "times": [0.0, 0.05], "positions": {"j1": [0.0, 0.01]}}
    gains = {"joints": {"j1": {"gains": {"p": 20.0, "i": 40.0, "d": 2.0}}}}
    return {
        "name": "arm",
        "robot": {"description": str(urdf), "fixed_base": True},
        "simulation": {"engine": ENGINE},
        "control": {"rate": 500},
        "duration": 0.05,
        "reference": reference,
        "controllers": gains | controllers,
        "compare": {"PID": {"law": "pid"}},
    }


# --- what is mended


@BOTH
@pytest.mark.parametrize("axis", ["0 2 0", "0 1e-3 0", "0 1e200 0", "0 1e-200 0"])
def test_of_an_axis_the_direction_counts_and_not_its_length(axis: str, engine: str):
    assert swung(arm(axis=axis), engine) == swung(arm(), engine)


@BOTH
@pytest.mark.parametrize("mass", ["0.0001", "1e-8", "1e-12"])
@pytest.mark.parametrize(
    "moments", ["0 0 0 0 0 0", "1e-8 1e-8 1e-8 1e-8 1e-8 1e-8", "0 0 1e-9 0 0 0"]
)
def test_a_link_that_is_a_frame_weighs_nothing_at_the_root_and_at_the_end(
    mass: str, moments: str, engine: str
):
    frame = inertial(mass, moments)
    assert swung(arm(tool(frame)), engine) == pytest.approx(swung(arm(), engine), rel=1e-3)
    assert swung(arm(base=frame), engine) == pytest.approx(swung(arm(), engine), rel=1e-9)


@needs_bullet
@pytest.mark.parametrize("moments", ["0.05 0 0 0.01 0 0.01", "0.02 0.03 0 0.02 0 0.01"])
def test_moments_that_no_body_has_are_the_same_ones_in_both_engines_and_the_model(moments: str):
    urdf = arm(tool(inertial(0.5, moments)))
    there = [swung(urdf, engine)[0] for engine in ("pybullet", "mujoco")]
    assert there[0] == pytest.approx(there[1], rel=1e-4)
    with World(WorldSettings(urdf, ("j1",), fixed_base=True, gravity=0.0)) as world:
        world.step((1.0,))
        rate = world.true_velocities()[0] / world.settings.control_period_ns * 1e9
    assert Dynamics(RobotDescription.load(urdf)).mass_matrix(["j1"], {})[0, 0] == pytest.approx(
        1.0 / rate, rel=1e-3
    )


def test_a_rounding_below_zero_is_no_wrong_sign():
    """iCub's hip has ixx="-5.42101e-20"."""
    robot = RobotDescription.load(arm(tool(inertial(0.5, "-5.4e-20 0 0 -5.4e-20 0 0"))))
    robot.require_sound()
    assert robot.mends


@examples(4)
@given(st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6), st.floats(1e-6, 10.0))
def test_the_nearest_possible_body_is_possible_and_one_that_is_stays_as_it_is(values, mass):
    xx, yy, zz, xy, xz, yz = values
    found = mending.nearest_possible(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), mass)
    least, middle, most = np.linalg.eigvalsh(found)
    assert least > 0.0
    assert most <= least + middle
    assert mending.nearest_possible(found, mass) is found


def test_a_joint_whose_limits_leave_no_room_is_held_there_and_cannot_be_driven():
    more = '<axis xyz="0 0 1"/><limit lower="0.3" upper="0.3" effort="0" velocity="0"/>'
    robot = RobotDescription.load(arm(tool(inertial(0.1), "revolute", more)))
    assert list(robot.joints) == ["j1"]
    assert robot.held == {"tj": 0.3}
    assert RobotDescription.load(robot.xml).held == robot.held
    assert np.allclose(
        Kinematics(robot, "tool").pose([0.0]).rotation[:, 0], [np.cos(0.3), np.sin(0.3), 0.0]
    )
    with pytest.raises(HpidError, match="joint 'tj' does not move"):
        robot.select(["tj"])
    assert list(amended(robot, {}, {}, {"tj": 0.3}).joints) == ["j1"]  # as many files do


def test_what_is_mended_is_said_once_however_often_the_robot_is_loaded(caplog):
    urdf = arm(tool(inertial(0.0001, "0 0 0 0 0 0")), axis="0 3 0").replace("tool", "said_once")
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            RobotDescription.load(urdf)
    said = [each.getMessage() for each in caplog.records if "said_once" in each.getMessage()]
    assert len(said) == 1
    assert "moments of inertia that no body has" in said[0]
    assert not RobotDescription.load(RobotDescription.load(urdf).xml).mends


def test_a_blank_around_a_number_changes_nothing():
    """Right_Hand.urdf of unitree_ros has line breaks there: urdfdom then drops the inertia."""
    broken = (
        arm(tool(inertial(0.5))).replace('ixz="0"', 'ixz=" 0\n"').replace('value="', 'value="\n')
    )
    there, found = (
        Dynamics(RobotDescription.load(urdf)).mass_matrix(["j1"], {})
        for urdf in (arm(tool(inertial(0.5))), broken)
    )
    assert np.array_equal(there, found)


def test_a_sound_robot_is_what_its_file_says_to_the_letter():
    assert RobotDescription.load(arm()).xml == arm()


@BOTH
def test_a_joint_and_a_link_may_have_one_name(engine: str):
    urdf = arm(tool("")).replace('"tj"', '"tool"')
    robot = RobotDescription.load(urdf)
    assert Kinematics(robot, "tool").pose([0.0]).position == pytest.approx([0.0, 0.0, 0.5])
    assert build_model(robot, payload_mass=1.0, payload_link="tool").nv == 1
    assert swung(urdf, engine) == pytest.approx(swung(arm(), engine), rel=1e-4)


# --- what is refused, from every command, before anything runs


RULE = ["--rule", "simc", "--closed-loop-time", "0.1"]
COMMANDS = {
    "robot": ["{urdf}"],
    "compare": ["{file}", "--in-process"],
    "run": ["{file}"],
    "gains": ["{file}", *RULE],
    "check-gains": ["{file}"],
    "margins": ["{file}"],
}


def refusals(tmp_path, capsys, urdf: str, commands=COMMANDS, **controllers) -> list[str]:
    (tmp_path / "arm.urdf").write_text(urdf)
    (tmp_path / "arm.yaml").write_text(
        yaml.safe_dump(experiment(tmp_path / "arm.urdf", **controllers))
    )
    places = {"urdf": tmp_path / "arm.urdf", "file": tmp_path / "arm.yaml"}
    lines = []
    for command in commands:
        arguments = [each.format(**places) for each in COMMANDS[command]]
        assert main([command, *arguments]) == 2, command
        printed = capsys.readouterr()
        assert printed.out == ""
        lines += printed.err.splitlines()
    assert len(lines) == len(commands)
    return lines


@pytest.mark.parametrize(
    ("urdf", "says"),
    [
        (arm(tool(inertial(1), "planar")), "joint 'tj' is planar"),
        (arm(tool(inertial(1), "floating")), "joint 'tj' is floating"),
        (
            arm(limit='lower="2" upper="-2" effort="1" velocity="1"'),
            "lower limit 2 is above its upper limit -2",
        ),
        (arm(tool(inertial(1, "-0.1 0 0 0.1 0 0.1"))), "its inertia has a negative moment"),
    ],
    ids=["planar", "floating", "limits", "inertia"],
)
def test_what_needs_a_guess_is_the_same_line_from_every_command(tmp_path, capsys, urdf, says):
    lines = refusals(tmp_path, capsys, urdf)
    assert all(says in line for line in lines)
    assert len({line.partition(says)[2] for line in lines}) == 1


def test_a_planar_joint_may_be_held(tmp_path):
    robot = RobotDescription.load(arm(tool(inertial(1), "planar")))
    assert list(amended(robot, {}, {}, {"tj": 0.0}).joints) == ["j1"]
    with pytest.raises(HpidError, match="held at 0 alone"):
        amended(robot, {}, {}, {"tj": 0.1})


def test_a_motor_of_nothing_is_refused_until_somebody_says_what_it_can_give(tmp_path, capsys):
    urdf = arm(limit='lower="-2" upper="2" effort="0" velocity="3"')
    commands = [each for each in COMMANDS if each != "robot"]
    lines = refusals(tmp_path, capsys, urdf, commands)
    assert all("its effort limit in the URDF is 0" in line for line in lines)
    file = tmp_path / "arm.yaml"
    clamps = {"common": {"u_clamp_max": 5.0, "u_clamp_min": -5.0}}
    file.write_text(yaml.safe_dump(experiment(tmp_path / "arm.urdf", **clamps)))
    assert main(["gains", str(file), *RULE]) == 0


def test_a_joint_that_moves_no_mass_is_named(tmp_path, capsys):
    """Romeo's eyes: numpy's error of a singular matrix came out of `gains`."""
    more = '<axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="5" velocity="1"/>'
    lines = refusals(tmp_path, capsys, arm(tool("", "revolute", more)), ["robot", "gains"])
    assert all("tj moves nothing that has mass: hold it" in line for line in lines)


# --- what an engine cannot hold


def chain(links: int, moving: int = 3) -> str:
    """Return an arm of a few joints, and many frames in its hand."""
    parts = [f'<robot name="many"><link name="l0">{inertial(1)}</link>']
    for index in range(1, links):
        kind = "revolute" if index <= moving else "fixed"
        parent = min(index - 1, moving + index % 5)
        parts.append(
            f'<link name="l{index}">{inertial(0.01 if index > moving else 1)}</link>'
            f'<joint name="j{index}" type="{kind}"><parent link="l{parent}"/>'
            f'<child link="l{index}"/><origin xyz="0.01 0.02 0.1" rpy="0.3 0.2 {index % 7}"/>'
            '<axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="50" velocity="3"/></joint>'
        )
    return "".join(parts) + "</robot>"


@needs_bullet
def test_a_robot_of_more_links_than_bullet_has_is_the_same_robot_there():
    """Its reader takes 8 kB in a line, too, and this has far more in one."""
    poses, positions = [], []
    for engine in ("pybullet", "mujoco"):
        settings = WorldSettings(chain(160), ("j1", "j2", "j3"), fixed_base=True, engine=engine)
        with World(settings) as world:
            world.apply_wrench("l150", (3.0, -2.0, 1.0), (0.2, 0.1, 0.0), 50_000_000)
            for _ in range(200):
                world.step((2.0, -1.0, 0.5))
            positions.append(world.true_positions())
            pose = world.link_pose("l150")
            poses.append([*pose.position, *np.abs(pose.orientation)])
    assert positions[0] == pytest.approx(positions[1], abs=2e-4)
    assert poses[0] == pytest.approx(poses[1], abs=2e-4)


@needs_bullet
def test_too_many_links_that_move_are_one_line_with_the_way_out():
    joints = tuple(f"j{index}" for index in range(1, 140))
    with pytest.raises(HpidError, match=r"PyBullet takes 128 links that move.*engine: mujoco"):
        World(WorldSettings(chain(140, 139), joints, fixed_base=True, engine="pybullet"))


# --- words


def finger(damping: float) -> str:
    """Return two crossed joints that move next to nothing."""
    small = inertial(0.01, "1e-6 0 0 1e-6 0 1e-6").replace("0.2", "0.02")
    link = f'<link name="l{{0}}">{small}</link>'
    joint = """<joint name="j{0}" type="revolute"><parent link="l{1}"/><child link="l{0}"/>
<origin xyz="0 0 {2}"/><axis xyz="{3}"/><limit lower="-1" upper="1" effort="1" velocity="5"/>
<dynamics damping="{4}"/></joint>"""
    parts = [
        link.format(1),
        link.format(2),
        joint.format(1, 0, 0.0, "1 0 0", damping),
        joint.format(2, 1, 0.04, "0 1 0", damping),
    ]
    return f'<robot name="finger"><link name="l0"/>{"".join(parts)}</robot>'


@BOTH
def test_a_hand_with_much_friction_moves_as_it_must_or_the_run_ends_with_a_line(engine: str):
    def moved(damping: float) -> tuple[float, ...]:
        settings = WorldSettings(finger(damping), ("j1", "j2"), fixed_base=True, engine=engine)
        with World(settings) as world:
            for _ in range(200):
                world.step([0.1 * damping] * 2)
                world.true_positions()
            return world.true_positions()

    assert moved(0.01) == pytest.approx([0.02, 0.02], abs=3e-3)
    if engine == "mujoco":
        assert moved(0.1) == pytest.approx([0.02, 0.02], abs=3e-3)
        return
    line = r"PyBullet: the simulation diverged: joint 'j\d' is at .*\(engine: mujoco "
    with pytest.raises(RunError, match=line):
        moved(0.1)


@pytest.mark.parametrize(
    ("written", "better"),
    [("4e-7", "4.0e-7"), ("1e5", "1.0e+5"), ("-2.5E3", "-2.5e+3"), ("3.e2", "3.e+2")],
)
def test_a_number_that_yaml_takes_for_a_text_is_told_as_one_that_it_does_not(written, better):
    values = yaml.safe_load(f"izz: {written}\nright: {better}")
    assert isinstance(values["izz"], str)
    assert values["right"] == float(written)
    with pytest.raises(
        SettingError, match=rf"izz must be a number.*YAML 1\.1.*write {re.escape(better)}"
    ):
        Section(values, "", SettingError).number("izz")


def test_joints_that_nobody_drives_are_named(tmp_path, capsys):
    more = '<axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="5" velocity="1"/>'
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(arm(tool(inertial(0.1), "revolute", more)))
    document = experiment(urdf)
    file = tmp_path / "arm.yaml"
    for held, says in (({}, "free: tj: nobody drives them"), ({"tj": 0.2}, "held: tj")):
        document["robot"]["held"] = held
        file.write_text(yaml.safe_dump(document))
        assert main(["gains", str(file), *RULE]) == 0
        assert says in capsys.readouterr().err
        assert main(["robot", str(file), "--poses", "1"]) == 0
        assert says in capsys.readouterr().out
    assert main(["robot", str(file), "--poses", "1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["held"] == {"tj": 0.2}
