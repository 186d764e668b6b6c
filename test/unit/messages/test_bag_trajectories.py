"""What a trajectory in a bag makes of the reference: it takes over as in the joint's loop."""

from __future__ import annotations

from pathlib import Path

from harness.bags import (
    JOINT_TRAJECTORY,
    MS,
    TYPES,
    Log,
    S,
    bits,
    command,
    ramp,
    read_one,
    state,
    trajectory,
)

from hpid_ros.messages.run import read_run
from hpid_ros.messages.selection import BagSelection
from hpid_ros.motion import JointTrajectory


def seconds(log: Log, first: int, last: int) -> list[tuple[str, int, bytes]]:
    states = [state(k * S, a=0.25) for k in range(first, last)]
    return sorted([*log, *states, command(first * S, a=0.0)], key=lambda message: message[1])


def references(path: Path, *log: tuple[str, int, bytes], last: int = 7) -> list[float]:
    series, _ = read_one(path, seconds(log, 1, last))
    return series.reference.tolist()


def test_without_a_trajectory_there_is_no_reference_unless_the_first_position_is_asked_for(
    tmp_path,
):
    assert references(tmp_path / "bag", last=4) == []
    assert (
        read_run(tmp_path / "bag", "run", selection=BagSelection(reference="hold"))
        .joints[0]
        .reference.tolist()
        == [0.25] * 3
    )


def test_a_trajectory_without_a_stamp_starts_with_the_state_that_follows_it(tmp_path):
    reference = references(
        tmp_path / "bag", trajectory(2 * S + 1, ramp("a", t0=1.0, t2=5.0)), last=8
    )
    assert reference == [0.25, 0.25, 1.0, 3.0, 5.0, 5.0, 5.0]


def test_a_trajectory_whose_stamp_has_passed_holds_from_its_stamp_on(tmp_path):
    late = ramp("a", stamp_ns=2 * S, t0=1.0, t2=5.0)
    reference = references(tmp_path / "bag", trajectory(4 * S + 1, late))
    assert reference == [0.25, 1.0, 3.0, 5.0, 5.0, 5.0]


def test_a_trajectory_that_starts_later_is_run_up_to_as_the_joint_loop_does(tmp_path):
    ahead = ramp("a", stamp_ns=5 * S, t0=2.25, t1=4.0)
    reference = references(tmp_path / "bag", trajectory(2 * S + 1, ahead))
    assert reference == [0.25, 0.25, 0.25, 1.25, 2.25, 4.0]


def test_a_new_trajectory_supersedes_from_where_the_reference_stood_before(tmp_path):
    first = trajectory(0, ramp("a", t0=0.0, t4=4.0))
    second = trajectory(2 * S + 1, ramp("a", t1=10.0))
    foreign = trajectory(4 * S + 1, ramp("b", t0=77.0))
    assert references(tmp_path / "bag", first, second, foreign) == [
        0.0,
        1.0,
        1.0,
        10.0,
        10.0,
        10.0,
    ]


def test_of_two_trajectories_before_the_same_state_only_the_last_counts(tmp_path):
    first = trajectory(2 * S + 1, ramp("a", t0=9.0, t1=8.0))
    second = trajectory(2 * S + 2, ramp("a", t1=1.0))
    assert references(tmp_path / "bag", first, second, last=6) == [0.25, 0.25, 0.25, 1.0, 1.0]


def test_a_trajectory_after_the_last_state_never_begins(tmp_path):
    assert references(tmp_path / "bag", trajectory(9 * S, ramp("a", t0=9.0)), last=3) == [0.25] * 2


def test_a_trajectory_that_controllers_refuse_changes_nothing(tmp_path):
    good = trajectory(0, ramp("a", t0=1.0))
    message = TYPES.deserialize_cdr(good[2], JOINT_TRAJECTORY)
    message.points.append(message.points[0])
    refused = bytes(TYPES.serialize_cdr(message, JOINT_TRAJECTORY))
    reference = references(tmp_path / "bag", good, ("joint_trajectory", 2 * S, refused), last=4)
    assert reference == [1.0, 1.0, 1.0]
    quality = read_run(tmp_path / "bag", "run").quality
    assert any("a trajectory is left out" in line for line in quality.lines)


def test_the_reference_is_the_one_that_the_joint_loop_follows(tmp_path):
    from hpid_ros.control import Gains, JointLoop
    from hpid_ros.control.settings import LoopSettings

    def cubic(**at_seconds: float) -> JointTrajectory:
        points = ramp("a", **at_seconds).points
        moving = [point._replace(velocities=(0.3,)) for point in points]
        return JointTrajectory(("a",), tuple(moving))

    loop = JointLoop(LoopSettings(joint="a", gains=Gains(10.0, 1.0, 3.0)))
    told = {0: cubic(t0=0.1, t1=0.7), 700: cubic(t1=-0.2, t2=0.3), 1500: cubic(t0=0.0)}
    log, followed = [], []
    for k in range(2000):
        stamp_ns, position = 5 * S + k * MS, 0.05 + 1e-4 * k
        if k in told:
            loop.follow(told[k].column("a"))
            log.append(trajectory(stamp_ns, told[k]))
        log.append(state(stamp_ns, a=position))
        log.append(command(stamp_ns, a=loop.step(stamp_ns, position, 0.1)))
        followed.append(loop.reference[0])
    series, losses = read_one(tmp_path / "bag", log)
    assert bits(series.reference) == bits(followed)
    assert not losses
