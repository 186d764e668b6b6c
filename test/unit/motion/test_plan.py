"""Plans keep to shares of what each joint has left, and the watch sees what goes beyond."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from hpid_ros.base.errors import SettingError
from hpid_ros.live.dead_man import Watch, goal_of, group_settings
from hpid_ros.motion.excitation import (
    Design,
    ExcitationPlan,
    JointBounds,
    Wish,
    inertia_from_gains,
    plan,
)

MS = 1_000_000
ELBOW = JointBounds("elbow", "/elbow_controller", 0.5, 2.0, -1.0, 1.0, 2.0, (-10.0, 8.0), 0.1)
WRIST = replace(ELBOW, joint="wrist", position=-0.2, load=0.0, inertia=0.01)
SHORT = Design(duration=5.0, band=(0.5, 2.5), fade=1.0)


def test_a_plan_takes_shares_of_what_is_left():
    (found,) = plan([ELBOW], Wish(share=0.5, amplitude=9.0), SHORT).joints
    assert found.peaks.position <= 0.25 + 1e-9  # half of the way to the nearer stop
    assert found.peaks.velocity <= 1.0 + 1e-9
    assert found.effort <= 3.0 + 1e-9  # half of what is left beside the load of 2 N m
    shares = found.peaks.position / 0.25, found.peaks.velocity, found.effort / 3.0
    assert max(shares) == pytest.approx(1.0)
    assert found.velocity_stop <= ELBOW.velocity


@pytest.mark.parametrize("are_together", [False, True])
def test_joints_move_one_by_one_or_together(are_together):
    made = plan([ELBOW, WRIST], Wish(), SHORT._replace(are_together=are_together))
    moving = np.abs(made.velocities) > 1e-9
    assert np.any(moving[:, 0] & moving[:, 1]) == are_together
    assert np.any(moving, axis=0).all()
    assert not made.positions[[0, -1]].any()
    assert not moving[made.times < 0.5].any()


def test_a_plan_comes_back_from_json():
    made = plan([ELBOW, replace(WRIST, upper=math.inf)], Wish(), SHORT)
    again = ExcitationPlan.from_mapping(json.loads(json.dumps(made.as_mapping())))
    assert again.joints == made.joints
    for name in ("times", "positions", "velocities", "accelerations"):
        assert np.array_equal(getattr(again, name), getattr(made, name))
    with pytest.raises(SettingError, match="no plan"):
        ExcitationPlan.from_mapping({"joints": [{}]})


@pytest.mark.parametrize(
    ("change", "wish", "line"),
    [
        ({"position": 1.2}, Wish(), "elbow is at 1.2 rad, beyond its limits of -1 and 1 rad"),
        ({"load": 8.5}, Wish(), "elbow is held by 8.5, its effort limits are -10 and 8"),
        ({}, Wish(share=1.5), "a share of the limits must be in"),
        ({}, Wish(amplitude=0.0), "the largest amplitude must be positive"),
        ({}, Wish(velocity=math.nan), "the largest velocity must be positive, not nan"),
    ],
)
def test_what_cannot_be_moved_is_refused(change, wish, line):
    with pytest.raises(SettingError, match=line):
        plan([replace(ELBOW, **change)], wish, SHORT)


def test_what_is_not_known_is_assumed_and_said():
    free = {"velocity": math.inf, "efforts": (-math.inf, math.inf)}
    (found,) = plan([replace(ELBOW, **free)], Wish(), SHORT).joints
    assert len(found.notes) == 2
    assert found.peaks.velocity <= 1.0 + 1e-9
    (found,) = plan([replace(ELBOW, is_inertia_guessed=True)], Wish(), SHORT).joints
    assert found.notes == ("its inertia is taken from its gains, 0.1 kg m^2",)


def test_the_inertia_of_gains_has_a_damping_ratio_of_one():
    inertia, p, d = inertia_from_gains(40.0, 4.0), 40.0, 4.0
    assert d / (2.0 * math.sqrt(p * inertia)) == pytest.approx(1.0)
    with pytest.raises(SettingError):
        inertia_from_gains(0.0, 4.0)


def test_a_plan_too_long_for_one_trajectory_is_refused():
    joints = [replace(ELBOW, joint=f"joint_{number}") for number in range(7)]
    with pytest.raises(SettingError, match="knots, 45000 are allowed"):
        plan(joints, Wish(), Design(duration=300.0, band=(0.1, 10.0)))


def test_the_watch_sees_positions_speeds_and_efforts_beyond_limits():
    made = plan([ELBOW, WRIST], Wish(), SHORT)
    rest = [(0.5, 0.0), (-0.2, 0.0)]
    watch = Watch(made)
    assert watch.see(0, rest, [2.0, None]) == ""
    assert "elbow is at 1.1 rad" in watch.see(1 * MS, [(1.1, 0.0), rest[1]], [2.0, 0.0])
    fast = made.joints[1].velocity_stop + 0.01
    assert "wrist moves at" in watch.see(2 * MS, [rest[0], (-0.2, -fast)], [2.0, 0.0])


def test_a_moment_at_the_effort_limit_is_no_reason_to_stop():
    watch = Watch(plan([ELBOW], Wish(), SHORT))
    seen = [watch.see(k * MS, [(0.5, 0.0)], [7.9]) for k in (0, 20, 40)]
    assert seen == ["", "", ""]
    assert watch.see(41 * MS, [(0.5, 0.0)], [1.0]) == ""
    assert watch.see(42 * MS, [(0.5, 0.0)], [-9.9]) == ""
    assert "elbow needs -9.9 N m, its limits are -10 and 8" in watch.see(
        100 * MS, [(0.5, 0.0)], [-9.9]
    )


def test_a_goal_begins_where_references_stand():
    made = plan([ELBOW, WRIST], Wish(), SHORT)
    goal = goal_of(made, [0.51, -0.19])
    assert goal.arrays.positions[0] == pytest.approx([0.51, -0.19])
    settings = group_settings(made, 0.5, 0.5, is_simulated=False)
    assert settings.joints == ("elbow", "wrist")
    assert settings.decelerations == tuple(each.peaks.acceleration for each in made.joints)
    assert settings.tolerances.path["elbow"].position == made.joints[0].tolerance
