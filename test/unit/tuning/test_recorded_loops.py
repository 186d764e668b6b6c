"""Controllers of a parameter file: one for each joint."""

import pytest

from hpid_ros.base.errors import SettingError
from hpid_ros.tuning.recorded_loops import controllers_of

GAINS = {"gains": {"p": 2.0, "d": 3.0}}


def of(**joints):
    return {node: {"ros__parameters": {"joint": joint, **GAINS}} for node, joint in joints.items()}


def test_each_joint_has_the_controller_that_names_it():
    found = controllers_of(of(a="elbow", b="wrist"), "file")
    assert {joint: each.node for joint, each in found.items()} == {"elbow": "a", "wrist": "b"}


def test_of_two_controllers_of_a_joint_none_is_taken_by_chance():
    with pytest.raises(SettingError, match=r"two controllers of 'elbow': a and b; .*--pa"):
        controllers_of(of(a="elbow", b="elbow"), "file")


def test_another_robots_controller_of_the_same_name_does_not_count():
    document = {**of(**{"/left/arm": "elbow"}), **of(**{"/right/arm": "elbow"})}
    with pytest.raises(SettingError, match="/left/arm and /right/arm"):
        controllers_of(document, "file")
    assert controllers_of(document, "file", "/right").keys() == {"elbow"}


def test_a_relay_is_allowed_only_where_the_parameters_say_so():
    document = of(a="elbow", b="wrist")
    document["a"]["ros__parameters"]["allow_relay"] = True
    allowed = [each.allows_relay for each in controllers_of(document, "file").values()]
    assert allowed == [True, False]
    document["/**"] = {"ros__parameters": {"allow_relay": True}}
    assert all(each.allows_relay for each in controllers_of(document, "file").values())
