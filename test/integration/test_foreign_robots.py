"""Robots that nobody of this package designed: found, loaded, amended, and told by hpid robot."""

import dataclasses
import json
import logging
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from harness.engines import HAS_BULLET, needs_bullet

from hpid_bench.cli.main import main
from hpid_bench.experiment.batch import RunTask, WorldKeeper, simulate_task
from hpid_bench.experiment.description import load_experiment
from hpid_bench.experiment.in_process import write_run_files
from hpid_bench.tuning.loop_simulation import RobotSimulation
from hpid_bench.tuning.loop_simulation import simulate as simulate_loops
from hpid_bench.tuning.upgrade import Upgrade
from hpid_bench.tuning.upgrade_file import upgrade_text
from hpid_ros.base.errors import ExperimentError, RobotDescriptionError
from hpid_ros.base.records import Section
from hpid_ros.base.resources import (
    ResourceError,
    find_resource,
    package_folder,
    package_uri,
    share_folder,
)
from hpid_ros.base.yaml_files import load_yaml
from hpid_ros.control.parameter_files import settings_from_parameters
from hpid_ros.metrics.run_numbers import run_indices
from hpid_ros.robot.amendments import JointAmendment, amended
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.dynamics import Dynamics
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world import World
from hpid_ros.simulation.world_file import read_world

if HAS_BULLET:
    from hpid_ros.simulation.bullet import bullet_robot

EXPERIMENTS = share_folder() / "config" / "experiments"
IIWA = "package://pybullet_data/kuka_iiwa/model.urdf"
PANDA = "package://pybullet_data/franka_panda/panda.urdf"
NAMES = ["iiwa", "panda"]


def robot(name: str) -> RobotDescription:
    return RobotDescription.load(find_resource(name))


def slider() -> str:
    """Return two hinges and, held askew on the second one, a slide."""
    inertial = """<inertial><mass value="0.5"/>
      <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.015"/></inertial>"""
    links = "".join(f'<link name="{name}">{inertial}</link>' for name in "abcd")
    joints = "".join(
        f"""<joint name="{pair}" type="{kind}"><parent link="{pair[0]}"/><child link="{pair[1]}"/>
        <origin xyz="0.1 0.2 0.3" rpy="{rpy}"/><axis xyz="{axis}"/>
        <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>"""
        for pair, kind, rpy, axis in (
            ("ab", "revolute", "0 0 0", "0 1 0"),
            ("bc", "revolute", "0.2 0 0", "1 0 0"),
            ("cd", "prismatic", "0.3 -0.5 1.1", "0.6 0 0.8"),
        )
    )
    return f'<robot name="slider">{links}{joints}</robot>'


def box(mesh: str) -> str:
    return f"""<robot name="box"><link name="body"><inertial><mass value="1"/>
      <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial>
      <collision><geometry><mesh filename="{mesh}"/></geometry></collision></link>
      <link name="speck"/><joint name="hinge" type="continuous"><parent link="body"/>
      <child link="speck"/></joint></robot>"""


# --- where things are


@needs_bullet
def test_robots_of_python_packages_are_found_without_importing_them():
    code = (
        f"import sys; from hpid_ros.base.resources import find_resource; find_resource({IIWA!r});"
    )
    code += "sys.exit(bool({'pybullet', 'pybullet_data'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
    path = find_resource(IIWA)
    assert path == find_resource("pybullet_data/kuka_iiwa/model.urdf")
    assert path.is_file()
    assert package_uri(path) == IIWA


def test_robots_of_ament_packages_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    share = tmp_path / "install" / "share" / "my-arm_description"
    (share / "urdf").mkdir(parents=True)
    (share / "urdf" / "arm.urdf").write_text("<robot/>")
    name = "package://my-arm_description/urdf/arm.urdf"
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{tmp_path / 'other'}:{tmp_path / 'install'}")
    with pytest.raises(ResourceError):
        find_resource(name)  # a folder without package.xml is no package
    (share / "package.xml").write_text("<package/>")
    assert find_resource(name) == (share / "urdf" / "arm.urdf").resolve()
    assert package_folder("my-arm_description") == share
    assert package_uri(share / "urdf" / "arm.urdf") == name


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("package://nope_description/a.urdf", "no ament or Python package nope_description"),
        pytest.param("package://pybullet_data/none.urdf", "pybullet_data)", marks=needs_bullet),
        ("package://../a.urdf", "no ament or Python package .."),
        ("package://config/experiments/paper.yaml", "no ament or Python package config"),
        pytest.param("pybullet_data/none.urdf", "pybullet_data)", marks=needs_bullet),
    ],
)
def test_a_missing_robot_is_one_line_that_says_where_was_looked(name: str, says: str):
    with pytest.raises(ResourceError) as refusal:
        find_resource(name)
    assert says in str(refusal.value)
    assert "\n" not in str(refusal.value)


