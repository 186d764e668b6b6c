"""A ros2_control user's own controllers.yaml is given as it is, and its PIDs are taken."""

import json

import pytest
import yaml
from rcl_interfaces.srv import GetParameters

from hpid_bench.cli.main import main
from hpid_bench.cli.options import parameter_file

CONTROLLERS = """
controller_manager:
  ros__parameters:
    update_rate: 500
    joint_state_broadcaster:
      type: joint_state_broadcaster/JointStateBroadcaster
    arm_controller:
      type: joint_trajectory_controller/JointTrajectoryController
joint_state_broadcaster: {}
arm_controller:
  ros__parameters:
    joints: [shoulder, elbow]
    command_interfaces: [effort]
    state_interfaces: [position, velocity]
    gains:
      shoulder: {p: 50, i: 20.0, d: 18.0, i_clamp: 5.0, ff_velocity_scale: 0.5}
      elbow: {p: 12.0, i: 5.0, d: 4.5, i_clamp: 2.0, u_clamp_max: 10.0, u_clamp_min: -10.0}
    constraints: {goal_time: 0.5, shoulder: {trajectory: 0.1}}
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "controllers.yaml"
    path.write_text(CONTROLLERS)
    return path


def test_its_pids_are_certified_and_upgraded_without_being_typed_again(file, tmp_path, capsys):
    assert main(["check-gains", str(file), "--inertia", "0.2", "--json"]) == 0
    out, err = capsys.readouterr()
    assert {name: each["law"] for name, each in json.loads(out).items()} == {
        "shoulder": "pid",
        "elbow": "pid",
    }
    line = "hpid: arm_controller: shoulder: ff_velocity_scale 0.5 is feedforward.viscous_friction"
    assert line in err
    upgraded = tmp_path / "upgraded.yaml"
    options = ["--goal", "fast", "--inertia", "0.2", "-o", str(upgraded)]
    assert main(["upgrade", str(file), *options]) == 0
    before, after = parameter_file(file), parameter_file(upgraded)
    assert before.loops.keys() == after.loops.keys()
    for name, loop in after.loops.items():
        old = before.loops[name]
        assert loop.law == "hpid"
        assert loop.mu < 0.0
        same = ("gains", "effort", "integral", "feedforward")
        assert [getattr(loop, each) for each in same] == [getattr(old, each) for each in same]


def test_its_loops_are_exported_with_a_line_for_what_no_exported_loop_has(file, tmp_path, capsys):
    assert main(["export", str(file), "--c", "-o", str(tmp_path / "c"), "--joint", "shou*"]) == 0
    assert (tmp_path / "c" / "hpid_shoulder.c").is_file()
    assert not (tmp_path / "c" / "hpid_elbow.c").exists()
    line = "hpid: shoulder: feedforward.viscous_friction is left out: no exported loop has it"
    assert line in capsys.readouterr().err


def test_a_file_without_a_pid_for_efforts_is_one_line(file, capsys):
    file.write_text(CONTROLLERS.replace("[effort]", "[position]"))
    assert main(["check-gains", str(file), "--inertia", "0.2"]) == 2
    err = capsys.readouterr().err
    assert "arm_controller: commands position, for which it uses no PID: left out" in err
    assert err.count("\n") == 1


def test_the_nodes_take_its_pids_as_defaults_which_what_is_given_overrides(
    file, harness, tmp_path
):
    given = tmp_path / "given.yaml"
    own = {"ros__parameters": {"mu": -0.2, "gains": {"p": 13.0}}}
    given.write_text(yaml.safe_dump({"elbow_controller": own}))
    harness.processes.start(
        "controllers",
        "joint_controllers",
        ["-p", f"controllers_file:={file}", "-p", "law:=hpid", "--params-file", str(given)],
        is_renamed=False,
    )
    names = ["joint", "law", "mu", "gains.p", "gains.i", "i_clamp_max", "control_period"]
    found = {}
    for joint in ("shoulder", "elbow"):
        service = f"/{joint}_controller/get_parameters"
        values = harness.call(GetParameters, service, GetParameters.Request(names=names)).values
        found[joint] = [each.string_value or each.double_value for each in values]
    assert found == {
        "shoulder": ["shoulder", "hpid", 0.0, 50.0, 20.0, 5.0, 0.002],
        "elbow": ["elbow", "hpid", -0.2, 13.0, 5.0, 2.0, 0.002],
    }
    line = "ff_velocity_scale 0.5 is feedforward.viscous_friction"
    harness.wait(lambda: line in (tmp_path / "controllers.log").read_text(), what="its log")
