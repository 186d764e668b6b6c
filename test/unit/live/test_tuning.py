"""What is staged is sent as it was chosen, comes back by undo, and nothing is sent by itself."""

import pytest
from harness.simulated_graph import arm, loop_settings
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import SettingError
from hpid_ros.live.session import BANDWIDTH, Tuning, slider_range

NODES = sorted(arm())


@pytest.fixture
def tuning():
    made = Tuning()
    for node, settings in arm().items():
        made.see(node, settings.to_parameters())
    return made


def take(tuning, sets, what="a step"):
    """Do as if controllers had taken sets."""
    before = {node: dict(tuning.in_force[node]) for node in sets}
    for node, values in sets.items():
        tuning.see(node, {**before[node], **values})
    tuning.note(what, sets, before)


def test_what_is_in_force_already_is_not_staged(tuning):
    for mu, staged in ((-0.2, {}), (-0.1, {NODES[0]: {"mu": -0.1}}), (-0.2, {})):
        tuning.stage(NODES[:1], "mu", mu)
        assert tuning.staged_sets(NODES) == staged
    tuning.stage(NODES[:1], "gains.p", 90)  # an integer is a number, too
    assert type(tuning.value(NODES[0], "gains.p")) is float
    tuning.unstage()
    tuning.stage(NODES[:1], "mu", -0.1)
    tuning.see(NODES[0], {**tuning.in_force[NODES[0]], "mu": -0.1})  # by somebody else
    assert tuning.staged_sets(NODES) == {}


def test_a_factor_is_of_what_each_has_in_force_however_often_it_is_turned(tuning):
    assert [tuning.factor(node, BANDWIDTH) for node in NODES] == pytest.approx([1.0] * len(NODES))
    for factor in (3.0, 0.7, 1.5):
        tuning.stage_factor(NODES, BANDWIDTH, factor)
    for node in NODES:
        before, after = tuning.in_force[node], tuning.chosen(node)
        ratios = [after[f"gains.{each}"] / before[f"gains.{each}"] for each in "pid"]
        assert ratios == pytest.approx([1.5**2, 1.5**3, 1.5])
        assert tuning.factor(node, BANDWIDTH) == pytest.approx(1.5)
    tuning.stage(NODES, "gains.d", 1.0)
    assert tuning.factor(NODES[0], BANDWIDTH) is None


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *((BANDWIDTH, each) for each in (0.0, -1.0, float("nan"), float("inf"), 1e200)),
        *(("mu", each) for each in (0.6, float("nan"), "fast", None, True)),
    ],
)
def test_a_value_that_cannot_be_stages_nothing(tuning, name, value):
    stage = tuning.stage_factor if name == BANDWIDTH else tuning.stage
    with pytest.raises(SettingError):
        stage(NODES, name, value)
    assert tuning.staged_sets(NODES) == {}


@given(st.lists(st.tuples(st.integers(0, 2), st.floats(-0.45, 0.45)), min_size=1, max_size=8))
def test_undoing_every_step_leads_back_to_the_start(steps):
    tuning = Tuning()
    for node, settings in arm().items():
        tuning.see(node, settings.to_parameters())
    for number, mu in steps:
        tuning.stage([NODES[number]], "mu", mu)
        take(tuning, tuning.staged_sets(NODES))
    while tuning.done:
        sets = tuning.undoing()
        for node, values in sets.items():
            tuning.see(node, {**tuning.in_force[node], **values})
        tuning.done.pop()
    assert tuning.in_force == tuning.first


def test_what_somebody_has_changed_since_is_not_undone(tuning):
    take(tuning, {NODES[0]: {"mu": -0.1, "gains.p": 50.0}})
    tuning.see(NODES[0], {**tuning.in_force[NODES[0]], "mu": 0.1})
    assert tuning.undoing() == {NODES[0]: {"gains.p": 80.0}}
    tuning.see(NODES[0], {**tuning.in_force[NODES[0]], "gains.p": 60.0})
    with pytest.raises(SettingError, match="somebody"):
        tuning.undoing()
    assert not tuning.done


def test_a_snapshot_is_come_back_to_from_anywhere(tuning):
    tuning.keep(" good ", NODES)
    take(tuning, {NODES[0]: {"mu": 0.3}, NODES[1]: {"gains.p": 3.0}})
    back = tuning.towards(tuning.snapshots["good"])
    assert back == {NODES[0]: {"mu": -0.2}, NODES[1]: {"gains.p": 40.0}}
    with pytest.raises(SettingError, match="name"):
        tuning.keep("  ", NODES)


def test_a_file_is_staged_for_the_controllers_that_it_names_or_whose_joints_it_has(tuning):
    loops = {
        "arm_joint_1_controller": loop_settings("arm_joint_1", 0.4, mu=0.1),
        "of_another_name": loop_settings("arm_joint_2", 0.2, mu=0.2),
    }
    assert tuning.stage_loops(loops) == NODES[:2]
    assert tuning.staged_sets(NODES) == {NODES[0]: {"mu": 0.1}, NODES[1]: {"mu": 0.2}}
    for name, joint in (("nobody", "nobody"), ("/right/arm_joint_1_controller", "arm_joint_1")):
        with pytest.raises(SettingError, match="no controller of this file is here"):
            tuning.stage_loops({name: loop_settings(joint, mu=0.3)})


def test_sliders_reach_a_decade_to_either_side():
    assert slider_range("gains.p", 40.0) == pytest.approx((4.0, 400.0, True))
    assert slider_range("gains.i", 0.0) == (0.0, 10.0, False)
    low, high, _ = slider_range("mu", 0.0)
    assert -0.5 < low < 0 < high < 0.5
