"""Streams of trajectories as tools send them: ``python -m benchmarks.streams [--minutes N]``.

Each is of one motion, 0.6 rad at 0.15 Hz and 0.15 rad at 0.4 Hz; the loop takes states at 1 kHz,
with ``takeover_time`` 0.5 s. Printed are, from 1 s on, the largest distance of the reference from
the motion, the largest difference of their velocities, the largest step of the reference between
two states, and the share of time without a message that covers it. With ``--nodes`` all streams
are sent at once, in real time, to a controller each, with states at 200 Hz, and what is measured
is what the controllers report as their references; their lateness is then the machine's, too.
Exit codes: 0 measured, 1 controllers that do not come up, 2 unusable arguments, 130 interrupted.
"""

from __future__ import annotations

import argparse
import math
import random
import sys
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from benchmarks.nodes.streamer import on_nodes
from hpid_ros.base.errors import RunError
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.control.following import Following
from hpid_ros.motion.joint_trajectory import Column, Knot

PERIOD, TAKEOVER, SETTLED = 0.001, 0.5, 1.0  # [s]
_ORIGIN = 10.0  # [s] the clock's time at the stream's beginning
_WAVES = ((0.6, 2.0 * math.pi * 0.15), (0.15, 2.0 * math.pi * 0.4))
_FAILED, _BAD_INPUT, _INTERRUPTED = 1, 2, 130


class Stream(NamedTuple):
    """How a motion is streamed; times in [s]."""

    title: str
    period: float  # between two messages
    first: float  # of the first point after the message is made
    spacing: float  # of the points
    points: int
    has_velocities: bool
    late: float = 0.004  # of each message
    tenth: float = 0.0  # each tenth so much later
    is_stamped: bool = True  # else its times count from the state that takes it


STREAMS = (
    Stream("MoveIt Servo, Jazzy: 34 ms, window -0.1 to 0.1 s", 0.034, -0.1, 0.034, 6, True),
    Stream("... each tenth 40 ms late", 0.034, -0.1, 0.034, 6, True, tenth=0.04),
    Stream("... at 100 Hz", 0.01, -0.1, 0.01, 20, True),
    Stream(
        "MoveIt Servo, Humble: one point, 34 ms ahead",
        0.034,
        0.034,
        1.0,
        1,
        True,
        is_stamped=False,
    ),
    Stream("policy, 20 Hz, 16 points of 50 ms, positions", 0.05, 0.0, 0.05, 16, False),
    Stream("... each tenth 40 ms late", 0.05, 0.0, 0.05, 16, False, tenth=0.04),
    Stream("policy, 1 Hz, 50 points of 40 ms, 100 ms late", 1.0, 0.0, 0.04, 50, False, late=0.1),
    Stream("joystick, 50 Hz, now and 20 ms ahead", 0.02, 0.0, 0.02, 2, True),
    Stream("joystick, 50 Hz, now and 60 ms ahead", 0.02, 0.0, 0.06, 2, True),
)


class Deviation:
    """What became of a stream."""

    def __init__(self) -> None:
        self.distance = 0.0  # [rad] of the reference from the motion
        self.rate = 0.0  # [rad/s] of their velocities
        self.step = 0.0  # [rad] of the reference between two states
        self._states = self._bare = 0
        self._before: float | None = None

    @property
    def uncovered(self) -> float:
        """Share of the time."""
        return self._bare / max(self._states, 1)

    def take(self, time: float, position: float, velocity: float, covered: float) -> None:
        """Take a reference at a time, of what covers the motion until some time; in [s]."""
        if time > SETTLED:
            self._states += 1
            self._bare += covered < time
            self.distance = max(self.distance, abs(position - motion(time)))
            self.rate = max(self.rate, abs(velocity - motion(time, 1)))
            if self._before is not None:
                self.step = max(self.step, abs(position - self._before))
        self._before = position


def motion(time: float, order: int = 0) -> float:
    """Return the motion's position [rad] or velocity [rad/s] at a time in [s]."""
    phase = order * math.pi / 2.0
    return sum(a * w**order * math.sin(w * time + phase) for a, w in _WAVES)


def messages(stream: Stream, seconds: float) -> Iterator[tuple[float, Column, float]]:
    """Yield when messages come, in [s], what they are, and their end."""
    draw = random.Random(1)
    newest = 0.0
    for k in range(int(seconds / stream.period)):
        made = k * stream.period
        late = stream.late * draw.uniform(0.5, 1.0) + (stream.tenth if k % 10 == 9 else 0.0)
        newest = max(newest, made + late)
        times = [stream.first + j * stream.spacing for j in range(stream.points)]
        begin = times[0] if stream.is_stamped else 0.0
        knots = tuple(
            Knot(
                round((at - begin) * NANOSECONDS),
                motion(made + at),
                motion(made + at, 1) if stream.has_velocities else None,
            )
            for at in times
        )
        stamp_ns = round((_ORIGIN + made + begin) * NANOSECONDS) if stream.is_stamped else 0
        yield newest, Column("joint", knots, stamp_ns), made + times[-1]


def measured(stream: Stream, seconds: float) -> Deviation:
    """Return how far a stream's reference is from its motion."""
    following = Following()
    following.stand(motion(0.0))
    coming = messages(stream, seconds)
    newest = next(coming, None)
    covered, found = 0.0, Deviation()
    for k in range(int(seconds / PERIOD)):
        time = k * PERIOD
        while newest is not None and newest[0] <= time:
            following.follow(newest[1])
            covered, newest = newest[2], next(coming, None)
        stamp_ns = round((_ORIGIN + time) * NANOSECONDS)
        position, velocity, _ = following.sample(stamp_ns, TAKEOVER, None)
        found.take(time, position, velocity, covered)
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure all streams."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.streams", description=__doc__)
    parser.add_argument("--minutes", type=float, default=1.0, help="of each stream")
    parser.add_argument("--nodes", action="store_true", help="on real nodes, in real time")
    options = parser.parse_args(arguments)
    if not 0.05 <= options.minutes <= 600.0:
        print(f"--minutes must be from 0.05 to 600, not {options.minutes:g}", file=sys.stderr)
        return _BAD_INPUT
    fastest = sum(a * w for a, w in _WAVES)
    print(
        f"{options.minutes:g} minutes each; the motion's velocity is at most {fastest:.2f} rad/s"
    )
    print(
        f"{'stream':50s}{'away [mrad]':>12s}{'rate [rad/s]':>13s}{'step [mrad]':>12s}{'bare':>7s}"
    )
    seconds = 60.0 * options.minutes
    try:
        if options.nodes:
            founds = [Deviation() for _ in STREAMS]
            streams = [messages(stream, seconds) for stream in STREAMS]
            on_nodes(streams, motion, founds, seconds, _ORIGIN)
            for stream, found in zip(STREAMS, founds, strict=True):
                _print(stream, found)
        else:
            for stream in STREAMS:
                _print(stream, measured(stream, seconds))
    except RunError as error:
        print(error, file=sys.stderr)
        return _FAILED
    except KeyboardInterrupt:
        return _INTERRUPTED
    return 0


def _print(stream: Stream, found: Deviation) -> None:
    print(
        f"{stream.title:50s}{1e3 * found.distance:12.2f}{found.rate:13.3f}"
        f"{1e3 * found.step:12.2f}{100.0 * found.uncovered:6.1f}%",
        flush=True,
    )


if __name__ == "__main__":
    sys.exit(main())
