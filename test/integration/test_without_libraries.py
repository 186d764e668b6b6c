"""A robot needs no optional library, the rest says what it lacks; slow ones come when needed."""

import csv
import io
import subprocess
import sys

import pytest
from harness.bags import small_log, write_bag

from hpid_ros.base.errors import LibraryError
from hpid_ros.base.libraries import OPTIONAL, optional_libraries

BENCH = {"argcomplete", "jinja2", "joblib", "matplotlib", "PIL", "rich"}
WITHOUT_PACKAGE = OPTIONAL.keys() - {"pinocchio", *BENCH}  # rosdep knows these


COMMAND = "from hpid_bench.cli.main import main; sys.exit(main(sys.argv[1:]))"


def barred(*args, libraries=OPTIONAL, program=COMMAND):
    """Run a command where some libraries cannot be imported."""
    bars = f"import sys; sys.modules.update(dict.fromkeys({list(libraries)})); "
    return subprocess.run(
        [sys.executable, "-c", bars + program, *map(str, args)],
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return write_bag(tmp_path_factory.mktemp("bags") / "run", small_log())


def test_a_recording_is_measured_as_with_them(bag):
    lacking = OPTIONAL.keys() - BENCH | {"joblib"}
    with_all, without = (
        barred("metrics", bag, "--json", libraries=each) for each in ((), lacking)
    )
    assert without.returncode == 0
    assert without.stderr == with_all.stderr
    assert without.stdout == with_all.stdout


def test_every_node_starts_and_the_recorder_says_what_it_lacks(tmp_path):
    nodes = (
        "joint_controller",
        "joint_controllers",
        "joint_command_merger",
        "bag_metrics",
        "follow_joint_trajectory",
        "trajectory_publisher",
        "pybullet_bridge",
        "mujoco_bridge",
    )
    program = f"from hpid_ros.nodes import {', '.join(nodes)}, bag_recorder as node\n"
    ended = barred(
        "--ros-args",
        "-p",
        f"bag:={tmp_path / 'bag'}",
        program=f"{program}sys.exit(node.main(sys.argv))",
        libraries=OPTIONAL.keys() - {"rclpy"},
    )
    assert ended.returncode == 2
    assert ended.stderr.startswith("writing bags, and reading those of ROS 1")
    assert ended.stderr.count("\n") == 1
    assert not (tmp_path / "bag").exists()


def test_a_robot_without_the_bench_measures_its_recordings(bag):
    """The bench is a package of its own: not even by name is it there."""
    libraries = {*OPTIONAL.keys() - {"rclpy"}, "hpid_bench"}
    program = "from hpid_ros.nodes import bag_metrics as node; sys.exit(node.main(sys.argv))"
    ended = barred("--ros-args", "-p", f"bags:=['{bag}']", program=program, libraries=libraries)
    assert ended.returncode == 0, ended.stderr
    rows = [line.split() for line in ended.stdout.splitlines()]
    assert rows[0][:2] == ["index", "joint"]
    table = csv.DictReader(io.StringIO(barred("metrics", bag, "--csv", libraries=()).stdout))
    found = {each["joint"]: each["value"] for each in table if each["quantity"] == "ivc"}
    assert len(found) > 1
    for joint, value in found.items():
        (row,) = (each for each in rows if each[:1] == ["IVC"] and each[-2] == (joint or "total"))
        assert float(row[-1]) == pytest.approx(float(value), rel=1e-4)


def test_hpid_says_what_the_bench_lacks(bag):
    ended = barred("metrics", bag, "--format", "json", libraries={"rich"})
    assert ended.returncode == 2
    (line,) = ended.stderr.splitlines()
    assert "needs rich, which is not installed: pip install 'hpid_ros[bench]'" in line


def test_the_simulated_robot_says_what_it_lacks(experiment_file, tmp_path):
    command = ("compare", experiment_file(), "--in-process", "--output", tmp_path / "result")
    ended = barred(*command, libraries=WITHOUT_PACKAGE)
    assert ended.returncode == 2
    (line,) = ended.stderr.splitlines()
    assert "engine mujoco is not installed: pip install mujoco" in line
    assert not (tmp_path / "result").exists()


def test_without_joblib_there_is_one_process_at_a_time(experiment_file, tmp_path):
    command = ("sweep", experiment_file(duration=0.05), "--vary", "mu=-0.1,0.1", "--seeds", "1")
    ended = barred(*command, "-o", tmp_path / "one", libraries={"joblib"})
    assert ended.returncode == 0
    ended = barred(*command, "-o", tmp_path / "two", "--jobs", "2", libraries={"joblib"})
    assert ended.returncode == 2
    line = ended.stderr.splitlines()[-1]
    assert "more than one process at a time (--jobs 1 needs none) needs joblib" in line
    assert "Traceback" not in ended.stderr


def test_a_module_that_nobody_may_lack_is_no_optional_one():
    with pytest.raises(LibraryError, match="lz4 needs lz4, which is not installed"):  # noqa: SIM117
        with optional_libraries():
            raise ModuleNotFoundError("No module named 'lz4'", name="lz4.frame")
    with pytest.raises(ModuleNotFoundError, match="numpy"), optional_libraries():
        raise ModuleNotFoundError("No module named 'numpy'", name="numpy")


SLOW = {"matplotlib", "mujoco", "pinocchio", "pybullet", "scipy"}
NODES = (
    "joint_controller",
    "joint_controllers",
    "single_process",
    "pybullet_bridge",
    "mujoco_bridge",
    "trajectory_publisher",
    "bag_recorder",
    "follow_joint_trajectory",
)


def imported_by(program, *arguments):
    """Return the modules that a program has imported when it ends."""
    program += "; import sys; print(*sys.modules, file=sys.stderr)"
    command = [sys.executable, "-c", program, *map(str, arguments)]
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    return set(ended.stderr.splitlines()[-1].split())


@pytest.mark.repository
def test_nothing_slow_is_imported_when_nodes_start():
    modules = {*(f"hpid_ros.nodes.{name}" for name in NODES), "hpid_bench.live.live_tuner"}
    imported = imported_by(f"import {', '.join(modules)}")
    assert modules <= imported
    assert not SLOW & imported


@pytest.mark.repository
def test_the_help_waits_for_no_library():
    assert not {"numpy", "rich", "yaml", "rosbags"} & imported_by("import hpid_bench.cli.main")


@pytest.mark.repository
def test_the_recording_of_a_robot_is_measured_without_the_simulated_one(bag):
    """And without rosbags' message types, which take as long as the measuring."""
    imported = imported_by(f"import sys; {COMMAND.replace('sys.exit', '')}", "metrics", bag)
    assert "numpy" in imported
    assert not (SLOW | {"rosbags", "jinja2", "joblib", "rclpy"}) & imported
