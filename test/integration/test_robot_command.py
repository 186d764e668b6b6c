"""``hpid robot``: what a robot lacks, a robot that is saved, and robots that cannot be."""

import json
import re
from pathlib import Path

import pytest
from harness.engines import needs_bullet
from harness.foreign_robots import EXPERIMENTS, PANDA, box, slider

from hpid_ros.base.files import find_resource
from hpid_ros.cli.main import main
from hpid_ros.robot.description import RobotDescription
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world import World


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
