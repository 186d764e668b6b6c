"""What a controller makes of its parameters, and that a replay makes the same of them."""

from types import SimpleNamespace

import pytest
from rclpy.parameter import Parameter

from hpid_bench.tuning.recorded_loops import controllers_of
from hpid_ros.base.resources import share_folder
from hpid_ros.control.settings import LARGEST_EFFORT
from hpid_ros.nodes.parts.settings_and_health import ControllerSettings

URDF = str(share_folder() / "urdf" / "mobile_manipulator.urdf")
LOOP = {"joint": "arm_joint_2", "gains.p": 30.0, "gains.i": 60.0, "gains.d": 3.0}
ROBOT = {**LOOP, "robot_description": URDF}
DESCRIBED = {"feedforward.viscous_friction": -1.0, "feedforward.coulomb_friction": -1.0}
OWN = {"feedforward.viscous_friction": 0.3, "feedforward.coulomb_friction": 0.2}
DECOUPLED = {"compensation": "decoupling", "inertia": 0.0}


class Node:
    """A node's parameters, without a graph."""

    def __init__(self, given):
        self._given, self._values = given, {}

    def declare_parameter(self, name, start, described):
        self._values[name] = self._given.get(name, start)
        return self.get_parameter(name)

    def get_parameter(self, name):
        return SimpleNamespace(value=self._values[name])

    def set(self, changes):
        self._values |= changes


@pytest.mark.parametrize(
    ("given", "changes"),
    [
        (LOOP, [{"gains.p": 40.0}]),
        (LOOP, [{"u_clamp_max": 9.0}, {"u_clamp_min": -8.0}]),
        (ROBOT, [{"mu": -0.2, "law": "hpid"}]),
        (ROBOT, [DESCRIBED, {"gains.p": 40.0}, OWN]),
        (ROBOT | DESCRIBED, [{"position_max": 0.1}, {"position_max": 9.0}]),
        # each is allowed by what was given, though not by what the robot makes of it
        (
            ROBOT | {"u_clamp_max": LARGEST_EFFORT},
            [{"u_clamp_min": 5000.0}, {"velocity_max": 0.5}],
        ),
        (ROBOT | {"encoder_wrap": -1.0, "joint": "wheel_left_joint"}, [{"gains.i": 10.0}]),
        (ROBOT | DECOUPLED, [{"norm.effort_scale": 2.0}, {"inertia": 0.4}]),
    ],
)
def test_node_and_replay_make_the_same_settings_of_the_same_parameters(given, changes):
    node = Node(given)
    settings = ControllerSettings(node)
    document = {"a_controller": {"ros__parameters": given}}
    (replayed,) = controllers_of(document, "file").values()
    assert settings.with_changes() == replayed.settings
    so_far = {}
    for change in changes:
        found = settings.with_changes([Parameter(name, value=x) for name, x in change.items()])
        node.set(change)
        so_far |= change
        assert found == settings.with_changes() == replayed.changed(so_far)


def test_the_settings_are_within_the_robots_limits_and_have_its_friction():
    (found,) = controllers_of(
        {"a_controller": {"ros__parameters": ROBOT | DESCRIBED}}, "file"
    ).values()
    limits, settings = found.limits, found.settings
    assert settings.effort.u_clamp_max == limits.effort
    assert settings.motion.position_max == limits.upper
    assert settings.feedforward.viscous_friction == limits.damping > 0.0
    assert settings.feedforward.coulomb_friction == limits.friction > 0.0
