"""What a recording lacks is said with the numbers."""

import numpy as np
import pytest
from harness.motions import Plant, motion, needed

from hpid_bench.tuning.identification.robot_identification import identify_robot
from hpid_ros.messages.quality import DataQuality, RecordingQuality
from hpid_ros.messages.series import JointSeries, RunSeries

TIMES = np.arange(0.0, 8.0, 2e-3)
PLANT = Plant(delay=0.0)


def found(states=slice(None), commands=slice(None), effort=None, source="/joint_commands"):
    """Return the findings of a joint of which some states and commands were recorded."""
    stamps = np.round(TIMES * 1e9).astype(np.int64) + 1
    position, nobody = motion(TIMES)[0], np.empty(0)
    effort = needed(PLANT, *motion(TIMES)) if effort is None else effort
    own = JointSeries(
        "arm", stamps[states], position[states], nobody, stamps[commands], effort[commands]
    )
    quality = RecordingQuality(joints={"arm": DataQuality(effort=source)})
    return identify_robot(RunSeries("run", (own,), quality=quality), None)


def kept(share):
    """Return which samples are left when a share of them is lost."""
    return np.random.default_rng(1).uniform(size=len(TIMES)) >= share


def test_where_many_states_or_commands_are_missing_a_line_says_how_many():
    assert found().missing == ()
    assert found(kept(0.02), kept(0.02)).missing == ()
    (commands,) = found(commands=kept(0.08)).missing
    assert commands == "arm: 8% of the commands are missing"
    assert found(kept(0.08)).missing == (
        "arm: 8% of the states are missing",
        "arm: 8% of the commands answer no state that was recorded",
    )


def test_efforts_that_are_rarer_than_the_states_are_said_to_be():
    (line,) = found(commands=slice(None, None, 5)).missing
    assert "arm: efforts were recorded more rarely than states" in line


def test_a_pause_of_the_recorder_is_not_missing():
    assert found(TIMES % 4.0 < 2.5, TIMES % 4.0 < 2.5).missing == ()


@pytest.mark.parametrize("count", [3, 10])
def test_measured_efforts_that_repeat_are_held_and_said_to_be(count):
    """So their delay is that of commands, not half a hold less."""
    at = TIMES[np.arange(len(TIMES)) // count * count]
    held = needed(PLANT, *motion(at + 0.5 * count * 2e-3))
    result = found(effort=held, source="measured, of /joint_states")
    (line,) = result.missing
    assert line.startswith(f"arm: the measured efforts repeat, for {2 * count} ms each")
    assert result.joints[0].estimates["delay"].value == pytest.approx(0.0, abs=2e-4)


def test_measured_efforts_of_few_steps_are_not_taken_as_held():
    steps = 0.2 * np.round(needed(PLANT, *motion(TIMES)) / 0.2)
    assert found(effort=steps, source="measured, of /joint_states").missing == ()
    assert found(source="measured, of /joint_states").missing == ()
