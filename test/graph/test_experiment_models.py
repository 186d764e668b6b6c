"""The sections of an experiment file that make the robot less than ideal, and their way to ROS."""

from __future__ import annotations

from pathlib import Path

import pytest
import rclpy
import yaml
from harness.places import ROOT

from hpid_ros.base.errors import ExperimentError, SettingError
from hpid_ros.experiment.description import load_experiment
from hpid_ros.experiment.graph.nodes import bridge_document, write_parameters
from hpid_ros.nodes.bridge.realism import MEANINGS
from hpid_ros.nodes.bridge.world_parameters import world_settings
from hpid_ros.simulation.drives import Motor, Pwm
from hpid_ros.simulation.sensors import Homing
from hpid_ros.simulation.world.disturbances import Disturbances, PayloadChange, WrenchPulse
from hpid_ros.studies.batch import RunTask, WorldKeeper, simulate

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


def test_a_file_that_says_nothing_gives_an_ideal_robot(experiment_file):
    world = load_experiment(experiment_file()).world
    assert world.has_ideal_drives
    assert world.has_bare_encoders
    assert world.drives == world.homing == ()
    assert world.disturbances == Disturbances()


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


def test_the_schedule_is_in_nanoseconds(everything):
    assert everything.world.disturbances == Disturbances(
        (PayloadChange(100_000_000, 1.5), PayloadChange(123_456_789, 0.0)),
        (
            WrenchPulse("tool0", (1.0, 2.5, 3.0), (0.0, 0.0, 0.0), 70_000_000, 12_300_000),
            WrenchPulse("base_link", (0.0, 0.0, 0.0), (0.0, 0.0, 0.1), 0, 1_000_000),
        ),
    )


def bridge_settings(document: dict, file: Path, domain: int):
    """Return what a bridge makes of a parameter file."""
    write_parameters(file, document)
    context = rclpy.Context()
    arguments = ["--ros-args", "--params-file", str(file)]
    rclpy.init(args=arguments, context=context, domain_id=domain)
    try:
        node = rclpy.create_node("pybullet_bridge", context=context)
        try:
            return world_settings(node)
        finally:
            node.destroy_node()
    finally:
        rclpy.shutdown(context=context)


@pytest.mark.parametrize("changes", [{}, EVERYTHING], ids=["ideal", "everything"])
def test_the_bridge_builds_the_very_world_of_the_experiment(
    experiment_file, tmp_path, harness, changes
):
    experiment = load_experiment(experiment_file(**changes))
    domain = harness.context.get_domain_id()
    there = bridge_settings(bridge_document(experiment), tmp_path / "bridge.yaml", domain)
    here = experiment.world
    assert here.has_ideal_drives == there.has_ideal_drives == (not changes)
    for name in ("homing", "velocity", "position_noises", "disturbances", "counts", "seed"):
        assert getattr(there, name) == getattr(here, name), name
    if changes:
        assert there.drives == here.drives


def test_arrays_that_do_not_fit_are_refused_in_one_line(everything, tmp_path, harness):
    domain = harness.context.get_domain_id()

    def refusal(prefix: str, name: str, value: object) -> str:
        document = bridge_document(everything)
        document["/**/pybullet_bridge"]["ros__parameters"][prefix][name] = value
        with pytest.raises(SettingError) as caught:
            bridge_settings(document, tmp_path / "bridge.yaml", domain)
        return str(caught.value)

    assert "motor.resistance must have one entry for each of 8" in refusal(
        "motor", "resistance", [1.0]
    )
    assert refusal("pwm", "bits", [99] * 8).startswith("joint 'wheel_left_joint': pwm.bits 99")
    assert "payload_schedule.masses must have 2 entries" in refusal(
        "payload_schedule", "masses", [1.0]
    )
    assert "wrench_schedule.forces must have 6 entries" in refusal(
        "wrench_schedule", "forces", [1.0]
    )


def test_a_document_of_an_ideal_robot_has_nothing_new(experiment_file):
    parameters = bridge_document(load_experiment(experiment_file()))["/**/pybullet_bridge"]
    assert not set(parameters["ros__parameters"]) & {
        *("motor", "pwm", "homing", "effort_delay", "position_noise", "velocity"),
        *("payload_schedule", "wrench_schedule"),
    }


def test_a_kept_world_repeats_a_run_with_everything_on_to_the_last_bit(everything):
    task = RunTask.of(everything, "hPID")
    with WorldKeeper() as keeper:
        first = simulate(task, keeper)
        world = keeper.at_start(task.world)
        second = simulate(task, keeper)
        assert keeper.at_start(task.world) is world
    with WorldKeeper() as fresh:
        third = simulate(task, fresh)
    for series in zip(first.joints, second.joints, third.joints, strict=True):
        one, two, three = (each.position.tolist() for each in series)
        assert one == two == three


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"actuators": {"motr": {}}}, "did you mean 'actuators.motor'"),
        ({"actuators": {"motor": {"resistance": 1.0}}}, "motor.torque_constant is missing"),
        (
            {"actuators": {"motor": MOTOR | {"resistance": 0}}},
            r"actuators\.motor: motor\.resistance 0\.0",
        ),
        ({"actuators": {"motor": MOTOR | {"gear": 2}}}, r"unknown key 'actuators\.motor\.gear'"),
        ({"actuators": {"joints": {"elbow": {}}}}, "unknown joint 'elbow'"),
        (
            {"actuators": {"joints": {"arm_joint_1": {"delai": 1}}}},
            r"did you mean 'actuators\.joints\.arm_joint_1\.delay'",
        ),
        ({"actuators": {"delay": 1.5}}, r"actuators\.delay must be a whole number"),
        ({"sensors": {"noise": -1.0}}, r"sensors\.noise must be at least 0"),
        ({"sensors": {"noise": {"arm_joint_1": 0.1}}}, r"sensors\.noise\.\w+ is missing"),
        ({"sensors": {"velocity": "difference"}}, "did you mean 'differences'"),
        ({"sensors": {"homing": {"position": 1.0}}}, r"sensors\.homing\.speed is missing"),
        ({"disturbances": {"payload": {"time": 1}}}, r"disturbances\.payload must be a list"),
        (
            {"disturbances": {"payload": [{"time": 0.3, "mass": 1}]}},
            r"disturbances\.payload\[0\]\.time 0\.3 s is not before the end",
        ),
        (
            {"disturbances": {"wrenches": [{"link": "tool", "from": 0.0, "duration": 0.1}]}},
            "did you mean 'tool0'",
        ),
        (
            {
                "disturbances": {
                    "wrenches": [{"link": "tool0", "force": [1], "from": 0.0, "duration": 0.1}]
                }
            },
            r"wrenches\[0\]\.force \[1\] must be three finite numbers",
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


def test_every_parameter_of_the_bridge_is_documented_as_it_is():
    page = (ROOT / "docs" / "models.md").read_text()
    for name, meaning in MEANINGS.items():
        assert f"| `{name}` | {meaning} |" in page