# --- the models, against each other


@needs_bullet
@pytest.mark.parametrize("name", NAMES)
def test_the_simulated_robot_accelerates_as_the_model_with_rotors_says(name: str, tmp_path: Path):
    document = yaml.safe_load((EXPERIMENTS / f"{name}.yaml").read_text())
    for joint in document["robot"]["joints"].values():
        joint["friction"] = 0.0  # sticks at rest
    path = tmp_path / "robot.yaml"
    path.write_text(yaml.safe_dump(document))
    world_settings = load_experiment(path).world
    description = RobotDescription.load(world_settings.robot_description)
    joints, start = world_settings.joints, world_settings.initial_positions
    dynamics = Dynamics(description)
    efforts = np.array([3.0, -8.0, 4.0, -6.0, 2.0, -1.5, 1.0])
    gravity = np.array(list(dynamics.gravity_torques(joints, start).values()))
    expected = np.linalg.solve(dynamics.mass_matrix(joints, start), efforts - gravity)
    settings = WorldSettings(
        world_settings.robot_description,
        joints,
        control_period_ns=1_000_000,
        initial_positions=start,
        fixed_base=True,
    )
    with World(settings) as world:
        world.step(tuple(efforts))
        found = np.array(world.true_velocities()) / 1e-3
    # Rotors that turn with their links, of order 1/N, and 1 ms of damping are the difference.
    assert found == pytest.approx(expected, abs=0.02 * np.abs(expected).max())


# --- meshes


CORNERS = [f"v {x} {y} {z}" for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.1, 0.1)]
FACES = ["124", "143", "586", "578", "162", "156", "348", "387", "137", "175", "268", "284"]
CUBE = "\n".join([*CORNERS, *(f"f {' '.join(face)}" for face in FACES), ""])


