"""What a build installs: with colcon as ros2 run expects it, and with plain pip."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from harness.places import ROOT

pytestmark = pytest.mark.repository

EXECUTABLES = {
    *("joint_controller", "joint_controllers", "joint_command_merger"),
    *("pybullet_bridge", "mujoco_bridge"),
    *("trajectory_publisher", "follow_joint_trajectory"),
    *("bag_recorder", "bag_metrics", "live_tuner", "single_process", "hpid"),
}


def run(*command, **options):
    ended = subprocess.run(command, capture_output=True, text=True, check=False, **options)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """Return a copy of what is under version control or about to be."""
    folder = tmp_path_factory.mktemp("workspace") / "src" / "hpid_ros"
    names = ("package.xml", "setup.py", "setup.cfg", "resource", "config", "launch", "urdf")
    folder.mkdir(parents=True)
    for name in (*names, "hpid_ros", "LICENSE", "README.md"):
        run("cp", "-r", str(ROOT / name), str(folder / name))
    return folder


@pytest.fixture(scope="module")
def installed(source):
    """Return the install tree of a colcon build."""
    workspace = source.parents[1]
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    colcon = Path(sys.executable).parent / "colcon"
    run(colcon, "build", "--event-handlers", "console_direct+", cwd=workspace, env=environment)
    return workspace / "install" / "hpid_ros"


def test_colcon_puts_every_executable_where_ros2_run_looks(installed):
    found = {path.name for path in (installed / "lib" / "hpid_ros").iterdir()}
    assert found == EXECUTABLES
    assert all(os.access(installed / "lib" / "hpid_ros" / name, os.X_OK) for name in found)


def test_colcon_builds_it_as_an_ament_package(installed):
    index = installed / "share" / "ament_index" / "resource_index" / "packages" / "hpid_ros"
    assert index.is_file()
    share = installed / "share" / "hpid_ros"
    assert (share / "hook").is_dir(), "no ament hooks: colcon fell back to a plain package"
    for name in ("package.xml", "config", "launch", "urdf"):
        assert (share / name).exists()
    for file in (ROOT / "config").rglob("*.yaml"):
        assert (share / file.relative_to(ROOT)).read_bytes() == file.read_bytes()


def test_an_installed_executable_finds_its_share_folder(installed, tmp_path):
    """Run from elsewhere, with the install tree sourced, as ros2 run does."""
    script = (
        f". {installed}/share/hpid_ros/package.sh && {installed}/lib/hpid_ros/hpid --version && "
        f"{sys.executable} -c 'from hpid_ros.base.files import share_folder as s; print(s())'"
    )
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    environment["COLCON_CURRENT_PREFIX"] = str(installed)
    version, share = run("sh", "-c", script, cwd=tmp_path, env=environment).splitlines()
    assert version.startswith("hpid_ros ")
    assert Path(share) == installed / "share" / "hpid_ros"


def test_a_wheel_holds_every_file_and_command(source, tmp_path):
    run(
        *(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"),
        *("--wheel-dir", str(tmp_path), str(source)),
    )
    (wheel,) = tmp_path.glob("hpid_ros-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        (entries,) = (name for name in names if name.endswith("entry_points.txt"))
        entry_points = archive.read(entries).decode()
    for path in ("config/experiments/paper.yaml", "urdf/mobile_manipulator.urdf", "package.xml"):
        assert any(name.endswith(f"data/share/hpid_ros/{path}") for name in names)
    of_report = ("report/assets/chart.js", "report/templates/page.html")
    for file in ("py.typed", *of_report, "tuning/templates/loop.c", "tuning/templates/loop.h"):
        assert f"hpid_ros/{file}" in names
    assert all(f"{name} = hpid_ros." in entry_points for name in EXECUTABLES)
