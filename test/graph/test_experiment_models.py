"""The sections of an experiment file that make the robot less than ideal, and their way to ROS."""

from __future__ import annotations

from pathlib import Path

import pytest
import rclpy
import yaml

from hpid_bench.experiment.batch import RunTask, WorldKeeper, simulate_task
from hpid_bench.experiment.description import load_experiment
from hpid_bench.experiment.in_process import write_document, write_run_files
from hpid_ros.base.errors import ExperimentError, HpidError
from hpid_ros.nodes.parts.bridge import read_world_file
from hpid_ros.simulation.drives import Motor, Pwm
from hpid_ros.simulation.settings import Disturbances, Homing, PayloadChange, WrenchPulse

ROBOT = {"robot": {"description": "urdf/mobile_manipulator.urdf"}}
MOTOR = {"torque_constant": 0.03, "resistance": 1.0, "supply_voltage": 24.0}
EVERYTHING = {
    "actuators": {
        "motor": {**MOTOR, "viscous_friction": 1.1e-6, "gear_efficiency": 0.83},
        "pwm": {"bits": 10, "dead_band": 0.013, "rate": 20000},
        "delay": 1,
        "joints": {
            "arm_joint_6": {"motor": {"drive": "voltage"}, "delay": 0},
            "arm_joint_5": {"motor": False, "pwm": {"bits": 12}},
        },
    },
    "sensors": {
        "encoder_counts": 16384,
        "noise": 1.7e-4,
        "velocity": "differences",
        "homing": {"speed": 0.3, "hysteresis": 0.007},
        "joints": {"wheel_left_joint": {"homing": False}, "arm_joint_1": {"homing": {"speed": 1}}},
    },
    "disturbances": {
        "payload": [{"time": 0.1, "mass": 1.5}, {"time": 0.1234567891, "mass": 0}],
        "wrenches": [
            {"link": "tool0", "force": [1, 2.5, 3], "from": 0.07, "duration": 0.0123},
            {"link": "base_link", "torque": [0, 0, 0.1], "from": 0.0, "duration": 0.001},
        ],
    },
}


@pytest.fixture
def everything(experiment_file):
    """Return an experiment in which nothing is ideal."""
    return load_experiment(experiment_file(**EVERYTHING))


def test_what_is_said_of_all_joints_holds_but_for_what_is_said_of_one(everything):
    world = everything.world
    drives = dict(zip(world.joints, world.drives, strict=True))
    motor = Motor(**MOTOR, viscous_friction=1.1e-6, gear_efficiency=0.83)
    assert drives["arm_joint_1"].motor == motor
    assert drives["arm_joint_6"].motor == Motor(**vars(motor) | {"drive": "voltage"})
    assert drives["arm_joint_5"].motor is None
    assert drives["arm_joint_5"].pwm == Pwm(12, 0.013, 20000.0)
    assert (drives["arm_joint_6"].delay, drives["arm_joint_5"].delay) == (0, 1)
    homing = dict(zip(world.joints, world.homing, strict=True))
    assert homing["wheel_left_joint"] is None
    assert homing["arm_joint_1"] == Homing(1.0, 0.0, 0.007)
    assert homing["arm_joint_2"] == Homing(0.3, 0.0, 0.007)
    assert world.position_noise == 1.7e-4
    assert world.velocity == "differences"


def test_the_schedule_is_in_whole_nanoseconds(everything):
    assert everything.world.disturbances == Disturbances(
        (PayloadChange(0.1, 1.5), PayloadChange(0.1234567891, 0.0)),
        (
            WrenchPulse("tool0", 0.07, 0.0123, force=(1.0, 2.5, 3.0)),
            WrenchPulse("base_link", 0.0, 0.001, torque=(0.0, 0.0, 0.1)),
        ),
    )
    events = everything.world.disturbances.in_order()
    assert [each.start_ns for each in events] == [0, 70_000_000, 100_000_000, 123_456_789]
    assert everything.world.disturbances.wrenches[0].duration_ns == 12_300_000


def bridge_settings(file: Path, domain: int):
    """Return what a bridge makes of a parameter file."""
    context = rclpy.Context()
    arguments = ["--ros-args", "--params-file", str(file)]
    rclpy.init(args=arguments, context=context, domain_id=domain)
    try:
        node = rclpy.create_node("mujoco_bridge", context=context)
        try:
            return read_world_file(node, "mujoco")
        finally:
            node.destroy_node()
    finally:
        rclpy.shutdown(context=context)


def bridge_parameters(**values: object) -> dict[str, object]:
    return {"mujoco_bridge": {"ros__parameters": values}}


@pytest.mark.parametrize("changes", [{}, EVERYTHING], ids=["ideal", "everything"])
def test_the_bridge_builds_the_very_world_of_the_experiment(
    experiment_file, tmp_path, module_harness, changes
):
    """From the files of a run, and from the experiment's own."""
    experiment = load_experiment(experiment_file(**changes))
    assert experiment.world.has_ideal_drives == (not changes)
    write_run_files(tmp_path, experiment, experiment.controllers["hPID"])
    write_document(tmp_path / "own.yaml", bridge_parameters(world_file=str(experiment.path)))
    for file in ("bridge.yaml", "own.yaml"):
        there = bridge_settings(tmp_path / file, module_harness.context.get_domain_id())
        assert there.world == experiment.world, file
        assert there.control.answer_timeout == experiment.answer_timeout != 2.0


