"""What the board reads: counts, noise, differences of positions, and the zero of a homing run."""

import math
from dataclasses import replace

import numpy as np
import pytest
from harness.worlds import URDF, WHEELS

from hpid_ros.base.errors import SettingError
from hpid_ros.simulation.engine import Sample, run_in_process
from hpid_ros.simulation.settings import Homing, WorldSettings
from hpid_ros.simulation.world import Sensors, World

PERIOD = 1e-3  # [s]


def on_stand(**changes: object) -> WorldSettings:
    """Return two wheels on a stand."""
    return WorldSettings(URDF, **({"joints": WHEELS, "fixed_base": True} | changes))  # type: ignore[arg-type]


def readings(settings: WorldSettings, periods: int = 60, looks: int = 1) -> np.ndarray:
    """Return all positions read while the wheels turn, (periods + 1, joints)."""
    with World(settings) as world:
        seen = [world.read()]
        for _ in range(periods):
            world.step([1.0] * len(settings.joints))
            for _ in range(looks):
                last = world.read()
            seen.append(last)
        return np.array(seen)


def test_the_error_of_homing_is_in_every_reading_and_differs_from_joint_to_joint():
    homing = Homing(speed=0.5, position=0.3, hysteresis=0.01)
    plain = on_stand(seed=5, encoder_counts=16384)
    offsets = readings(replace(plain, homing=(homing, homing))) - readings(plain)
    assert offsets == pytest.approx(np.tile(offsets[0], (len(offsets), 1)), abs=1e-12)
    assert offsets[0] == pytest.approx(
        Sensors(replace(plain, homing=(homing, homing)), (0.0, 0.0)).offsets
    )
    assert 0.004 < abs(offsets[0][0]) != abs(offsets[0][1]) > 0.004
    one = readings(replace(plain, homing=(None, homing))) - readings(plain)
    assert np.all(one[:, 0] == 0.0)
    assert one[:, 1] == pytest.approx(offsets[:, 1])


def test_noise_has_the_deviation_asked_for_and_no_memory():
    deviation = 1e-3
    sensors, noise = Sensors(on_stand(position_noise=deviation), (0.0, 0.0)), []
    for _ in range(1500):
        sensors.sample((0.0, 0.0))
        noise.append(sensors.positions)
    noise = np.array(noise)
    assert np.std(noise, axis=0) == pytest.approx(deviation, rel=0.08)
    assert np.mean(noise, axis=0) == pytest.approx(0.0, abs=5 * deviation / math.sqrt(1500))
    left, right = noise.T
    assert abs(np.corrcoef(left[1:], left[:-1])[0, 1]) < 0.1
    assert abs(np.corrcoef(left, right)[0, 1]) < 0.1


def test_a_joints_noise_depends_neither_on_the_other_joints_nor_on_the_looks():
    noisy = on_stand(position_noise=1e-3, seed=3)
    both = readings(noisy) - readings(on_stand())
    alone = on_stand(joints=(WHEELS[1],))
    one = readings(replace(alone, position_noise=1e-3, seed=3)) - readings(alone)
    assert both[:, 1] == pytest.approx(one[:, 0], abs=1e-12)
    assert np.array_equal(readings(noisy), readings(noisy, looks=3))
    assert not np.array_equal(readings(noisy), readings(replace(noisy, seed=4)))
    quiet = readings(replace(noisy, position_noise=(0.0, 1e-3))) - readings(on_stand())
    assert np.all(quiet[:, 0] == 0.0)
    assert np.array_equal(quiet[:, 1], both[:, 1])


def test_noise_comes_before_the_counts():
    counts = 4096
    seen = readings(on_stand(position_noise=1e-2, encoder_counts=counts))
    whole = (seen - seen[0]) / math.tau * counts
    assert whole == pytest.approx(np.round(whole), abs=1e-6)


def test_velocities_are_the_differences_of_what_was_read():
    with World(on_stand(velocity="differences", encoder_counts=4096)) as world:
        assert world.read_velocities() == (0.0, 0.0)
        before = world.read()
        for _ in range(80):
            world.step([1.0, -2.0])
            now = world.read()
            difference = np.subtract(now, before) / PERIOD
            assert world.read_velocities() == pytest.approx(difference, abs=1e-12)
            error = np.abs(np.subtract(world.read_velocities(), world.true_velocities()))
            assert error.max() < math.tau / 4096 / PERIOD + 0.2  # one count, and one period's gain
            before = now
    with World(on_stand(encoder_counts=4096)) as world:
        assert world.read_velocities() is None


@pytest.mark.parametrize("seed", [None, 9])
def test_a_reset_gives_the_same_readings_as_a_fresh_world(seed: int | None):
    homing = Homing(0.4, -0.2, 0.01)
    settings = on_stand(
        position_noise=1e-3,
        homing=(homing, None),
        velocity="differences",
        encoder_counts=2048,
        seed=2,
    )

    def run(world: World) -> list[object]:
        seen: list[object] = [world.read(), world.read_velocities()]
        for _ in range(40):
            world.step([1.0, -1.0])
            seen += [world.read(), world.read_velocities()]
        return seen

    with World(replace(settings, seed=2 if seed is None else seed)) as world:
        fresh = run(world)
    with World(settings) as world:
        run(world)
        world.reset(seed)
        assert run(world) == fresh


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"position_noise": -1.0}, "position_noise -1.0"),
        ({"position_noise": (0.0, math.nan)}, "position_noise"),
        ({"position_noise": (1e-3,)}, "position_noise has 1 entries for 2 joints"),
        ({"homing": (None,)}, "homing has 1 entries for 2 joints"),
        ({"velocity": "tachometer"}, "velocity 'tachometer' must be one of none, differences"),
    ],
)
def test_impossible_sensors_are_refused(changes: dict[str, object], says: str):
    with pytest.raises(SettingError, match=says):
        on_stand(**changes)


def test_the_loops_get_the_velocities_and_none_where_there_are_none():
    class Listener:
        def __init__(self) -> None:
            self.heard: list[float | None] = []

        def step(self, stamp_ns: int, position: float, velocity: float | None = None) -> float:
            self.heard.append(velocity)
            return 1.0

    for source in ("differences", "none"):
        samples: list[Sample] = []
        loops = [Listener(), Listener()]
        with World(on_stand(velocity=source)) as world:
            run_in_process(world, loops, 20, samples.append)  # type: ignore[arg-type]
        if source == "none":
            assert {sample.velocities for sample in samples} == {None}
            assert set(loops[0].heard) == {None}
        else:
            heard = zip(*(loop.heard for loop in loops), strict=True)
            assert list(heard) == [sample.velocities for sample in samples]
            assert samples[-1].velocities[0] > 0.1
