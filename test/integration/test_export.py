"""hpid export: parameter files and experiments become C that compiles and agrees with Python."""

import re
import subprocess

import pytest
import yaml
from harness.c_loops import compile_c
from harness.places import ROOT

from hpid_bench.cli.commands import BAD_INPUT, DONE, export
from hpid_bench.cli.main import main

GAINS = {"gains": {"p": 39.6, "i": 132.0, "d": 3.96}, "mu": -0.2, "inertia": 0.132}
FIRMWARE = """
#include <stdint.h>
#include "hpid_elbow.h"
extern double target_position, target_velocity;
hpid_elbow_real encoder_velocity(void);
hpid_elbow_real encoder_position(void);
void drive_torque(hpid_elbow_real effort);
int64_t timer_ns(void);
void control_start(void);
void control_interrupt(void);
"""


@pytest.fixture
def controllers(tmp_path):
    """Return a function that writes a parameter file of an elbow and a wrist."""

    def write(**wrist):
        document = {
            f"/**/{joint}_controller": {"ros__parameters": {"joint": joint, **GAINS, **more}}
            for joint, more in {"elbow": {}, "wrist": wrist}.items()
        }
        file = tmp_path / "controllers.yaml"
        file.write_text(yaml.safe_dump(document))
        return file

    return write


def test_each_joint_of_a_parameter_file_becomes_c_that_answers_as_python(
    controllers, tmp_path, capsys
):
    folder = tmp_path / "firmware"
    assert main(["export", "--c", str(controllers(mu=0.1)), "-o", str(folder)]) == DONE
    ends = (".h", ".c", "_golden.h", "_test.c")
    expected = {f"hpid_{joint}{end}" for joint in ("elbow", "wrist") for end in ends}
    assert {each.name for each in folder.iterdir()} == expected
    assert f"written: {folder}" in capsys.readouterr().out
    assert ".mu = REAL(-0.2)" in (folder / "hpid_elbow.c").read_text()
    assert ".mu = REAL(0.1)" in (folder / "hpid_wrist.c").read_text()
    assert "controllers.yaml" in (folder / "hpid_wrist.h").read_text()
    program = compile_c(folder, ["hpid_wrist.c", "hpid_wrist_test.c"])
    ended = subprocess.run([program], capture_output=True, text=True, check=False)
    assert ended.returncode == 0
    assert "largest deviation 0 N m" in ended.stdout


def test_the_firmware_of_the_documentation_compiles(controllers, tmp_path):
    assert main(["export", "--c", str(controllers()), "-o", str(tmp_path)]) == DONE
    page = (ROOT / "docs" / "export.md").read_text()
    (example,) = re.findall(r"```c\n(.*?)```", page, re.DOTALL)
    (tmp_path / "firmware.c").write_text(FIRMWARE + example)
    compile_c(tmp_path, ["firmware.c"], "-c", output="firmware.o")


def test_files_in_the_way_are_replaced_only_when_asked(controllers, tmp_path, refused):
    folder = tmp_path / "firmware"
    folder.mkdir()
    (folder / "main.c").write_text("mine")
    (folder / "hpid_wrist.c").write_text("mine, too")
    arguments = ["export", "--c", str(controllers()), "-o", str(folder)]
    assert "hpid_wrist.c exists" in refused(*arguments)
    assert not (folder / "hpid_elbow.c").exists()
    assert main([*arguments, "--joint", "elbow"]) == DONE
    assert main([*arguments, "--force", "--precision", "single"]) == DONE
    assert (folder / "main.c").read_text() == "mine"
    assert "_SINGLE 1" in (folder / "hpid_wrist.h").read_text()


def test_of_an_experiment_one_controller_is_exported(experiment_file, tmp_path, refused):
    command = ["export", "--c", str(experiment_file()), "--joint", "arm_joint_1", "-o"]
    for named, law in ((["--controller", "PID"], "PID"), ([], "HPID")):
        assert main([*command, str(tmp_path / law), *named]) == DONE
        assert f"_LAW_{law}," in (tmp_path / law / "hpid_arm_joint_1.c").read_text()
    assert "unknown controller 'X'" in refused(*command, tmp_path / "x", "--controller", "X")


@pytest.mark.parametrize(
    ("wrist", "more", "line"),
    [
        ({}, ["--joint", "knee"], "unknown joint 'knee'"),
        ({}, ["--controller", "PID"], "--controller is for experiments"),
        ({"compensation": "gravity"}, [], "wrist: compensation = gravity cannot be exported"),
        ({"mu": 0.7}, [], "mu must lie in"),
        ({"mu": 0.49999999999}, ["--precision", "single"], "wrist: in single precision"),
    ],
)
def test_what_cannot_be_exported_is_one_line_and_no_file(
    controllers, tmp_path, refused, wrist, more, line
):
    folder = tmp_path / "firmware"
    assert line in refused("export", "--c", controllers(**wrist), "-o", folder, *more)
    assert not folder.exists()


