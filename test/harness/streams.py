"""Sequences of trajectories: of one smooth motion as tools stream it, and anything at all."""

import math
import random
from typing import NamedTuple

from hpid_ros.motion import Column, Knot

SECOND = 1_000_000_000
BEGIN = 10.0  # [s] the instant from which a stream counts its time


class Arrival(NamedTuple):
    """A message, and when it comes."""

    time: float  # [s] since the stream's beginning
    column: Column
    end: float  # [s] its last point


class SmoothMotion:
    """Two sines and a line: position and derivatives at any time."""

    def __init__(self, draw):
        self._waves = [
            (draw.uniform(0.1, 0.6), 2.0 * math.pi * draw.uniform(0.05, 0.5), draw.uniform(0, 6))
            for _ in range(2)
        ]
        self._slope = draw.uniform(-0.5, 0.5)

    def __call__(self, t, order=0):
        total = (self._slope * t, self._slope, 0.0)[order]
        for amplitude, rate, phase in self._waves:
            total += amplitude * rate**order * math.sin(rate * t + phase + order * math.pi / 2.0)
        return total


class Stream(NamedTuple):
    """How a motion is streamed."""

    period: float  # [s] between two messages
    points: int  # of a message
    spacing: float  # [s] between two points
    begin: float  # [s] of the first point after the message is sent
    derivatives: int  # given with the positions
    late: float  # [s] at most
    later: float  # [s] each tenth message once more
    has_losses: bool  # one is lost
    has_copies: bool  # one comes twice

    @property
    def window(self):
        """Time from a message's first point to its last one in [s]."""
        return (self.points - 1) * self.spacing

    @classmethod
    def by_chance(cls, draw):
        """Return one as tools send it; its windows may end before the next message comes."""
        period = 1.0 / 10.0 ** draw.uniform(math.log10(5.0), math.log10(500.0))
        return cls(
            period,
            draw.choice([2, 2, 3, 5, 10, 30]),
            draw.choice([period, period, draw.uniform(0.3, 2.0) * period]),
            draw.uniform(-0.3, 0.1),
            draw.choice([0, 1, 2]),
            draw.choice([0.0, 0.02, 0.1]),
            draw.choice([0.0, 0.0, 0.15]),
            draw.random() < 0.5,
            draw.random() < 0.5,
        )

    def arrivals(self, draw, motion, seconds):
        """Yield what comes, in the order of one publisher; each as late as it may be."""
        newest = 0.0
        for k in range(int(seconds / self.period)):
            sent = k * self.period
            late = draw.uniform(0.0, self.late) + (self.later if k % 10 == 9 else 0.0)
            newest = max(newest, sent + late)
            if self.has_losses and k == 17:
                continue
            first = sent + self.begin
            times = [j * self.spacing for j in range(self.points)]
            knots = tuple(
                Knot(
                    round(at * SECOND),
                    *(motion(first + at, order) for order in range(self.derivatives + 1)),
                )
                for at in times
            )
            column = Column("elbow", knots, round((BEGIN + first) * SECOND))
            for _ in range(1 + (self.has_copies and k == 23)):
                yield Arrival(newest, column, first + self.window)


def anything(draw, seconds, largest=1.0, speed=None):
    """Yield random trajectories: positions within bounds, any window, stamp and order."""
    span, rate = draw.choice([0.002, 0.02, 0.2, 1.0]), draw.choice([5.0, 50.0, 400.0])
    time = 0.0
    while time < seconds:
        time += draw.expovariate(rate)
        times = sorted(
            {draw.randint(0, int(span * SECOND)) for _ in range(draw.choice([1, 2, 5]))}
        )
        knots = tuple(
            Knot(
                at,
                draw.uniform(-largest, largest),
                None if speed is None else draw.uniform(-speed, speed),
            )
            for at in times
        )
        stamp = draw.choice([0, round((BEGIN + time + draw.uniform(-span, span)) * SECOND)])
        yield Arrival(time, Column("elbow", knots, stamp), math.inf)


def played(following, arrivals, period, seconds, takeover_time, limits=None):
    """Yield time, position and velocity of a reference at each state.

    As on the topic what ended more than a second ago is refused.
    """
    waiting = iter(arrivals)
    coming = next(waiting, None)
    for k in range(int(seconds / period)):
        time = k * period
        while coming is not None and coming.time <= time:
            if coming.end >= time - 1.0:
                following.follow(coming.column)
            coming = next(waiting, None)
        stamp_ns = round((BEGIN + time) * SECOND)
        position, velocity, _ = following.sample(stamp_ns, takeover_time, limits)
        yield time, position, velocity


def draws(seed):
    """Return a source of chance that a failing example can be made again with."""
    return random.Random(seed)
