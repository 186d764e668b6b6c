"""Worlds that cannot be, and what cannot be asked of one: one clear line."""

from __future__ import annotations

import math

import pytest
from harness.worlds import FLYER, MILLISECOND, START, settings

from hpid_ros.base.errors import RobotDescriptionError, SettingError
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world import World


def test_a_robot_that_cannot_be_loaded_is_one_clear_line(
    capfd: pytest.CaptureFixture[str], engine: str
):
    line = {"pybullet": "PyBullet cannot load", "mujoco": "'speck' has a collision without geom"}
    shapeless = "<collision><geometry/></collision>"
    ghost = FLYER.replace('<link name="speck"/>', f'<link name="speck">{shapeless}</link>')
    with pytest.raises(RobotDescriptionError, match=line[engine]) as caught:
        World(WorldSettings(ghost, ("hinge",)))
    assert "\n" not in str(caught.value)
    assert tuple(capfd.readouterr()) == ("", "")


def test_bad_requests_are_one_clear_line():
    with pytest.raises(RobotDescriptionError, match="did you mean 'arm_joint_2'"):
        World(settings(joints=("arm_joint2",)))
    with pytest.raises(SettingError, match=r"arm_joint_2 = 9.0 is not within its limits \[-1.9"):
        World(settings(initial_positions={"arm_joint_2": 9.0}))
    with pytest.raises(SettingError, match="did you mean 'arm_joint_2'"):
        World(settings(initial_positions={"arm_joint_22": 0.0}))
    with pytest.raises(RobotDescriptionError, match="unknown link 'hook'"):
        World(settings(payload_mass=1.0, payload_link="hook"))
    with World(settings(fixed_base=True)) as world:
        with pytest.raises(SettingError, match="7 efforts for 8"):
            world.step([0.0] * 7)
        with pytest.raises(SettingError, match="effort nan of joint 'arm_joint_6'"):
            world.step([0.0] * 7 + [math.nan])
        with pytest.raises(RobotDescriptionError, match="did you mean 'base_link'"):
            world.apply_wrench("base_lnk", (0, 0, 0), (0, 0, 0), MILLISECOND)
        with pytest.raises(SettingError, match="force"):
            world.apply_wrench("base_link", (0, math.inf, 0), (0, 0, 0), MILLISECOND)
        with pytest.raises(SettingError, match="payload_mass"):
            world.set_payload(-1.0)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"control_period_ns": 0}, "control_period_ns 0"),
        ({"physics_steps": 1.5}, "physics_steps 1.5"),
        ({"joints": ()}, "joints must name"),
        ({"payload_mass": math.nan}, "payload_mass nan"),
        ({"gravity": -1.0}, "gravity -1.0"),
        ({"encoder_counts": (1, 2)}, "2 entries for 8 joints"),
    ],
)
def test_impossible_settings_are_refused(changes: dict[str, object], says: str):
    with pytest.raises(SettingError, match=says):
        settings(**changes)


def test_a_closed_world_stays_closed():
    first = World(settings(fixed_base=True))
    first.close()
    first.close()
    with World(settings(fixed_base=True)) as second:
        # PyBullet gives the second world the first one's number.
        with pytest.raises(Exception, match=r"connected|NoneType"):
            first.step([1.0] * 8)
        assert second.true_positions() == START
