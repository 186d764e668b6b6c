"""Paths of the base: what the wheels' trajectories make of the poses that were asked for."""

import functools
import math

import numpy as np
import pytest
from harness.examples import examples
from hypothesis import example, given, reject
from hypothesis import strategies as st

from hpid_ros.base.errors import TrajectoryError
from hpid_ros.motion import BasePath
from hpid_ros.motion.references import reference_from
from hpid_ros.robot.differential_drive import DifferentialDrive, integrated

DRIVE = DifferentialDrive("left", "right", 0.075, 0.5)
WHEELS = (*DRIVE.joints, DRIVE.radius, DRIVE.separation)
PERIOD_NS = 1_000_000
TIMES = [0.0, 3.0, 6.0, 8.0, 9.0, 12.0]
POSES = [
    (0.0, 0.0, 0.0),
    (1.0, 0.4, 0.8),
    (1.5, 1.4, 1.6),
    (1.5, 1.4, -0.5),
    (1.5, 1.4, -0.5),
    (0.9, 1.6, -0.2),
]
DIRECTIONS = ["forward", "forward", "forward", "forward", "backward"]


def base_path(times, poses, left, right, radius, separation, velocity_limit=math.inf, **options):
    path = BasePath(times, poses, **options)
    return path.wheels(left, right, radius, separation, velocity_limit=velocity_limit)


def sampled(trajectory, end, period_ns=PERIOD_NS):
    """Return stamps in [s] and samples of both wheels, (N, 2, 3)."""
    columns = [trajectory.column(wheel).start(0, 0.0) for wheel in DRIVE.joints]
    stamps = range(0, round(end * 1e9) + 1, period_ns)
    samples = [[tuple(column.sample(stamp)) for column in columns] for stamp in stamps]
    return np.array(stamps) * 1e-9, np.array(samples)


@functools.cache
def followed(passes):
    """Return stamps and samples of the wheels along the path above."""
    trajectory = base_path(TIMES, POSES, *WHEELS, directions=DIRECTIONS, passes=passes)
    return sampled(trajectory, TIMES[-1])


def dead_reckoning(samples, start):
    """Return the poses of exact odometry along samples of both wheels, from a pose on."""
    x, y, heading = start
    at = integrated(DRIVE, samples[:, 0, 0], samples[:, 1, 0])
    c, s = math.cos(heading), math.sin(heading)
    turned = np.column_stack([c * at[:, 0] - s * at[:, 1], s * at[:, 0] + c * at[:, 1], at[:, 2]])
    return turned + np.array([x, y, heading])


def gap(one, other):
    """Return distance in [m] and angle in [rad] between poses."""
    away = np.asarray(one, dtype=float) - np.asarray(other, dtype=float)
    turned = np.remainder(away[..., 2] + np.pi, 2.0 * np.pi) - np.pi
    return np.hypot(away[..., 0], away[..., 1]).max(), np.abs(turned).max()


@pytest.mark.parametrize("passes", [False, True])
def test_exact_odometry_of_the_wheels_meets_every_pose(passes):
    times, samples = followed(passes)
    poses = dead_reckoning(samples, POSES[0])
    for time, pose in zip(TIMES, POSES, strict=True):
        away, turned = gap(poses[np.argmin(np.abs(times - time))], pose)
        assert away < 1e-6
        assert turned < 1e-6


@st.composite
def drives(draw):
    """Return times and poses of a path of a few forward and backward legs."""
    poses = [(draw(st.floats(-5, 5)), draw(st.floats(-5, 5)), draw(st.floats(-3, 3)))]
    times, directions = [draw(st.floats(0.0, 0.01))], []
    for _ in range(draw(st.integers(1, 3))):
        x, y, heading = poses[-1]
        backward = draw(st.booleans())
        bearing = heading + draw(st.floats(-0.6, 0.6)) + (math.pi if backward else 0.0)
        length = draw(st.floats(0.2, 2.0))
        poses.append(
            (
                x + length * math.cos(bearing),
                y + length * math.sin(bearing),
                heading + draw(st.floats(-1.0, 1.0)),
            )
        )
        times.append(times[-1] + draw(st.floats(2.0, 5.0)))
        directions.append("backward" if backward else "forward")
    return times, poses, directions, draw(st.booleans())


@examples(0.25)
@example(([0.0, 2.0], [(0.0, 0.0, 0.0), (0.2194, 0.1199, -1.0)], ["forward"], False))
@given(drives())
def test_the_error_of_any_path_is_bounded(path):
    times, poses, directions, passes = path
    try:
        plan = BasePath(times, poses, directions=directions, passes=passes)
    except TrajectoryError as error:  # a short leg with a large turn
        if "bends with" not in str(error):
            raise
        reject()
    at, samples = sampled(plan.wheels(*WHEELS), times[-1] + 0.01, 500_000)
    away, turned = gap(dead_reckoning(samples, poses[0]), plan.sample(at))
    assert away < 1e-6
    assert turned < 1e-6
    away, turned = gap(plan.sample(plan.times), poses)
    assert away < 1e-12
    assert turned < 1e-9


def test_the_base_rests_at_every_pose_unless_it_passes():
    (_, still), (_, moving) = followed(False), followed(True)
    for time in TIMES:
        assert np.abs(still[round(time * 1e3), :, 1:]).max() < 1e-9
    speed = moving[3000, :, 1] * DRIVE.radius
    assert speed == pytest.approx(2.0 / (3.0 / math.hypot(1, 0.4) + 3.0 / math.hypot(0.5, 1)))
    for time in (TIMES[0], *TIMES[2:]):  # the next leg turns, waits, or goes the other way
        assert np.abs(moving[round(time * 1e3), :, 1:]).max() < 1e-9


