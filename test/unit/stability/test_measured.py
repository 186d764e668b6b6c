"""A measured frequency response is that of the joint, as far as it claims to be."""

import re
from dataclasses import replace

import numpy as np
import pytest
from harness.loops import loop_settings
from harness.motions import excited_run, multisine, reference_column

from hpid_ros.base.errors import SettingError
from hpid_ros.base.resources import find_resource
from hpid_ros.control import Gains, JointLoop
from hpid_ros.messages.series import SeriesError, complete_run
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.dynamics import Dynamics
from hpid_ros.simulation.engine import record_run
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world import World
from hpid_ros.stability.frequency import FrozenLoop, SampledJoint
from hpid_ros.stability.measured_margins import distance, measured_joint, measured_loop

PERIOD, SAMPLES = 0.001, 16384
JOINT = SampledJoint(0.105, PERIOD, 0.5, 0.4e-3)
SETTINGS = loop_settings(
    gains=Gains(21.0, 52.5, 2.1),
    law="pid",
    velocity_source="filtered",
    velocity_filter_time_constant=0.005,
)
REFERENCE = multisine(SAMPLES, 2e-4, range(2, 1600), PERIOD)


def series_of(**changes):
    (series,) = excited_run(SETTINGS, JOINT, REFERENCE, **changes).joints
    return series


def test_an_excited_joint_is_found_as_it_is():
    measured = measured_joint(series_of())
    found = distance(FrozenLoop(SETTINGS, JOINT), measured)
    assert measured.frequency.size > 150
    assert found.median < 0.005
    assert found.most < 0.03
    assert found.inertia == pytest.approx(JOINT.inertia, rel=5e-3)
    assert found.sensitivity == pytest.approx(found.computed_sensitivity, rel=0.02)


def test_neither_noise_nor_disturbance_biases_what_is_left():
    """In spite of the loop: the spectra are those with the reference."""
    measured = measured_joint(series_of(noise=1e-5, disturbance=0.05), 0.9)
    loop = FrozenLoop(SETTINGS, JOINT)
    quiet = measured_joint(series_of())
    assert 50 < measured.frequency.size < quiet.frequency.size
    off = measured_loop(loop, measured) / loop.response(measured.frequency) - 1.0
    assert abs(np.mean(off)) < 0.03
    # What is left scatters as the coherence says, and not much more.
    scatter = np.abs(off) / np.maximum(measured.spread, 0.01)
    assert np.median(scatter) < 2.0
    assert np.all(measured.coherence >= 0.9)


def test_another_joint_is_told_from_the_one_computed():
    measured = measured_joint(series_of())
    heavier = FrozenLoop(SETTINGS, SampledJoint(0.13, PERIOD, 0.5, 0.4e-3))
    late = FrozenLoop(SETTINGS, SampledJoint(0.105, PERIOD, 0.5, 2.4e-3))
    assert distance(heavier, measured).median > 0.1
    assert distance(heavier, measured).inertia == pytest.approx(0.105, rel=0.02)
    assert distance(late, measured).median > 0.1


@pytest.mark.slow
def test_mujoco_is_the_computed_joint_within_two_percent():
    """Eight seconds in this process, with 32 physics steps a period; what those leave is T/64."""
    text = find_resource("urdf/mobile_manipulator.urdf").read_text()
    text = re.sub(r'friction="[0-9.]+"', 'friction="0.0"', text)  # what no linear model has
    name = "arm_joint_1"
    robot = RobotDescription.load(text)
    inertia = Dynamics(robot, True).joint_inertias([name], {})[name]
    settings = SETTINGS.with_parameters({"joint": name})
    world = WorldSettings(
        robot_description=text, joints=(name,), fixed_base=True, engine="mujoco", physics_steps=32
    )
    reference = multisine(8192, 2e-4, range(1, 600), PERIOD)
    loop = JointLoop(settings)
    loop.follow(reference_column(name, reference, PERIOD))
    with World(world) as simulated:
        stamps_ns, *columns = record_run(simulated, [loop], reference.size - 1)
    measured = measured_joint(complete_run("mujoco", [name], stamps_ns, columns).joints[0])
    joint = SampledJoint(inertia, PERIOD, robot.joints[name].damping)
    found = distance(FrozenLoop(settings, joint), measured)
    assert found.median < 0.02
    assert found.most < 0.05
    assert found.inertia == pytest.approx(inertia, rel=5e-3)


def test_what_is_missing_ends_a_stretch_and_the_longest_is_used():
    series = series_of()
    keep = np.ones(SAMPLES, bool)
    keep[4000:4003] = False
    stamps, efforts = series.command_stamps_ns[keep], series.effort[keep]
    measured = measured_joint(replace(series, command_stamps_ns=stamps, effort=efforts))
    assert measured.duration == pytest.approx((SAMPLES - 4003) * PERIOD)
    assert distance(FrozenLoop(SETTINGS, JOINT), measured).median < 0.01


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"reference": np.zeros(0)}, "no reference was recorded"),
        ({"reference": np.zeros(SAMPLES)}, "does not move"),
        ({"command_stamps_ns": np.zeros(0, np.int64), "effort": np.zeros(0)}, "no effort was"),
        ({"position": np.random.default_rng(3).standard_normal(SAMPLES)}, "no frequency has"),
        ({"command_stamps_ns": lambda stamps: stamps + 7}, "no command answers"),
        (
            dict.fromkeys(("command_stamps_ns", "effort"), lambda values: values[:200]),
            "200 samples without a gap are too few",
        ),
    ],
)
def test_a_recording_that_tells_nothing_says_why(change, words):
    series = series_of()
    change = {
        name: of(getattr(series, name)) if callable(of) else of for name, of in change.items()
    }
    with pytest.raises(SeriesError, match=words):
        measured_joint(replace(series, **change))
    with pytest.raises(SettingError, match="must lie in"):
        measured_joint(series, 1.0)