def test_a_missing_file_and_a_folder_that_is_none_are_refused(controllers, tmp_path, refused):
    none, file = tmp_path / "no.yaml", controllers()
    assert "no.yaml: no such file" in refused("export", "--c", none, "-o", tmp_path)
    assert "is no folder" in refused("export", "--c", file, "-o", file)


PID = {"law": "pid", "mu": 0.0}


def test_all_joints_become_a_package_for_ros2_control(controllers, tmp_path, hpid, refused):
    folder = tmp_path / "arm_controller"
    file = str(controllers(**PID))
    arguments = ["export", file, "--ros2-control", "-o", str(folder), "--joint", "wrist"]
    code, output, _ = hpid(*arguments)
    assert code == DONE
    assert "wrist: mu -0.100 to +0.100; at its own each gain by 1/1.5 to 1.5" in output
    loop = (folder / "src" / "arm_controller_loop.c").read_text()
    assert "arm_controller_loop_step" in loop
    assert "controllers.yaml" in (folder / "README.md").read_text()
    parameters = yaml.safe_load((folder / "config" / "joints.yaml").read_text())
    assert parameters["/**/wrist_controller"]["ros__parameters"]["gains"] == GAINS["gains"]
    assert "package.xml exists" in refused(*arguments)
    code, line, _ = hpid("check-gains", folder / "config" / "certificates.json")
    assert (code, line.count("\n")) == (DONE, 1)  # not one for each corner
    assert re.match(r"wrist: all \d+ hold, mu -0.1\d* to \+0.1\d*, least rate 0.", line)


def test_a_file_of_ones_own_in_the_folder_of_a_package_is_not_replaced(
    controllers, tmp_path, monkeypatch, hpid
):
    """Which files there will be is known when the loops are certified."""
    monkeypatch.setattr(export, "gain_ranges", lambda *_: [])
    monkeypatch.setattr(export, "package_files", lambda *_: {"README.md": "new"})
    folder = tmp_path / "arm_controller"
    folder.mkdir()
    (folder / "README.md").write_text("mine")
    code, _, errors = hpid("export", controllers(**PID), "--ros2-control", "-o", folder)
    assert (code, "README.md exists" in errors) == (BAD_INPUT, True)
    assert (folder / "README.md").read_text() == "mine"


@pytest.mark.parametrize(
    ("package", "options", "reason"),
    [
        ("My-Arm", [], "'My-Arm' cannot be the name of a package"),
        ("arm", ["--precision", "single"], "--precision single is for --c"),
        ("arm", ["--inertia", "1.2"], "elbow is not certified for an inertia of 0.132"),
    ],
)
def test_a_package_that_cannot_be_is_refused_and_nothing_is_written(
    controllers, tmp_path, hpid, package, options, reason
):
    folder = tmp_path / package
    code, _, errors = hpid("export", controllers(**PID), "--ros2-control", "-o", folder, *options)
    assert (code, reason in errors) == (BAD_INPUT, True)
    assert not folder.exists()


@pytest.fixture
def urdf(tmp_path):
    """Return the file of a robot that has limits."""
    limit = '<limit lower="-1.5" upper="2.5" effort="7.5" velocity="3.0"/>'
    links = "".join(f'<link name="{name}"/>' for name in ("base", "upper", "lower"))
    joints = "".join(
        f'<joint name="{name}" type="revolute"><parent link="{above}"/><child link="{below}"/>'
        f'<axis xyz="0 0 1"/>{limit}</joint>'
        for name, above, below in (("elbow", "base", "upper"), ("wrist", "upper", "lower"))
    )
    file = tmp_path / "arm.urdf"
    file.write_text(f'<robot name="arm">{links}{joints}</robot>')
    return file


def test_limits_of_the_robot_are_exported_and_not_lost_without_a_word(
    controllers, urdf, tmp_path, refused
):
    folder = tmp_path / "firmware"
    file = controllers(robot_description="package://arm/arm.urdf")
    assert "the robot's URDF with --urdf" in refused("export", "--c", file, "-o", folder)
    assert not folder.exists()
    command = ["export", "--c", str(controllers(u_clamp_max=5.0)), "-o", str(folder)]
    assert main([*command, "--urdf", str(urdf)]) == DONE
    elbow, wrist = ((folder / f"hpid_{name}.c").read_text() for name in ("elbow", "wrist"))
    for line in (
        ".u_clamp_max = REAL(7.5)",
        ".position_min = REAL(-1.5)",
        ".velocity_max = REAL(3.0)",
    ):
        assert line in elbow
    assert ".u_clamp_max = REAL(5.0)" in wrist
    assert ".u_clamp_min = REAL(-7.5)" in wrist
