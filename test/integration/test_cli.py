"""The hpid command: exit codes, one clear line for bad input, nothing overwritten."""

import io
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from harness.engines import needs_bullet
from harness.studies import compared

from hpid_bench.cli.commands import BAD_INPUT, DONE, UNREAD
from hpid_bench.cli.main import SUBCOMMANDS, main
from hpid_bench.cli.options import progress
from hpid_bench.experiment.description import load_experiment
from hpid_bench.report.console import TextConsole
from hpid_ros.robot.description import RobotDescription
from hpid_ros.simulation.settings import ENGINES


def test_in_process_comparison_needs_no_ros_prints_the_table_and_leaves_the_result(
    experiment_file, tmp_path, monkeypatch, capsys
):
    monkeypatch.setitem(sys.modules, "rclpy", None)  # as if it were not installed
    folder = tmp_path / "result"
    options = ["--in-process", "-o", str(folder)]
    assert main(["compare", str(experiment_file()), *options]) == DONE
    assert not (folder / "figures").exists()
    printed = capsys.readouterr().out
    for word in ("IVC", "IAVC", "ITAE", "arm_joint_6", "total", "report.html"):
        assert word in printed
    result = json.loads((folder / "result.json").read_text())
    assert set(result["indices"]["runs"]) == {"PID", "hPID"}

    for label in ("PID", "hPID"):  # the nodes' files, as of a run on the graph
        nodes = folder / "nodes" / label
        assert (nodes / "world.yaml").exists()
        assert (nodes / "bridge.yaml").exists()
        assert f"law: {label.lower()}" in (nodes / "controllers.yaml").read_text()


def test_the_robots_description_is_parsed_once_in_a_command(
    experiment_file, tmp_path, monkeypatch
):
    load, parsed = RobotDescription.load, []
    monkeypatch.setattr(
        RobotDescription, "load", lambda source: parsed.append(source) or load(source)
    )
    file, folder = experiment_file(duration=0.2), tmp_path / "result"
    assert main(["compare", str(file), "--in-process", "-o", str(folder)]) == DONE
    assert len(parsed) == 1
    for robot in (parsed[0], file):
        parsed.clear()
        bag = folder / "bags" / "PID"
        assert main(["metrics", str(bag), "--robot", str(robot)]) == DONE
        assert len(parsed) == 1


@needs_bullet
def test_runs_of_one_controller_in_two_engines_are_compared_by_their_bags(
    experiment_file, tmp_path, hpid
):
    file = experiment_file(duration=0.1)
    bags, totals = [], []
    for engine in ENGINES:
        folder = compared(file, tmp_path / engine, "--engine", engine)
        runs = json.loads((folder / "result.json").read_text())["indices"]["runs"]
        bags.append(folder / "bags" / "hPID")
        totals.append(runs["hPID"]["totals"]["ivc"])
    code, printed, _ = hpid("metrics", *bags, "--labels", *ENGINES, "--json")
    assert code == DONE
    found = json.loads(printed)
    assert [found["runs"][engine]["totals"]["ivc"] for engine in ENGINES] == totals
    assert found["ratios"][ENGINES[1]]["totals"]["ivc"] == totals[1] / totals[0]


def test_an_engine_that_cannot_be_is_one_line_and_leaves_no_folder(tmp_path, monkeypatch, refused):
    monkeypatch.setitem(sys.modules, "pybullet", None)  # as if it were not installed
    folder, missing = tmp_path / "r", "is not installed: pip install pybullet, or"
    sweep, tune = ["sweep", "--vary", "mu=0.1"], ["tune", "--law", "pid"]
    for command in (["compare"], ["study"], ["run"], sweep, tune):
        assert missing in refused(*command, "--engine", "pybullet", "-o", folder)
        assert "unknown engine" in refused(*command, "--engine", "bulet", "-o", folder)
    assert not folder.exists()


def test_without_pybullet_one_line_says_who_computes(
    experiment_file, tmp_path, monkeypatch, hpid, refused
):
    monkeypatch.setitem(sys.modules, "pybullet", None)
    options = ["--vary", "mu=0.1", "--seeds", "1", "--jobs", "1", "-o"]
    unsaid = str(experiment_file(duration=0.02, simulation={"physics_steps": 1}))
    code, _, errors = hpid("sweep", unsaid, *options, tmp_path / "r")
    assert code == DONE
    line, _ = errors.splitlines()
    assert line.startswith("hpid: mujoco computes the physics: PyBullet is not installed")
    assert load_experiment(unsaid).engine_note == line.removeprefix("hpid: ")
    for chosen in (load_experiment(experiment_file()), load_experiment(unsaid, "mujoco")):
        assert chosen.engine_note == ""
    # What cannot run is one line, whoever would have computed it.
    refused("sweep", unsaid, *options, tmp_path / "r")


def test_what_cannot_be_read_run_or_written_is_one_line_and_leaves_no_folder(
    experiment_file, tmp_path, refused
):
    folder = tmp_path / "result"
    named = experiment_file(compare={"a/../b": {"mu": 0.1}})
    assert "a/../b" in refused("compare", named, "-o", folder)
    assert "cannot read none.yaml" in refused("compare", "none.yaml", "-o", folder)
    assert not folder.exists()
    told = refused("compare", "--in-process", "-o", "/proc/result")
    assert "the result folder /proc/result" in told