@pytest.mark.parametrize("mesh", ["meshes/cube.obj", "package://box_description/meshes/cube.obj"])
@pytest.mark.parametrize("is_text", [False, True])
def test_a_robot_stands_on_meshes_of_its_folder_or_of_its_package(
    mesh: str, is_text: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    share = tmp_path / "share" / "box_description"
    (share / "meshes").mkdir(parents=True)
    (share / "meshes" / "cube.obj").write_text(CUBE)
    (share / "package.xml").write_text("<package/>")
    (share / "box.urdf").write_text(box(mesh))
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    description = RobotDescription.load(share / "box.urdf")
    # As text it is what an amended robot is.
    source = amended(description, {}, {}, {}).xml if is_text else share / "box.urdf"
    with World(WorldSettings(source, ("hinge",))) as world:
        for _ in range(200):
            world.step((0.0,))
        assert world.base_pose().position[2] == pytest.approx(0.1, abs=5e-3)


@pytest.mark.parametrize("mesh", ["file:///none.obj", "package://none_such/none.obj"])
def test_without_its_meshes_a_robot_cannot_stand_but_hang(
    mesh: str, caplog: pytest.LogCaptureFixture
):
    with pytest.raises(RobotDescriptionError, match=r"collision mesh.*of link 'body'") as refusal:
        World(WorldSettings(box(mesh), ("hinge",)))
    assert mesh in str(refusal.value)
    assert "\n" not in str(refusal.value)
    with World(WorldSettings(box(mesh), ("hinge",), fixed_base=True)) as world:
        world.step((0.0,))
    (warning,) = [each for each in caplog.records if each.levelno >= logging.WARNING]
    assert "goes without" in warning.getMessage()
    assert mesh in warning.getMessage()


@needs_bullet
def test_on_a_fixed_base_meshes_change_no_number():
    there = robot(PANDA)
    joints = tuple(there.joints)
    runs = []
    for source in (str(find_resource(PANDA)), there.xml):  # the text is far from its meshes
        with World(WorldSettings(source, joints, fixed_base=True)) as world:
            for _ in range(50):
                world.step((0.5,) * len(joints))
            runs.append(world.true_positions())
    assert runs[0] == runs[1]


@needs_bullet
def test_what_nobody_sees_is_not_loaded():
    arm = robot(PANDA)
    assert "<visual" not in bullet_robot(arm).urdf
    assert "<visual" in bullet_robot(arm, is_shown=True).urdf


# --- the experiments


@needs_bullet
@pytest.mark.parametrize("name", NAMES)
def test_the_baseline_settles_within_the_limits_of_the_arm(name: str):
    experiment = load_experiment(EXPERIMENTS / f"{name}.yaml")
    joints = RobotDescription.load(experiment.world.robot_description).joints
    with WorldKeeper() as keeper:
        run = simulate_task(RunTask.of(experiment, "PID"), keeper)
    for series in run.joints:
        late = series.time > experiment.duration - 1.0
        assert np.abs(series.reference - series.position)[late].max() < 0.01
        joint = joints[series.joint]
        assert np.abs(series.effort).max() < joint.effort
        assert joint.lower < series.position.min() < series.position.max() < joint.upper
        speed = np.abs(np.diff(series.reference)).max() / np.diff(series.time).max()
        assert speed < joint.velocity


@needs_bullet
def test_nodes_read_the_amended_robot_from_a_file_of_its_own(tmp_path: Path):
    experiment = load_experiment(EXPERIMENTS / "panda.yaml")
    controllers, _ = write_run_files(tmp_path, experiment, experiment.controllers["PID"])
    urdf = tmp_path / "robot.urdf"
    assert urdf.read_text() == experiment.world.robot_description
    assert str(urdf) in controllers.read_text()
    document = load_yaml(tmp_path / "world.yaml", ExperimentError)
    there = read_world(Section(document, "", ExperimentError), ()).world
    assert there == experiment.world


# --- what commands make of them


@needs_bullet
def test_predictions_start_where_the_experiment_does():
    experiment = load_experiment(EXPERIMENTS / "panda.yaml")
    world = experiment.world
    (predicted,) = simulate_loops(
        RobotSimulation(
            str(world.robot_description),
            fixed_base=True,
            initial_positions=world.initial_positions,
        ),
        {"PID": experiment.controllers["PID"]},
        (),
    )
    # A step of the error scale, 0.1 rad, is over in a second; an arm that falls over with its
    # base, or that starts from another pose, is not (0.4 and more in the worst joint).
    assert all(each["itae"] < 0.02 for each in run_indices(predicted).joints.values())


@needs_bullet
def test_an_upgraded_file_keeps_the_model_of_the_robot():
    first = load_experiment(EXPERIMENTS / "panda.yaml").controllers["PID"][0]
    model = dataclasses.replace(first.model, description="/robots/an arm.urdf")
    settings = dataclasses.replace(first, model=model)
    text = upgrade_text([Upgrade(settings, (-0.4, 0.4), (1.0, 1.0))], [], {})
    (again,) = settings_from_parameters(yaml.safe_load(text), "file").values()
    assert again.model == model
    assert model.compensation == "gravity"


@needs_bullet
def test_check_gains_knows_the_inertias_of_an_experiments_robot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    file = tmp_path / "controllers.yaml"
    gains = {"p": 351.0, "i": 1170.0, "d": 35.1}
    node = {"ros__parameters": {"joint": "lbr_iiwa_joint_7", "law": "pid", "gains": gains}}
    file.write_text(yaml.safe_dump({"joint7_controller": node}))
    robot_file = str(EXPERIMENTS / "iiwa.yaml")
    arguments = ["check-gains", str(file), "--json", "--poses", "2", "--urdf"]
    assert main([*arguments, robot_file]) == 0
    (verdict,) = json.loads(capsys.readouterr().out).values()
    assert verdict["inertia"] == pytest.approx([1.163, 1.163], rel=1e-3)  # 1.162 of it a rotor's
    main([*arguments, IIWA])
    (verdict,) = json.loads(capsys.readouterr().out).values()
    assert verdict["inertia"][1] < 0.0011


# --- what a file lays over a robot


@needs_bullet
def test_amendments_reach_everyone_who_reads_the_robot():
    better = JointAmendment(4.54e-5, 160.0, 0.1, 0.2, 40.0, 2.3)
    joints = {"lbr_iiwa_joint_7": better, "lbr_iiwa_joint_1": JointAmendment(friction=3.0)}
    arm = amended(robot(IIWA), joints, {}, {})
    last = arm.joints["lbr_iiwa_joint_7"]
    assert (last.rotor_inertia, last.gear_ratio, last.damping) == (4.54e-5, 160.0, 0.1)
    assert (last.friction, last.effort, last.velocity) == (0.2, 40.0, 2.3)
    assert (last.lower, last.upper) == (-3.05432619099, 3.05432619099)
    first = arm.joints["lbr_iiwa_joint_1"]
    assert (first.friction, first.damping, first.effort) == (3.0, 0.5, 300.0)
    reflected = 4.54e-5 * 160.0**2
    plain, better = (
        Dynamics(each).mass_matrix(["lbr_iiwa_joint_7"], {}) for each in (robot(IIWA), arm)
    )
    assert better[0, 0] - plain[0, 0] == pytest.approx(reflected, rel=1e-12)


def test_an_amendment_of_a_transmission_that_is_there_changes_it_alone():
    own = RobotDescription.load(share_folder() / "urdf" / "mobile_manipulator.urdf")
    better = amended(own, {"arm_joint_2": JointAmendment(rotor_inertia=1e-3)}, {}, {})
    assert better.joints["arm_joint_2"].rotor_inertia == 1e-3
    assert better.joints["arm_joint_2"].gear_ratio == own.joints["arm_joint_2"].gear_ratio
    assert better.joints["arm_joint_1"] == own.joints["arm_joint_1"]


@pytest.mark.parametrize(
    ("name", "tip"),
    [
        pytest.param(IIWA, "lbr_iiwa_link_7", id="iiwa", marks=needs_bullet),
        pytest.param(PANDA, "panda_leftfinger", id="panda", marks=needs_bullet),
        pytest.param(None, "d", id="slider"),
    ],
)
def test_a_held_joint_stands_where_it_would_stand_if_it_moved_there(name: str | None, tip: str):
    free = robot(name) if name else RobotDescription.load(slider())
    chance = np.random.default_rng(3)
    there = {name: float(chance.uniform(j.lower, j.upper)) for name, j in free.joints.items()}
    held = {joint: there[joint] for joint in list(free.joints)[2::2]}
    stiff = amended(free, {}, {}, held)
    moving = tuple(joint for joint in free.joints if joint not in held)
    assert tuple(stiff.joints) == moving
    where = []
    for description in (free, stiff):
        positions = {joint: there[joint] for joint in description.joints}
        settings = WorldSettings(
            description.xml, moving, initial_positions=positions, fixed_base=True
        )
        with World(settings) as world:
            place = world.link_pose(tip)
            where.append([*place.position, *np.abs(place.orientation)])
    assert where[0] == pytest.approx(where[1], abs=1e-9)
    masses = [
        Dynamics(each).mass_matrix(moving, {joint: there[joint] for joint in each.joints})
        for each in (free, stiff)
    ]
    assert np.allclose(*masses, rtol=0.0, atol=1e-12)


@needs_bullet
def test_an_amended_robot_means_the_same_on_every_machine():
    experiment = load_experiment(EXPERIMENTS / "panda.yaml")
    text = str(experiment.world.robot_description)
    assert "package://pybullet_data/franka_panda/meshes/collision/link0.obj" in text
    assert str(package_folder("pybullet_data")) not in text
    assert "panda_finger_joint1" not in RobotDescription.load(text).joints


@needs_bullet
@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"held": {"panda_finger": 0.02}}, "robot: unknown joint 'panda_finger'; did you mean"),
        ({"held": {"panda_finger_joint1": 0.3}}, r"not within its limits \[0.0, 0.04\]"),
        ({"joints": {"panda_joint1": {"gear_ratio": 0}}}, "gear_ratio must not be 0"),
        ({"links": {"panda_link9": {"mass": 0}}}, "unknown link 'panda_link9'"),
        ({"links": {"panda_link1": {"mass": 1}}}, "robot.links.panda_link1: inertia is missing"),
        (
            {"links": {"panda_link1": {"mass": 1, "inertia": {"ixx": 3, "iyy": 1, "izz": 1}}}},
            "no body has the principal moments 1, 1, 3",
        ),
        (
            {"links": {"panda_link1": {"mass": 1, "inertia": {"ixx": 2.001, "iyy": 1, "izz": 1}}}},
            "no body has the principal moments 1, 1, 2.001",  # nor takes an engine them
        ),
        (
            {"links": {"panda_link1": {"mass": 0, "inertia": {"ixx": 3, "iyy": 1, "izz": 1}}}},
            "robot.links.panda_link1: inertia must be left out where mass is 0",
        ),
        ({"held": {"panda_joint1": 0.0}}, "'panda_joint1' does not move"),  # and is driven
    ],
)
def test_an_impossible_amendment_is_one_line(tmp_path: Path, changes: dict, says: str):
    document = yaml.safe_load((EXPERIMENTS / "panda.yaml").read_text())
    document["robot"] |= changes
    path = tmp_path / "panda.yaml"
    path.write_text(yaml.safe_dump(document))
    with pytest.raises(ExperimentError, match=says) as refusal:
        load_experiment(path)
    assert "\n" not in str(refusal.value)


