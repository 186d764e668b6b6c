"""Robots that nobody of this package designed: the KUKA iiwa and the Franka Panda of PyBullet."""

import dataclasses
import json
import logging
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from harness.engines import HAS_BULLET, needs_bullet
from harness.foreign_robots import EXPERIMENTS, IIWA, PANDA, box, robot, short

from hpid_ros.base.errors import RobotDescriptionError
from hpid_ros.base.files import ResourceError, find_resource, package_folder, package_uri
from hpid_ros.cli.main import main
from hpid_ros.experiment.batch import RunTask, WorldKeeper, simulate
from hpid_ros.experiment.description import load_experiment
from hpid_ros.robot.amendments import amended
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.dynamics import Dynamics
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world import World

if HAS_BULLET:
    from hpid_ros.simulation.bullet import bullet_urdf

NAMES = ["iiwa", "panda"]
# --- where things are


@needs_bullet
def test_robots_of_python_packages_are_found_without_importing_them():
    code = f"import sys; from hpid_ros.base.files import find_resource; find_resource({IIWA!r});"
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
        ("package://hpid_ros/none.urdf", "there is no file package://hpid_ros/none.urdf"),
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
    assert "<visual" not in bullet_urdf(arm)
    assert "<visual" in bullet_urdf(arm, is_shown=True)


# --- the experiments


@needs_bullet
@pytest.mark.parametrize("name", NAMES)
def test_gains_keep_to_the_rule_that_the_file_states(name: str):
    experiment = load_experiment(EXPERIMENTS / f"{name}.yaml")
    world = experiment.world
    dynamics = Dynamics(RobotDescription.load(world.robot_description))
    inertias = dynamics.joint_inertias(world.joints, world.initial_positions)
    speed = 10.0  # [rad/s]
    for settings in experiment.controllers["PID"]:
        inertia = inertias[settings.joint]
        rule = (3.0 * speed**2 * inertia, speed**3 * inertia, 3.0 * speed * inertia)
        gains = settings.gains
        assert (gains.p, gains.i, gains.d) == pytest.approx(rule, rel=0.01)
        assert settings.inertia == pytest.approx(inertia, rel=0.01)


@needs_bullet
@pytest.mark.parametrize("name", NAMES)
def test_the_baseline_settles_within_the_limits_of_the_arm(name: str):
    experiment = load_experiment(EXPERIMENTS / f"{name}.yaml")
    joints = RobotDescription.load(experiment.world.robot_description).joints
    with WorldKeeper() as keeper:
        run = simulate(RunTask.of(experiment, "PID"), keeper)
    for series in run.joints:
        late = series.time > experiment.duration - 1.0
        assert np.abs(series.reference - series.position)[late].max() < 0.01
        joint = joints[series.joint]
        assert np.abs(series.effort).max() < joint.effort
        assert joint.lower < series.position.min() < series.position.max() < joint.upper
        speed = np.abs(np.diff(series.reference)).max() / np.diff(series.time).max()
        assert speed < joint.velocity


@needs_bullet
def test_the_graph_gives_what_one_process_gives(tmp_path: Path):
    from hpid_ros.experiment.compare import compare
    from hpid_ros.experiment.in_process import NoProgress

    experiment = load_experiment(short("panda", tmp_path, duration=0.1), "mujoco")
    results = []
    for in_process in (False, True):
        folder = tmp_path / f"in_process={in_process}"
        options = {"in_process": in_process}
        results.append(compare(experiment, folder, NoProgress(), **options))
    graph, one_process = ((each.folder.path / "result.json").read_bytes() for each in results)
    assert graph == one_process
    # The parameter files stay readable: the robot, a text in the experiment, is a file of its own.
    nodes = results[0].folder.path / "nodes" / "PID"
    assert (nodes / "robot.urdf").read_text() == experiment.world.robot_description
    assert str(nodes / "robot.urdf") in (nodes / "controllers.yaml").read_text()
    assert "<robot" not in (nodes / "world.yaml").read_text()


# --- what commands make of them


@needs_bullet
def test_predictions_start_where_the_experiment_does():
    from hpid_ros.metrics.results import run_indices
    from hpid_ros.tuning.upgrade_prediction import simulate as simulate_loops

    experiment = load_experiment(EXPERIMENTS / "panda.yaml")
    world = experiment.world
    (predicted,) = simulate_loops(
        str(world.robot_description),
        {"PID": experiment.controllers["PID"]},
        (),
        fixed_base=True,
        initial_positions=world.initial_positions,
    )
    # A step of the error scale, 0.1 rad, is over in a second; an arm that falls over with its
    # base, or that starts from another pose, is not (0.4 and more in the worst joint).
    assert all(each["itae"] < 0.02 for each in run_indices(predicted).joints.values())


@needs_bullet
def test_an_upgraded_file_keeps_the_model_of_the_robot():
    from hpid_ros.control.controller_files import settings_from_parameters
    from hpid_ros.tuning.upgrade import Upgrade, upgrade_text

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
