"""Joints that give, efforts stamped late, neighbours that stood still: told and bracketed."""

import numpy as np
import pytest
from harness.joints import PERIOD, Joint, moved, sines

from hpid_bench.tuning.identification.identify import identify
from hpid_bench.tuning.identification.joint_record import JointRecord


def record(joint, reference, late=0, name="a", **options):
    series, _ = moved(joint, joint.settings(), reference, late=late, **options)
    time, efforts = series.time, series.command_time
    return JointRecord(name, time, series.position, efforts, series.effort, series.reference)


@pytest.mark.parametrize("stiffness", [500.0, 1500.0, 4000.0])
def test_a_flexible_joint_is_recognised_and_its_numbers_are_those_of_both_masses(stiffness):
    joint = Joint(stiffness=stiffness)
    (found,) = identify([record(joint, sines(10.0))])
    assert not found.is_rigid
    for name in ("inertia", "viscous", "delay"):
        assert "not one rigid mass" in found.estimates[name].reason
    assert found.estimates["inertia"].value == pytest.approx(joint.inertia, rel=0.05)
    assert abs(found.estimates["delay"].value - joint.delay * PERIOD) < 1e-3


@pytest.mark.parametrize(
    "joint", [Joint(), Joint(delay=6), Joint(count=1.5e-3), Joint(noise=2e-4), Joint(coulomb=1.0)]
)
def test_a_rigid_joint_is_not_taken_for_a_flexible_one(joint):
    (found,) = identify([record(joint, sines(10.0, seed=3))])
    assert found.is_rigid
    assert found.reliable("inertia").value == pytest.approx(joint.inertia, rel=0.05)
    assert found.reliable("delay") is not None


@pytest.mark.parametrize("late", [4, 9, 20])
def test_a_delay_that_cannot_be_is_found_and_bracketed(late):
    joint = Joint()
    (found,) = identify([record(joint, sines(10.0), late)])
    delay = found.estimates["delay"]
    assert delay.value == pytest.approx((joint.delay - late) * PERIOD, abs=1e-3)
    assert "cannot be" in delay.reason
    assert found.reliable("inertia").value == pytest.approx(joint.inertia, rel=0.05)


def test_only_what_moved_moved_at_the_same_time():
    own = record(Joint(), sines(10.0, amplitude=0.02), name="own")
    chance = np.random.default_rng(1)
    jitter = 2e-3 * chance.standard_normal(len(own.time))
    still = JointRecord("still", own.time, 0.7 + jitter, own.time, 0.0 * own.time)
    moving = JointRecord("moving", own.time, own.position[::-1].copy(), own.time, 0.0 * own.time)
    frozen = JointRecord("frozen", own.time, 0.0 * own.time, own.effort_time, own.effort)
    found = identify([own, still, moving, frozen], wanted=["own", "frozen"])
    (remark,) = found[0].remarks
    assert remark.startswith("moving moved at the same time")
    assert not found[1].is_found
    assert not found[1].remarks