def test_parameters_are_laid_over_the_file(experiment_file, tmp_path, module_harness):
    given = bridge_parameters(
        world_file=str(experiment_file(**EVERYTHING)),
        seed=7,
        physics_steps=2,
        control_rate=500.0,
        payload_mass=0.5,
        answer_timeout=0.5,
        encoder_counts=[100 + index for index in range(8)],
        initial_positions=[0.0] * 7 + [0.25],
    )
    write_document(tmp_path / "bridge.yaml", given)
    found = bridge_settings(tmp_path / "bridge.yaml", module_harness.context.get_domain_id())
    assert found.control.answer_timeout == 0.5
    world = found.world
    assert (world.seed, world.physics_steps, world.payload_mass) == (7, 2, 0.5)
    assert world.control_period_ns == 2_000_000
    assert world.counts == tuple(range(100, 108))
    assert world.initial_positions["arm_joint_6"] == 0.25
    assert world.drives[-1].motor is not None


def test_joints_that_are_not_driven_keep_their_positions_of_the_file(tmp_path, module_harness):
    places = {"arm_joint_1": 0.1, "arm_joint_2": 0.2}
    world = {"robot": {**ROBOT["robot"], "initial_positions": places}}
    write_document(tmp_path / "world.yaml", world)
    given = {"joints": ["arm_joint_1"], "initial_positions": [0.3]}
    given = bridge_parameters(world_file=str(tmp_path / "world.yaml"), **given)
    write_document(tmp_path / "bridge.yaml", given)
    found = bridge_settings(tmp_path / "bridge.yaml", module_harness.context.get_domain_id())
    assert found.world.initial_positions == {**places, "arm_joint_1": 0.3}


@pytest.mark.parametrize(
    ("file", "parameters", "message"),
    [
        ({}, {}, "world.yaml: robot is missing"),
        (ROBOT, {"encoder_counts": [1]}, "encoder_counts must have one entry for each of 8"),
        (ROBOT, {"joints": ["elbow"]}, "unknown joint 'elbow'"),
        (ROBOT, {"payload_mass": -1.0}, "payload_mass must"),
        (None, {}, "there is no file"),
    ],
)
def test_a_world_that_cannot_be_is_refused_in_one_line(
    tmp_path, module_harness, file, parameters, message
):
    world = tmp_path / "world.yaml"
    if file is not None:
        world.write_text(yaml.safe_dump(file))
    given = bridge_parameters(world_file=str(world), **parameters)
    write_document(tmp_path / "bridge.yaml", given)
    with pytest.raises(HpidError) as caught:
        bridge_settings(tmp_path / "bridge.yaml", module_harness.context.get_domain_id())
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_kept_world_repeats_a_run_with_everything_on_to_the_last_bit(everything):
    task = RunTask.of(everything, "hPID")
    with WorldKeeper() as keeper:
        first = simulate_task(task, keeper)
        world = keeper.at_start(task.world)
        second = simulate_task(task, keeper)
        assert keeper.at_start(task.world) is world
    with WorldKeeper() as fresh:
        third = simulate_task(task, fresh)
    for series in zip(first.joints, second.joints, third.joints, strict=True):
        one, two, three = (each.position.tolist() for each in series)
        assert one == two == three


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"actuators": {"motor": {"resistance": 1.0}}}, "motor.torque_constant is missing"),
        (
            {"actuators": {"joints": {"arm_joint_1": {"delai": 1}}}},
            r"did you mean 'actuators\.joints\.arm_joint_1\.delay'",
        ),
        ({"sensors": {"noise": {"arm_joint_1": 0.1}}}, r"sensors\.noise\.\w+ is missing"),
        (
            {"disturbances": {"payload": [{"time": 0.3, "mass": 1}]}},
            r"disturbances\.payload\[0\]\.time 0\.3 s is not before the end",
        ),
        (
            {"disturbances": {"wrenches": [{"link": "tool", "from": 0.0, "duration": 0.1}]}},
            "did you mean 'tool0'",
        ),
    ],
)
def test_bad_sections_are_refused_in_one_line_that_names_the_place(
    experiment_file, changes, message
):
    with pytest.raises(ExperimentError, match=message) as refusal:
        load_experiment(experiment_file(**changes))
    assert "\n" not in str(refusal.value)


def test_the_sections_survive_yaml_as_a_person_writes_them(experiment_file):
    text = "{motor: off, pwm: {bits: 8}, joints: {arm_joint_1: {pwm: off}}}"
    world = load_experiment(experiment_file(actuators=yaml.safe_load(text))).world
    pwms = dict(zip(world.joints, (drive.pwm for drive in world.drives), strict=True))
    assert pwms["arm_joint_1"] is None
    assert pwms["arm_joint_2"] == Pwm(8)
