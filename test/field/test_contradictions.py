"""URDFs that contradict themselves, as vendors ship them: the same line from whoever reads one."""

import math

import numpy as np
import pytest
from harness.fork_server import run_node
from harness.graph import Told, ros_arguments

from hpid_bench.cli.main import main
from hpid_ros.base.errors import HpidError, RobotDescriptionError
from hpid_ros.base.yaml_text import dump_yaml
from hpid_ros.messages.run import read_run
from hpid_ros.robot.description import RobotDescription, robot_limits

LIMIT = 'lower="-1" upper="1" effort="20" velocity="2"'
URDF = """<robot name="pair"><link name="base"/>
<link name="a"><inertial><origin xyz="0.1 0 0"/><mass value="1"/>
  <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="b"><inertial><origin xyz="0.1 0 0"/><mass value="2"/>
  <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="one" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 1 0"/>
  <limit lower="-1" upper="1" effort="20" velocity="2"/></joint>
<joint name="two" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 1 0"/>
  <limit lower="-1" upper="1" effort="20" velocity="2" /></joint></robot>"""
OF_TWO = f"<limit {LIMIT} />"


def of_two(limit=LIMIT, mimic=""):
    changed = URDF.replace(OF_TWO, f"<limit {limit} />{mimic}")
    assert changed != URDF
    return changed


CIRCLE = of_two(mimic='<mimic joint="one"/>').replace(
    f"<limit {LIMIT}/>", f'<limit {LIMIT}/><mimic joint="two"/>'
)
OF_A_JOINT = {
    "lower above upper": (
        of_two('lower="1" upper="-1" effort="20" velocity="2"'),
        "joint 'two': its lower limit 1 is above its upper limit -1: correct the URDF",
    ),
    "equal limits": (
        of_two('lower="0" upper="0" effort="20" velocity="2"'),
        "joint 'two' does not move: it is held at 0, by robot.held, or because its limits in the "
        "URDF are the same number",
    ),
    "mimic of nothing": (
        of_two(mimic='<mimic joint="tree"/>'),
        "joint 'two': it mimics unknown joint 'tree'; known: one, two",
    ),
    "mimic of itself": (
        of_two(mimic='<mimic joint="two"/>'),
        "joint 'two': it mimics itself: two -> two",
    ),
    "mimics in a circle": (CIRCLE, "joint 'one': it mimics itself: one -> two -> one"),
}
OF_A_LINK = {
    "negative mass": (
        URDF.replace('mass value="2"', 'mass value="-2"'),
        "link 'b': its mass '-2' is no mass in kg, 0 or more",
    ),
    "no number": (
        URDF.replace('mass value="2"', 'mass value="nan"'),
        "link 'b': its mass 'nan' is no mass in kg, 0 or more",
    ),
}
WRONG = OF_A_JOINT | OF_A_LINK
COMMANDS = {
    "robot": "robot {urdf}",
    "gains": "gains {experiment} --rule pole-placement --closed-loop-time 0.2",
    "check-gains": "check-gains {parameters} --urdf {urdf}",
    "margins": "margins {parameters} --urdf {urdf}",
    "upgrade": "upgrade {parameters} --urdf {urdf} --goal smooth -o {folder}/up.yaml",
    "compare": "compare {experiment} --in-process -o {folder}/result",
    "tune": "tune {experiment} --law pid --evaluations 2 -o {folder}/tune",
}


@pytest.fixture
def call(tmp_path, capsys):
    """Return a function that calls a command on a robot and gives exit code and last line."""

    def result_of(command, urdf, **common):
        (tmp_path / "pair.urdf").write_text(urdf)
        gains = {"p": 40.0, "i": 20.0, "d": 4.0}
        nodes = {
            f"/**/{joint}_controller": {
                "ros__parameters": {"joint": joint, "law": "pid", "inertia": 0.05, "gains": gains}
            }
            for joint in ("one", "two")
        }
        experiment = {
            "name": "pair",
            "robot": {"description": "pair.urdf", "fixed_base": True},
            "simulation": {"engine": "mujoco", "physics_steps": 1},
            "control": {"rate": 500},
            "duration": 0.1,
            "reference": {
                "kind": "minimum_jerk",
                "times": [0.0, 0.1],
                "positions": {"one": [0.0, 0.05], "two": [0.0, 0.05]},
            },
            "controllers": {
                "common": common,
                "joints": {joint: {"gains": gains, "inertia": 0.05} for joint in ("one", "two")},
            },
            "compare": {"PID": {"law": "pid"}},
        }
        places = {"urdf": tmp_path / "pair.urdf", "folder": tmp_path}
        for name, document in (("parameters", nodes), ("experiment", experiment)):
            places[name] = tmp_path / f"{name}.yaml"
            places[name].write_text(dump_yaml(document))
        code = main(command.format(**places).split())
        return code, capsys.readouterr().err

    return result_of


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_gives_the_same_line(call, command, wrong):
    urdf, line = WRONG[wrong]
    if (command, wrong) == ("robot", "equal limits"):
        assert call(COMMANDS[command], urdf)[0] == 0  # it is held, and nobody drives it here
        return
    code, printed = call(COMMANDS[command], urdf)
    assert code == 2
    (last,) = [each for each in printed.splitlines() if each.startswith("hpid: ")]
    assert last.endswith(line)