# --- hpid robot


def test_hpid_robot_names_the_joints_that_slide_and_their_units(tmp_path, capsys):
    (tmp_path / "slider.urdf").write_text(slider())
    assert main(["robot", str(tmp_path / "slider.urdf")]) == 0
    assert "cd slides: m and m/s, N, N s/m and kg, where" in " ".join(
        capsys.readouterr().out.split()
    )


@needs_bullet
def test_hpid_robot_says_what_the_urdf_lacks(capsys: pytest.CaptureFixture[str]):
    assert main(["robot", PANDA, "--poses", "2", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    texts = {each["text"]: each["names"] for each in said["remarks"]}
    (placeholder,) = [text for text in texts if "0.1 0.1 0.1 kg m^2" in text]
    assert len(texts[placeholder]) == 13
    (weightless,) = [text for text in texts if "without mass" in text]
    assert texts[weightless] == ["panda_link8", "panda_grasptarget"]
    assert any("friction" in text for text in texts)
    assert [names for text, names in texts.items() if "mimics" in text] == [
        ["panda_finger_joint2"]
    ]
    assert said["joints"]["panda_joint7"]["largest_inertia"] > 0.3

    assert main(["robot", str(EXPERIMENTS / "panda.yaml"), "--poses", "2", "--json"]) == 0
    better = json.loads(capsys.readouterr().out)
    assert better["remarks"] == []
    assert better["joints"]["panda_joint7"]["inertia"] == pytest.approx(0.2122, rel=1e-3)


def test_a_robot_without_limits_is_told_and_no_success(tmp_path: Path, capsys):
    manipulator = find_resource("urdf/mobile_manipulator.urdf")
    text = re.sub(r'effort="[^"]*"', "", manipulator.read_text(), count=1)
    (tmp_path / "bare.urdf").write_text(text)
    assert main(["robot", str(tmp_path / "bare.urdf"), "--poses", "1"]) == 1
    printed = capsys.readouterr().out
    assert "no effort limit" in printed
    assert "before a robot is driven by it" in printed
    assert main(["robot", str(manipulator), "--poses", "1"]) == 0


@needs_bullet
def test_hpid_robot_saves_a_robot_that_loads_from_anywhere(tmp_path: Path, refused):
    saved = tmp_path / "arm.urdf"
    file = str(EXPERIMENTS / "iiwa.yaml")
    assert main(["robot", file, "--poses", "1", "--save", str(saved)]) == 0
    assert "exists" in refused("robot", file, "--poses", "1", "--save", saved)
    before = saved.read_bytes()
    told = refused("robot", saved, "--poses", "1", "--save", saved, "--force")
    assert "is an input" in told
    assert saved.read_bytes() == before
    description = RobotDescription.load(saved)
    assert description.joints["lbr_iiwa_joint_6"].gear_ratio == 160.0
    with World(WorldSettings(saved, tuple(description.joints), fixed_base=True)) as world:
        world.step((0.0,) * 7)


@pytest.mark.parametrize(
    ("urdf", "says"),
    [("<robot", "not readable XML"), (box("none.obj"), "mass matrix of 'box' cannot be inverted")],
)
def test_hpid_robot_refuses_in_one_line(urdf: str, says: str, tmp_path: Path, refused):
    path = tmp_path / "bad.urdf"
    path.write_text(urdf)
    assert says in refused("robot", path)
