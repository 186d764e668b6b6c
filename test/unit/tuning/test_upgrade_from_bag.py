"""A robot is simulated as the recording has it."""

import numpy as np
import pytest

from hpid_bench.tuning.identification.joint_identification import JointIdentification
from hpid_bench.tuning.identification.regression import Estimate
from hpid_bench.tuning.loop_simulation import DriveFacts
from hpid_bench.tuning.loop_statistics import position_noise
from hpid_bench.tuning.robot_model import robot_model
from hpid_bench.tuning.simulated_pid import _NoiseSearch
from hpid_bench.tuning.upgrade_from_bag import pid_margins
from hpid_ros.control import LoopSettings
from hpid_ros.messages.series import JointSeries
from hpid_ros.robot.description import GivenRobot, RobotDescription

PERIOD = 2e-3
TIMES = np.arange(0.0, 8.0, PERIOD)
URDF = """<robot name="one"><link name="stand"/><link name="arm"><inertial>
<mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="a" type="revolute"><parent link="stand"/><child link="arm"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="9" velocity="9"/><dynamics damping="0.7" friction="0.6"/>
</joint></robot>"""


def series(position, effort=1.0):
    stamps = np.round(TIMES * 1e9).astype(np.int64)
    return JointSeries("a", stamps, position, position, stamps, np.full(len(TIMES), effort))


def known(found):
    description = RobotDescription.load(URDF)
    return robot_model(GivenRobot(URDF, description), [found], [series(0.4 * np.sin(3.0 * TIMES))])


def estimates(**values):
    return {name: Estimate(value, 0.1 * abs(value)) for name, value in values.items()}


@pytest.mark.parametrize(("limit", "effort"), [(np.inf, 9.0), (40.0, 9.0), (4.0, 4.0)])
def test_what_was_found_is_laid_over_the_description(limit, effort):
    numbers = estimates(inertia=0.05, viscous=0.2, coulomb=-0.01, delay=0.0031)
    found = known(JointIdentification("a", numbers, effort_limit=limit))
    joint = found.robot.description.joints["a"]
    assert joint.reflected_inertia == pytest.approx(0.05)
    assert joint.damping == 0.2
    assert joint.friction == 0.0  # below zero nothing can be
    assert joint.effort == effort
    assert RobotDescription.load(found.robot.source).joints["a"] == joint
    assert bool(found.assumptions["a"]) == np.isfinite(limit)


@pytest.mark.parametrize(
    ("delay", "periods"), [(-5e-4, 0), (0.0, 0), (8e-4, 1), (1.5e-3, 1), (3.5e-3, 2), (1e-2, 5)]
)
def test_a_delay_is_in_whole_periods_and_half_a_physics_step_more(delay, periods):
    found = known(JointIdentification("a", estimates(inertia=0.05, delay=delay)))
    assert found.facts["a"].delay == periods


def test_a_joint_of_which_nothing_was_found_stays_as_it_is_described_and_says_so():
    found = known(JointIdentification("a", unreliable={"a": "it did not move"}))
    joint = found.robot.description.joints["a"]
    assert (joint.damping, joint.friction) == (0.7, 0.6)
    assert found.facts["a"].delay == 0
    assert "it did not move" in found.assumptions["a"][0]


def test_guesses_and_what_is_not_simulated_are_told():
    guess = Estimate(0.02, 0.05, "its interval contains zero")
    told = estimates(inertia=0.05, coulomb=0.1, offset=-0.3, stribeck=0.1)
    (first, *others) = known(JointIdentification("a", {**told, "viscous": guess})).assumptions["a"]
    assert "viscous friction 0.02 is a guess: its interval contains zero" in first
    assert ["constant load of -0.3 N m" in others[0], "Stribeck" in others[1]] == [True, True]


@pytest.mark.parametrize("noise", [0.0, 3e-6, 1e-4])
@pytest.mark.parametrize("resolution", [0.0, 2e-5])
def test_noise_is_told_from_motion_rounding_and_jumps(noise, resolution):
    chance = np.random.default_rng(5)
    position = 0.4 * np.sin(3.0 * TIMES) + noise * chance.standard_normal(len(TIMES))
    position[1000:] += 0.5
    if resolution:
        position = np.round(position / resolution) * resolution
    found = position_noise(series(position), resolution)
    assert found == pytest.approx(noise, rel=0.1, abs=max(0.25 * resolution, 1e-7))


def test_a_pid_is_checked_at_the_rate_at_which_it_ran():
    """``control_period`` is 1 ms in a parameter file that does not say it."""
    robot = known(JointIdentification("a", estimates(inertia=0.05, delay=2.0 * PERIOD)))
    pid = {"joint": "a", "law": "pid", "gains.p": 4.0, "gains.i": 1.0, "gains.d": 0.8}
    unsaid, said = (
        pid_margins(LoopSettings.from_parameters({**pid, **more}), (0.1, 0.1), robot, 0.02, True)
        for more in ({}, {"control_period": 0.02})
    )
    assert unsaid == said
    fast = pid_margins(LoopSettings.from_parameters(pid), (0.1, 0.1), robot, 0.001, True)
    assert said.phase < 0.9 * fast.phase
    settings = LoopSettings.from_parameters({**pid, "velocity_source": "filtered"})
    filtered = pid_margins(settings, (0.1, 0.1), robot, 0.001, True)
    unmeasured = pid_margins(LoopSettings.from_parameters(pid), (0.1, 0.1), robot, 0.001, False)
    assert unmeasured == filtered != fast


def test_each_margin_is_the_worst_of_the_least_and_the_largest_inertia():
    robot = known(JointIdentification("a", estimates(inertia=0.05, delay=2.0 * PERIOD)))
    gains = {"gains.p": 4.0, "gains.i": 1.0, "gains.d": 0.8}
    pid = LoopSettings.from_parameters({"joint": "a", "law": "pid", **gains})
    both, light, heavy = (
        pid_margins(pid, inertia, robot, PERIOD, True)
        for inertia in ((0.03, 2.0), (0.03, 0.03), (2.0, 2.0))
    )
    assert (both.gain, both.gain_reduction) == (light.gain, heavy.gain_reduction)


@pytest.mark.parametrize("noise", [0.02, 0.1, 0.4, None])
def test_noise_below_a_count_is_found_by_how_the_effort_varies(noise):
    """And none is taken where the effort varies whatever the noise is."""
    search = _NoiseSearch.begun(DriveFacts(0, 0.0, 1.0))
    for _ in range(8):
        if noise is None:
            search = search.after(1.0, 3.0)
        else:
            search = search.after(3.0 + search.facts.noise, 3.0 + noise)
    assert noise == (search.best and pytest.approx(search.best.noise, rel=0.1))
