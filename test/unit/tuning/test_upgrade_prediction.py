"""What an upgrade's prediction follows is what was recorded, and of which joints it speaks."""

import math

import numpy as np
import pytest
from harness.places import URDF

from hpid_bench.tuning.loop_simulation import RobotSimulation, simulate
from hpid_bench.tuning.recorded_pid import recorded_motion
from hpid_bench.tuning.upgrade_prediction import Expected, Prediction, read_prediction
from hpid_ros.base.errors import SettingError
from hpid_ros.control import LoopSettings
from hpid_ros.messages.series import JointSeries

MOVING = {key: Expected(4.0, 0.5, 1.1, 0.2) for key in ("ivc", "iavc", "itae")}


def prediction(**joints):
    return Prediction("bag", "smooth", joints)


@pytest.mark.parametrize("fidelity", [math.nan, math.inf])
def test_a_joint_that_rested_without_an_effort_is_no_reason_to_doubt_the_others(fidelity):
    resting = dict.fromkeys(MOVING, Expected(0.0, math.nan, fidelity))
    found = prediction(arm=MOVING, turn=resting)
    assert found.is_credible
    assert found.total("ivc") == pytest.approx((4.0, 0.5, 1.1, 0.2))


def test_a_file_says_null_of_what_is_no_number(tmp_path):
    resting = dict.fromkeys(MOVING, Expected(0.0, math.nan, math.inf))
    (path := tmp_path / "upgrade.json").write_text(prediction(turn=resting).as_text())
    assert "NaN" not in path.read_text()
    assert read_prediction(path).joints["turn"]["ivc"].before == 0.0


def test_a_joint_whose_model_is_wrong_is():
    wrong = dict.fromkeys(MOVING, Expected(4.0, 0.5, 3.0))
    assert not prediction(arm=MOVING, turn=wrong).is_credible
    assert not prediction(turn=dict.fromkeys(MOVING, Expected(0.0, 1.0, 1.0))).is_credible


def test_the_interval_of_all_joints_is_between_those_of_the_joints():
    sure = dict.fromkeys(MOVING, Expected(4.0, 0.5, 1.0, 0.05))
    total = prediction(arm=MOVING, turn=sure).total("ivc")
    assert 0.05 < total.doubt < 0.2
    assert total.low < total.ratio < total.high < 1.0
    assert total.is_certain
    assert not total._replace(doubt=1.0).is_certain


PERIOD_NS = 2_000_000
TIMES_NS = PERIOD_NS * np.arange(1500, dtype=np.int64)
TIMES = TIMES_NS * 1e-9


def followed(reference):
    """Return positions and velocities of the reference at the samples, (2, N)."""
    motion = recorded_motion("a", TIMES_NS, reference).start(0, float(reference[0]))
    samples = [motion.sample(int(each)) for each in TIMES_NS]
    return np.array([(each.position, each.velocity) for each in samples]).T


def test_a_smooth_reference_has_its_own_velocity():
    reference, rate = 0.4 * np.sin(3.0 * TIMES), 1.2 * np.cos(3.0 * TIMES)
    position, velocity = followed(reference)
    assert position == pytest.approx(reference, abs=1e-12)
    assert velocity == pytest.approx(rate, abs=1e-4)  # one-sided at the ends


@pytest.mark.parametrize("slope", [0.0, 0.3])
def test_a_jump_has_no_velocity_beside_that_of_what_it_lies_in(slope):
    reference = slope * TIMES + np.where(TIMES_NS >= 1_000_000_000, 0.5, 0.0)
    reference += np.where(TIMES_NS >= 1_002_000_000, -0.2, 0.0)  # two, one after the other
    position, velocity = followed(reference)
    assert position == pytest.approx(reference, abs=1e-12)
    beside = (TIMES_NS < 998_000_000) | (TIMES_NS > 1_002_000_000)
    assert velocity[beside] == pytest.approx(slope, abs=1e-6)


def test_a_ramp_that_begins_is_no_jump():
    reference = np.where(TIMES > 1.0, 0.7 * (TIMES - 1.0), 0.0)
    _, velocity = followed(reference)
    assert velocity.max() == pytest.approx(0.7, rel=1e-6)
    assert velocity.min() >= 0.0


@pytest.mark.parametrize("later_ns", [1_500_000_000, 50 * 365 * 86_400 * 1_000_000_000])
def test_a_recording_with_a_hole_is_no_motion_to_simulate(later_ns):
    """Where a clock was set there may be years between two states: nobody simulates them."""
    stamps = TIMES_NS + np.where(TIMES_NS > 1_000_000_000, later_ns, 0)
    series = JointSeries("a", stamps, TIMES, TIMES, stamps, TIMES)
    loops = {"PID": [LoopSettings.from_parameters({"joint": "a", "law": "pid"})]}
    with pytest.raises(SettingError, match=r"'a' has no state for .* s from 1\.000 s on"):
        simulate(RobotSimulation("no robot is needed"), loops, [series])


def test_a_joint_whose_reference_was_not_recorded_is_simulated_at_rest():
    stamps = TIMES_NS
    none = np.empty(0)
    series = JointSeries("arm_joint_1", stamps, 0.1 + 0.0 * TIMES, none, stamps, TIMES)
    loops = {"PID": [LoopSettings.from_parameters({"joint": "arm_joint_1", "law": "pid"})]}
    (run,) = simulate(RobotSimulation(URDF.read_text(), fixed_base=True), loops, [series])
    assert (run.joints[0].reference == 0.1).all()