@pytest.mark.parametrize(
    ("command", "what"), [("compare", "hpid compare without --in-process"), ("run", "hpid run")]
)
def test_a_graph_without_ros_is_one_line_and_leaves_no_folder(
    command, what, tmp_path, monkeypatch, refused
):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    assert refused(command, "-o", tmp_path / "r").startswith(f"hpid: {what} needs ROS 2 (rclpy)")
    assert not (tmp_path / "r").exists()


def test_what_the_system_refuses_is_one_line(monkeypatch, tmp_path, refused):
    def denied(*_):
        raise PermissionError(13, "Permission denied", "/bags/x")

    monkeypatch.setattr(Path, "exists", denied)
    assert refused("metrics", tmp_path / "x") == "hpid: /bags/x: Permission denied\n"


def test_usage_errors_end_with_two():
    for arguments in (["compare", "--speed"], ["metrics", "--speed"], ["dance"]):
        with pytest.raises(SystemExit) as end:
            main(arguments)
        assert end.value.code == BAD_INPUT


@pytest.mark.parametrize(
    ("arguments", "read"), [(["schema"], b"{\n"), (["robot", "urdf/mobile_manipulator.urdf"], b"")]
)
def test_a_reader_that_has_read_enough_is_no_error(arguments, read):
    command = subprocess.Popen(
        [sys.executable, "-m", "hpid_bench.cli.main", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    try:
        assert command.stdout.read(len(read)) == read
        command.stdout.close()
        assert command.wait(60) == UNREAD
        assert command.stderr.read() == b""
    finally:
        command.kill()
        command.communicate()


@pytest.mark.faults
def test_a_reader_that_has_read_enough_costs_no_result(experiment_file, tmp_path):
    file, folder = experiment_file(duration=0.05), tmp_path / "r"
    command = ["compare", str(file), "--in-process", "--figures", "svg", "-o", str(folder)]
    reader, writer = os.pipe()
    os.close(reader)
    ended = subprocess.run(
        [sys.executable, "-m", "hpid_bench.cli.main", *command],
        stdout=writer,
        stderr=subprocess.PIPE,
    )
    os.close(writer)
    assert (ended.returncode, ended.stderr) == (UNREAD, b"")
    assert (folder / "report.html").exists()
    assert [*folder.rglob("figures/*.svg")]


def test_a_full_disk_behind_the_output_is_one_line(monkeypatch):
    monkeypatch.delenv("PYTHONUNBUFFERED", raising=False)
    command = [
        sys.executable,
        "-m",
        "hpid_bench.cli.main",
        "robot",
        "urdf/mobile_manipulator.urdf",
    ]
    with Path("/dev/full").open("w") as full:
        ended = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    said = "hpid: No space left on device\n"
    assert (ended.returncode, ended.stderr) == (BAD_INPUT, said)


def test_a_name_next_to_a_progress_bar_is_text():
    console = TextConsole(file=io.StringIO(), force_terminal=True, width=200)
    with progress(console, "joints", 1) as advanced:
        advanced("[b]elbow")
    assert "[b]elbow" in console.file.getvalue()


@pytest.mark.parametrize("command", SUBCOMMANDS)
def test_help_fits_a_screen_and_has_an_example(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")

    def lines_of(option):
        with pytest.raises(SystemExit) as ended:
            main([command, option])
        assert ended.value.code == DONE
        printed = capsys.readouterr().out.splitlines()
        assert max(map(len, printed)) <= 80
        return printed

    printed = lines_of("--help")
    assert printed[0].startswith(f"usage: hpid {command}")
    assert "examples:" in printed
    assert len(printed) <= 48
    assert len(lines_of("--help-all")) >= len(printed)


def test_hpid_alone_says_what_there_is_and_what_to_do_first(capsys):
    assert main([]) == DONE
    printed = capsys.readouterr().out
    assert max(map(len, printed.splitlines())) <= 80
    assert "first:" in printed
    assert all(f"\n  {command} " in printed for command in SUBCOMMANDS)
    for option in ("--help", "-h"):
        with pytest.raises(SystemExit):
            main([option])
        assert capsys.readouterr().out == printed


def test_a_shell_completes_commands_and_options(capsys):
    def completed(line):
        environment = os.environ | {
            **{"_ARGCOMPLETE": "1", "COMP_LINE": line, "COMP_POINT": str(len(line))},
            "_ARGCOMPLETE_STDOUT_FILENAME": "/dev/stdout",
        }
        command = [sys.executable, "-m", "hpid_bench.cli.main"]
        return subprocess.run(command, env=environment, capture_output=True, text=True).stdout

    assert {"check-gains", "compare", "completion"} == set(completed("hpid c").split())
    assert "--realtime" in completed("hpid run --re")
    for shell in ("bash", "zsh", "fish"):
        assert main(["completion", shell]) == DONE
        assert "_ARGCOMPLETE" in capsys.readouterr().out


def test_joints_without_gains_are_named(experiment_file, tmp_path, capsys):
    bare = {"joints": {"arm_joint_6": {"gains": {"p": 1.0, "d": 0.1}}}}
    file = experiment_file(duration=0.05, controllers=bare)
    options = ["--in-process", "-o", str(tmp_path / "result")]
    assert main(["compare", str(file), *options]) == DONE
    line = next(line for line in capsys.readouterr().err.splitlines() if "p, i and d" in line)
    assert "arm_joint_5: gains" in line
    assert "arm_joint_6" not in line
