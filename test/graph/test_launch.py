"""The launch files, where ROS's own launch is installed."""

import os
import shutil
import signal
import subprocess

import pytest
from ament_index_python import PackageNotFoundError, get_package_prefix
from harness.places import ROOT
from harness.ros2_control import Ros2Control


def is_there():
    try:
        return bool(shutil.which("ros2") and get_package_prefix("hpid_ros"))
    except PackageNotFoundError:
        return False


pytestmark = [
    pytest.mark.skipif(
        not is_there(), reason="no ros2 launch, which PyPI has not, that knows hpid_ros"
    ),
    pytest.mark.timeout(200),
]


@pytest.fixture
def launch(harness, tmp_path):
    """Return a function that launches the robot, its output going into ``launch.log``."""
    started = []

    def start(*arguments, file="robot.launch.py"):
        with (tmp_path / "launch.log").open("wb") as log:
            process = subprocess.Popen(
                ["ros2", "launch", "hpid_ros", file, *arguments],
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                env={**os.environ, "ROS_LOG_DIR": str(tmp_path / "ros")},
            )
        started.append(process)
        return process

    yield start
    for process in started:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
            process.wait(30)


def nodes(harness, namespace):
    endpoints = harness.node.get_publishers_info_by_topic("/parameter_events")
    return {each.node_name for each in endpoints if each.node_namespace == namespace}


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_namespaced_robot_comes_up_and_goes_with_its_launch(
    harness, launch, experiment_file, tmp_path, ending
):
    process = launch(
        f"experiment:={experiment_file()}", "namespace:=left", "composed:=true", "controller:=PID"
    )
    log = tmp_path / "launch.log"
    harness.wait(lambda: log.read_text().count("active: joint") == 8, within=120.0, what="joints")
    assert "left.arm_joint_1_controller" in log.read_text()
    assert {"mujoco_bridge", "arm_joint_1_controller"} <= nodes(harness, "/left")
    process.send_signal(ending)
    process.wait(30)
    harness.wait(lambda: not nodes(harness, "/left"), within=60.0, what="the nodes to end")


@pytest.mark.parametrize("composed", ["true", "false"])
def test_controllers_and_their_merger_come_up_before_ros2_control(
    harness, launch, tmp_path, composed
):
    file = ROOT / "config" / "ros2_control" / "joint_controllers.yaml"
    with Ros2Control(harness.context, {"shoulder": 2.0, "elbow": 0.5}) as control:
        control.load(["shoulder", "elbow"], kind="group", name="effort_controller")
        process = launch(
            f"params_file:={file}", f"composed:={composed}", file="ros2_control.launch.py"
        )
        harness.wait(lambda: control.controller.received, within=120.0, what="commands")
        process.send_signal(signal.SIGINT)
        process.wait(30)
        assert not control.refused
    harness.wait(lambda: "joint_command_merger" not in nodes(harness, "/"), what="the end")


def test_a_launch_whose_processes_fail_ends_with_their_reason(
    harness, launch, tmp_path, experiment_file
):
    (tmp_path / "taken").mkdir()
    process = launch(f"experiment:={experiment_file()}", f"bag:={tmp_path / 'taken'}")
    assert process.wait(120) == 1
    lines = (tmp_path / "launch.log").read_text().splitlines()
    (line,) = [line for line in lines if "Caught exception in launch" in line]
    assert "ended with exit code 2" in line
    assert "exists already" in line


@pytest.mark.parametrize(
    ("file", "given"),
    [("comparison.launch.py", "experiment:={}"), ("ros2_control.launch.py", "params_file:={}")],
)
def test_a_launch_whose_processes_refuse_what_they_are_given_ends_with_that(
    launch, tmp_path, file, given
):
    (tmp_path / "bad.yaml").write_text(
        "/**/joint_controllers: {ros__parameters: {joints: [elbow], merge: true}}\n"
        "/**/elbow_controller: {ros__parameters: {joint: elbow, mu: -3.0}}\n"
    )
    process = launch(given.format(tmp_path / "bad.yaml"), file=file)
    assert process.wait(120) == 1
    lines = (tmp_path / "launch.log").read_text().splitlines()
    (line,) = [line for line in lines if "Caught exception in launch" in line]
    assert "ended with exit code 2: " in line