@pytest.mark.parametrize("passes", [False, True])
def test_rates_and_accelerations_do_not_jump(passes):
    times, samples = followed(passes)
    # Integrals of what is said to be the next derivative: they agree if nothing jumps.
    for derivative in (0, 1):
        steps = np.diff(samples[:, :, derivative], axis=0)
        means = 0.5 * (samples[1:, :, derivative + 1] + samples[:-1, :, derivative + 1])
        assert np.abs(steps - means * np.diff(times)[:, None]).max() < 2e-7
    assert np.abs(np.diff(samples[:, :, 2], axis=0)).max() < 0.2


@pytest.mark.parametrize("angle", [0.0, 1.0, 2.0 * math.pi, -7.0])
def test_a_turn_in_place_goes_as_far_as_it_is_written_and_by_0_it_waits(angle):
    _, samples = sampled(base_path([0, 3], [(1, 2, 0.5), (1, 2, 0.5 + angle)], *WHEELS), 3.0)
    assert samples[:, 0, 0] == pytest.approx(-samples[:, 1, 0], abs=1e-12)
    assert samples[-1, 1, 0] == pytest.approx(angle * 0.25 / 0.075)


def test_too_fast_is_refused_with_the_leg_and_its_wheel():
    limit = np.abs(followed(False)[1][:, :, 1]).max()
    base_path(TIMES, POSES, *WHEELS, directions=DIRECTIONS, velocity_limit=limit + 1e-3)
    with pytest.raises(TrajectoryError, match=r"leg \d of the path, .* s to .* s, turns '.*' at"):
        base_path(TIMES, POSES, *WHEELS, directions=DIRECTIONS, velocity_limit=limit - 1e-3)
    # Twice the time is half the rate.
    slow = [2.0 * time for time in TIMES]
    base_path(slow, POSES, *WHEELS, directions=DIRECTIONS, velocity_limit=0.5 * limit + 1e-3)


def test_the_curvature_is_bounded():
    poses = [(0, 0, 0), (1, 1, 1.5)]
    plan = BasePath([0, 3], poses, curvature_limit=2.0)
    at = plan.sample(np.linspace(0.2, 2.8, 5001))
    curvature = np.diff(at[:, 2]) / np.hypot(*np.diff(at[:, :2], axis=0).T)
    sharpest = np.abs(curvature).max()
    assert 1.0 < sharpest < 2.0
    with pytest.raises(TrajectoryError, match=f"bends with {sharpest:.3g} 1/m, more than 1 1/m"):
        BasePath([0, 3], poses, curvature_limit=1.0)


def test_what_would_need_a_cusp_is_refused():
    with pytest.raises(TrajectoryError, match=r"leg 0 .* turn in place first"):
        BasePath([0, 3], [(0, 0, 0), (-1, 0.3, 0)])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"times": [0, 1]}, "a time for each, not 3 poses and 2 times"),
        ({"times": [0], "poses": [(0, 0, 0)]}, "at least two poses"),
        ({"times": [0, 1, 1]}, "must increase from 0 or later by at least 1 ms"),
        ({"times": [-1, 1, 2]}, "must increase from 0"),
        ({"times": [0, math.nan, 2]}, "must be finite"),
        ({"poses": [(0, 0, 0), (1, 0), (2, 0, 0)]}, "pose 1 of a path must be x"),
        ({"poses": [(0, 0, 0), (1, math.inf, 0), (2, 0, 0)]}, "pose 1 of a path must be x"),
        ({"directions": ["forward", "up"]}, "must have 2 directions of forward or backward"),
        ({"radius": 0.0}, "wheel_radius must be positive and finite, not 0.0 m"),
        ({"separation": math.nan}, "wheel_separation must be positive"),
        ({"right": "left"}, "must name each of its joints once"),
    ],
)
def test_bad_paths_are_refused_in_one_line(changes, message):
    arguments = {
        "times": [0.0, 1.0, 2.0],
        "poses": [(0, 0, 0), (1, 0, 0), (2, 0, 0)],
        **dict(zip(("left", "right", "radius", "separation"), WHEELS, strict=True)),
    }
    base_path(**arguments)
    with pytest.raises(TrajectoryError, match=message) as refusal:
        base_path(**(arguments | changes))
    assert "\n" not in str(refusal.value)


SECTION = {
    "kind": "base_path",
    "base": {
        "left_wheel": "left",
        "right_wheel": "right",
        "wheel_radius": 0.075,
        "wheel_separation": 0.5,
    },
    "times": TIMES,
    "poses": [list(pose) for pose in POSES],
    "directions": DIRECTIONS,
}


def test_a_section_is_the_path_that_it_says():
    assert reference_from(SECTION) == base_path(TIMES, POSES, *WHEELS, directions=DIRECTIONS)
    passing = reference_from(SECTION | {"passes": True, "velocity_limit": 15.0})
    assert passing == base_path(TIMES, POSES, *WHEELS, directions=DIRECTIONS, passes=True)
    one = {"times": [0.0, 3.0], "poses": [[0, 0, 0], [-1, 0, 0]], "directions": "backward"}
    assert reference_from(SECTION | one).points[-1].positions[0] == pytest.approx(-1 / 0.075)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"base": SECTION["base"] | {"wheel_radius": 0}}, "wheel_radius must be above 0"),
        (
            {"poses": [[0, 0, "east"]] * 6},
            r"reference.poses\[0\]\[2\] must be a number, not 'east'",
        ),
        ({"velocity_limit": 1.0}, "reference: leg 0 of the path"),
        ({"curvature_limit": 0.1}, "reference: leg 0 of the path"),
    ],
)
def test_bad_sections_are_refused_with_their_place(changes, message):
    with pytest.raises(TrajectoryError, match=message):
        reference_from(SECTION | changes)
