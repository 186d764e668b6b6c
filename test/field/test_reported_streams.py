"""What people reported of streams of trajectories and of their replacement, on the pure loop."""

from dataclasses import dataclass

import numpy as np
import pytest
from harness.loops import pure_loop

from hpid_ros.motion import Column, Knot

MS = 1_000_000
SPEED = 0.5  # [rad/s] that is asked for
SETTLED = 700  # samples; by then the glide of takeover_time = 0.5 s has ended
GAINS = {"law": "pid", "gains__p": 100.0, "gains__d": 20.0, "velocity_source": "measured"}


@dataclass
class Sender:
    """What a node sends again and again of a motion of constant speed."""

    every: int  # [ms]
    ahead: int  # [ms] of its last point
    begins_now: bool = False  # a point at time 0, too
    has_stamp: bool = False  # that of the newest state; else 0, for now
    late: int = 0  # [ms] between what it has seen and what it sends

    def column(self, now_ms):
        """Return a message's column."""
        times = (0, self.ahead) if self.begins_now else (self.ahead,)
        knots = tuple(
            Knot(each * MS, SPEED * (now_ms - self.late + each) * 1e-3) for each in times
        )
        return Column("elbow", knots, now_ms * MS if self.has_stamp else 0)


def followed(send, samples=2000):
    """Return time, reference and its velocity of a joint that is where its reference is."""
    loop, rows = pure_loop(**GAINS), []
    loop.step(0, 0.0, 0.0)
    for now_ms in range(1, samples):
        send(loop, now_ms)
        loop.step(now_ms * MS, *loop.following.reference)
        rows.append((now_ms * 1e-3, *loop.following.reference))
    return np.array(rows).T


SENDERS = {
    "one point 0.15 s ahead, 50 Hz": Sender(20, 150),
    "one point 0.15 s ahead, 100 Hz": Sender(10, 150),
    "a joystick, 30 Hz": Sender(33, 100),
    "two points, 50 Hz": Sender(20, 20, begins_now=True, has_stamp=True),
    "two points that are late": Sender(20, 20, begins_now=True, has_stamp=True, late=30),
    "what was seen long ago": Sender(50, 100, begins_now=True, late=100),
}


@pytest.mark.parametrize("name", SENDERS)
def test_a_stream_moves_the_joint_as_it_was_asked_to(name):
    """It neither shakes nor stands still until the stream ends, nor runs away."""
    sender = SENDERS[name]

    def send(loop, now_ms):
        if now_ms % sender.every == 0:
            loop.receive(sender.column(now_ms))

    times, places, velocities = followed(send)
    lag = SPEED * (times - sender.late * 1e-3) - places
    # The first message of those that are late begins where the joint has never been: it is a step.
    assert np.diff(places)[sender.every :].min() > -1e-9
    assert np.abs(lag[SETTLED:]).max() < SPEED * (sender.every + 1) * 1e-3
    assert velocities.max() < 4.0 * SPEED
    assert velocities[SETTLED:] == pytest.approx(np.full(len(times) - SETTLED, SPEED), rel=0.2)


@pytest.mark.parametrize("ahead", [2, 20, 600])
def test_what_starts_later_leaves_what_runs_now_as_it_is_until_then(ahead):
    """A goal that starts in some seconds is no reason to leave the present motion."""
    now = Column("elbow", (Knot(1000 * MS, 1.0, 0.0),))
    later = Column("elbow", (Knot(1000 * MS, -1.0, 0.0),), (ahead + 1) * 1000 * MS)

    def send(loop, now_ms, *, also_later):
        if now_ms == 2:
            loop.receive(now)
        if also_later and now_ms == 500:
            loop.receive(later)

    alone, both = (
        followed(lambda *given, also=also: send(*given, also_later=also), 1900)
        for also in (False, True)
    )
    assert (both == alone).all()
    assert alone[1][-1] == 1.0


@pytest.mark.parametrize("at_ms", [300, 500, 800])
def test_a_trajectory_that_is_sent_again_on_the_way_does_not_stop_the_joint(at_ms):
    """What is left of it, as a planner sends it, which has planned on."""

    def place(at):  # [s]
        return 0.5 * SPEED * at**2 if at < 1.0 else SPEED * (at - 0.5)

    def rest(since_ms):
        times = [0.1 * k for k in range(1, 18)]
        knots = tuple(
            Knot(round(each * 1e3) * MS, place(1e-3 * since_ms + each), SPEED * min(1.0, s))
            for each in times
            for s in (1e-3 * since_ms + each,)
        )
        return Column("elbow", knots)

    def send(loop, now_ms):
        if now_ms in (1, at_ms):
            loop.receive(rest(now_ms))

    times, places, velocities = followed(send, 1500)
    assert places == pytest.approx([place(each) for each in times], abs=5e-3)
    assert np.abs(np.diff(velocities)).max() < 5e-3