@pytest.mark.parametrize("wrong", OF_A_JOINT)
def test_a_node_refuses_the_joint_that_it_is_about_and_takes_the_others(wrong):
    urdf, line = OF_A_JOINT[wrong]
    with pytest.raises(RobotDescriptionError) as refusal:
        robot_limits(urdf, "two")
    assert str(refusal.value) == line
    if wrong != "mimics in a circle":
        assert robot_limits(urdf, "one").effort == 20.0


@pytest.mark.parametrize(
    ("executable", "given"),
    [
        ("joint_controller", {"joint": "two"}),
        ("mujoco_bridge", {"fixed_base": True}),
        ("joint_controller", {"joint": "one", "compensation": "gravity"}),
    ],
)
def test_the_nodes_give_that_line_too(module_harness, tmp_path, executable, given):
    """So does follow_joint_trajectory, which reads its joints by the same function."""
    urdf, line = WRONG["lower above upper"]
    (tmp_path / "pair.urdf").write_text(urdf)
    ended = run_node(executable, ros_arguments(robot_description=tmp_path / "pair.urdf", **given))
    assert ended.returncode == 2
    assert ended.stderr.strip().splitlines()[-1].endswith(line)


def test_a_held_joint_contradicts_nothing(call, tmp_path):
    """A vendor's locked joint of equal limits."""
    urdf, _ = WRONG["equal limits"]
    code, printed = call("robot {urdf}", urdf)
    assert code == 0
    held = tmp_path / "held.yaml"
    held.write_text("robot: {description: pair.urdf, held: {two: 0.0}}\n")
    assert main(["robot", str(held)]) == 0, printed


NO_LIMIT = of_two('lower="-1" upper="1" effort="0" velocity="2"')


def test_an_effort_of_0_is_no_limit():
    """unitree_ros#154, aero-hand-open#53, dex-urdf#29, ugv_gazebo_sim#47, motoman#22."""
    assert RobotDescription.load(NO_LIMIT).joints["two"].effort == math.inf


@pytest.mark.parametrize("command", ["gains", "check-gains", "compare"])
def test_commands_refuse_a_motor_of_nothing_and_warn_of_one_that_nothing_limits(call, command):
    """It fell, with exit code 0 (dex-urdf#29)."""
    code, printed = call(COMMANDS[command], NO_LIMIT)
    assert code == 2
    assert "joint 'two': its effort limit in the URDF is 0: say what its motor can" in printed
    code, printed = call(COMMANDS[command], of_two('lower="-1" upper="1" velocity="2"'))
    assert code in (0, 1)
    warning = "hpid: warning: two: no effort limit, neither in the URDF nor as u_clamp_max"
    assert warning in printed


@pytest.mark.parametrize("command", ["gains", "compare"])
def test_u_clamp_max_is_such_a_limit(call, command):
    code, printed = call(COMMANDS[command], NO_LIMIT, u_clamp_max=5.0, u_clamp_min=-5.0)
    assert code in (0, 1)
    assert "warning" not in printed


def test_the_simulated_joint_is_driven(call, tmp_path):
    for name, urdf in (("limited", URDF), ("unlimited", NO_LIMIT.replace('effort="0"', ""))):
        code, _ = call(f"compare {{experiment}} --in-process -o {{folder}}/{name}", urdf)
        assert code == 0
    runs = [
        {each.joint: each for each in read_run(tmp_path / name / "bags" / "PID", "run").joints}
        for name in ("limited", "unlimited")
    ]
    first, other = (each["two"] for each in runs)
    assert np.any(first.effort)
    assert np.array_equal(first.effort, other.effort)
    assert np.array_equal(first.position, other.position)


def test_a_controller_asks_for_the_limit_and_takes_the_parameters(harness, tmp_path):
    file = tmp_path / "pair.urdf"
    file.write_text(NO_LIMIT)
    given = {"joint": "two", "robot_description": file, "certify": False}
    ended = run_node("joint_controller", ros_arguments(**given))
    assert ended.returncode == 2
    assert "no effort limit for two: give it one, or set u_clamp_max" in ended.stderr
    told = Told(harness)
    process = harness.start_controller(
        **given, law="pid", gains__p=100.0, u_clamp_max=5.0, u_clamp_min=-5.0
    )
    harness.ask(0, 0.5, joint="two")
    harness.wait(lambda: "within [-5, 5] N m" in process.log.read_text(), what="the limits")
    harness.wait(lambda: "effort [N m]" in told.newest(), what="the health")


def test_all_of_several_are_told_at_once():
    urdf, line = OF_A_LINK["negative mass"]
    other = urdf.replace(f"<limit {LIMIT}/>", '<limit lower="3" upper="2"/>')
    with pytest.raises(HpidError) as refusal:
        RobotDescription.load(other).require_sound()
    assert str(refusal.value).startswith("joint 'one': its lower limit 3 is above")
    assert str(refusal.value).endswith(f"; {line}")
