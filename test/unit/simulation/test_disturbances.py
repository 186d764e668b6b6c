"""What is scheduled happens on simulated time, every time."""

import math
from dataclasses import replace

import pytest
from harness.worlds import ARM, HOME, MILLISECOND, URDF

from hpid_ros.base.errors import RobotDescriptionError, SettingError
from hpid_ros.simulation.settings import Disturbances, PayloadChange, WorldSettings, WrenchPulse
from hpid_ros.simulation.world import World

PUSH = {"link": "tool0", "force": (5.0, 0.0, 8.0), "torque": (0.0, 0.3, 0.0)}
SETTINGS = WorldSettings(URDF, ARM, fixed_base=True, initial_positions=HOME)
SCHEDULE = Disturbances(
    (PayloadChange(0.06, 0.4), PayloadChange(0.02, 1.5)),
    (WrenchPulse(**PUSH, start=0.03, duration=0.015),),
)
CALLS = {
    20: lambda world: world.set_payload(1.5),
    30: lambda world: world.apply_wrench(**PUSH, duration_ns=15 * MILLISECOND),
    60: lambda world: world.set_payload(0.4),
}


def track(world: World, calls: dict[int, object] | None = None) -> list[tuple[float, ...]]:
    """Return the positions of 100 periods; calls are made before the period that they name."""
    positions = []
    for period in range(100):
        if calls and period in calls:
            calls[period](world)  # type: ignore[operator]
        world.step([0.0] * 6)
        positions.append(world.true_positions())
    return positions


@pytest.mark.parametrize(
    ("schedule", "calls"),
    [
        (SCHEDULE, CALLS),
        (Disturbances((PayloadChange(0, 1.5),)), {0: CALLS[20]}),  # in the first period
        (Disturbances((PayloadChange(0.019000001, 1.5),)), {20: CALLS[20]}),  # between two: later
    ],
    ids=["all", "at the start", "between two periods"],
)
def test_a_schedule_does_what_a_person_at_the_same_time_would_do(schedule, calls):
    with World(replace(SETTINGS, disturbances=schedule)) as scheduled, World(SETTINGS) as world:
        by_schedule = track(scheduled)
        assert by_schedule == track(world, calls)
        world.reset()
        undisturbed = track(world)
    begin = min(calls)
    assert by_schedule[:begin] == undisturbed[:begin]
    assert by_schedule[begin] != undisturbed[begin]
    assert math.dist(by_schedule[-1], undisturbed[-1]) > 1e-2


def test_a_reset_starts_the_schedule_again():
    with World(replace(SETTINGS, disturbances=SCHEDULE)) as world:
        once = track(world)
        world.reset()
        for _ in range(25):
            world.step([1.0] * 6)
        world.reset()
        assert track(world) == once


def test_impossible_schedules_are_refused():
    with pytest.raises(SettingError, match="time must lie in"):
        PayloadChange(-1.0, 1.0)
    with pytest.raises(SettingError, match=r"force\[0\] must be finite"):
        WrenchPulse("tool0", 0.0, 1.0, force=(math.nan, 0.0, 0.0))
    push = WrenchPulse("tool", 0.0, 1.0)
    with pytest.raises(RobotDescriptionError, match="did you mean 'tool0'"):
        World(replace(SETTINGS, disturbances=Disturbances((), (push,))))
    change = Disturbances((PayloadChange(0, 1.0),))
    with pytest.raises(RobotDescriptionError, match="unknown link 'hook'"):
        World(replace(SETTINGS, disturbances=change, payload_link="hook"))
