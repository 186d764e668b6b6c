"""hpid check-gains: from options, from files, from the running graph."""

import json

import pytest
from harness.graph import ros_arguments
from harness.studies import compared

from hpid_bench.cli.commands import DONE, FAILED
from hpid_bench.cli.main import main
from hpid_bench.live import running_controllers
from hpid_ros.base.resources import share_folder
from hpid_ros.stability.certification import verify_certificate
from hpid_ros.stability.closed_loop import Certificate

NEAR_THE_LIMIT = ["--p", "5", "--i", "9", "--d", "2", "--rate-weight", "3", "--inertia", "1"]


def checked(arguments, capsys):
    code = main(["check-gains", *arguments, "--json"])
    return code, json.loads(capsys.readouterr().out)


def test_a_degree_that_is_not_certified_makes_the_exit_code(capsys):
    code, verdicts = checked([*NEAR_THE_LIMIT, "--mu", "-0.2"], capsys)
    assert code == FAILED
    assert not verdicts["joint"]["is_certified"]
    certificate = Certificate.from_mapping(verdicts["joint"]["certificate"])
    assert verify_certificate(certificate).rate > 0.0


def test_a_multiplier_without_bound_is_null(tmp_path, capsys):
    given = {"joint": "a", "gains": {"p": 5.0, "i": 2.0, "d": 2.0}, "inertia": 1.0, "mu": -0.1}
    file = tmp_path / "floor.yaml"
    file.write_text(json.dumps({"a": {"ros__parameters": {**given, "norm": {"floor": 0.0}}}}))
    _, verdicts = checked([str(file)], capsys)
    assert verdicts["a"]["sampling_margin"] is verdicts["a"]["multipliers"][1] is None


def test_an_unstable_pid_is_shown_with_its_numbers(hpid):
    code, printed, _ = hpid("check-gains", "--p", 1, "--i", 9, "--d", 1, "--inertia", 1)
    assert code == FAILED
    assert "p d = 1 must exceed i x inertia = 9" in printed


def test_the_shipped_experiment_is_certified(capsys):
    file = share_folder() / "config" / "experiments" / "paper.yaml"
    code, verdicts = checked([str(file)], capsys)
    assert code == DONE
    assert len(verdicts) == 16


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "needs one source"),
        (["none.yaml"], "cannot read none.yaml"),
        (["--p", "1"], "lack --i, --d"),
        ([*NEAR_THE_LIMIT, "--mu", "0.5"], "(-0.5, 0.5), not 0.5"),
        (NEAR_THE_LIMIT[:-2], "is unknown: give --inertia"),
        ([*NEAR_THE_LIMIT, "--norm", "round"], "norm.type must be one of"),
        ([*NEAR_THE_LIMIT[:-2], "--urdf", "none.urdf"], "there is no file none.urdf"),
        ([*NEAR_THE_LIMIT[:-2], "--urdf", "urdf/mobile_manipulator.urdf"], "joint 'joint'"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_two(refused, arguments, words):
    assert words in refused("check-gains", *arguments)


def test_running_controllers_are_found_and_checked(harness, capsys):
    gains = {"gains__p": 5.0, "gains__i": 9.0, "gains__d": 2.0, "norm__rate_weight": 3.0}
    for joint, mu in (("elbow", 0.05), ("wrist", 0.4)):
        own = ros_arguments(joint=joint, mu=mu, inertia=1.0, **gains)
        harness.processes.start(f"{joint}_controller", "joint_controller", own)
    harness.wait(
        lambda: harness.states.get_subscription_count() == 2, what="both controllers to listen"
    )
    seen = []

    def are_both_seen():  # by a client that knows the graph after a second
        seen[:] = checked(["--live"], capsys)
        return len(seen[1]) == 2

    harness.wait(are_both_seen, what="both to be found")
    code, verdicts = seen
    assert code == FAILED
    certified = {name: each["is_certified"] for name, each in verdicts.items()}
    assert certified == {"elbow": True, "wrist": False}


def test_an_empty_graph_is_said(harness, monkeypatch, refused):
    monkeypatch.setattr(running_controllers, "_FOUND_WITHIN", 1.0)
    assert "the running graph has no joint controller" in refused("check-gains", "--live")


def test_certificates_of_a_result_are_verified_from_the_file(experiment_file, tmp_path, hpid):
    file = compared(experiment_file(duration=0.05), tmp_path / "result") / "certificates.json"
    code, printed, _ = hpid("check-gains", file)
    lines = printed.splitlines()
    assert (code, len(lines)) == (DONE, 8)
    assert all(line.startswith("hPID ") and ": holds, mu -0.4" in line for line in lines)
    document = json.loads(file.read_text())
    one = document["certificates"]["hPID arm_joint_1"]
    one["spans"][0]["shape"][0][0] *= 0.5
    file.write_text(json.dumps({**document, "certificates": {"hPID arm_joint_1": one}}))
    code, printed, _ = hpid("check-gains", file)
    assert code == FAILED
    assert "hPID arm_joint_1: does NOT hold" in printed
