"""A joint integrated here, of which the package's simulators know nothing: rigid or two masses."""

from dataclasses import dataclass
from math import copysign, sin

import numpy as np

from hpid_bench.tuning.recorded_pid import recorded_motion
from hpid_ros.control import JointLoop, LoopSettings
from hpid_ros.messages.series import JointSeries

PERIOD = 1e-3  # [s]
_STEPS = 5


@dataclass(frozen=True)
class Joint:
    """Motor and load about a horizontal axis, SI units."""

    motor: float = 0.1  # inertia
    load: float = 0.2  # inertia
    weight: float = 4.0  # torque of gravity at a quarter of a turn
    viscous: float = 0.3
    coulomb: float = 0.3
    stiffness: float = 0.0  # between them; 0 is rigid
    delay: int = 1  # control periods
    noise: float = 2e-5
    count: float = 0.0  # step of the encoder

    @property
    def inertia(self):
        return self.motor + self.load

    def settings(self, **more):
        """Return a PID with a triple pole at 10 rad/s."""
        gains = {"p": 300.0 * self.inertia, "i": 1000.0 * self.inertia, "d": 30.0 * self.inertia}
        named = {f"gains.{name}": value for name, value in gains.items()}
        limits = {"u_clamp_max": 60.0, "u_clamp_min": -60.0}
        return LoopSettings.from_parameters(
            {"joint": "a", "law": "pid", **limits, **named, **more}
        )


def sines(duration, seed=1, amplitude=0.2):
    """Return a reference of eight sines that fades in."""
    draw, time = np.random.default_rng(seed), np.arange(0.0, duration, PERIOD)
    frequencies = draw.uniform(0.2, 3.0, 8)[:, None]
    phases = draw.uniform(0.0, 2.0 * np.pi, 8)[:, None]
    waves = np.sin(2.0 * np.pi * frequencies * time + phases) / (1.0 + frequencies)
    return amplitude * waves.sum(0) * np.minimum(1.0, time)


def moved(joint, settings, reference, *, hold=0.0, late=0, report=None, seed=1):
    """Return what a loop does with a joint, and the velocities that its driver reports.

    The joint is held for some seconds before it is recorded; efforts are stamped some periods
    late; ``report`` makes a velocity of each measured position, if the driver reports any.
    """
    draw, loop = np.random.default_rng(seed), JointLoop(settings)
    before, start = round(hold / PERIOD), float(reference[0])
    motor, load, speeds = start, start, [0.0, 0.0]
    under_way, rows = [0.0] * joint.delay, []
    stamps = np.arange(before + len(reference), dtype=np.int64) * round(PERIOD * 1e9)
    for k, stamp in enumerate(stamps.tolist()):
        if k == before:
            times = stamps[before:] - stamps[before]
            loop.follow(recorded_motion("a", times, reference))
        position = motor + joint.noise * draw.standard_normal()
        if joint.count:
            position = round(position / joint.count) * joint.count
        velocity = None if report is None else report(position)
        effort = loop.step(stamp, position, velocity)
        if k >= before:
            rows.append((position, effort, velocity))
        under_way.append(effort)
        acting = under_way.pop(0)
        for _ in range(_STEPS):
            motor, load = _step(joint, acting, motor, load, speeds, PERIOD / _STEPS)
    positions, efforts = (
        np.array(each, dtype=float) for each in list(zip(*rows, strict=True))[:2]
    )
    own = stamps[before:]
    series = JointSeries("a", own, positions, reference, own + late * round(PERIOD * 1e9), efforts)
    velocities = (
        {} if report is None else {s: row[2] for s, row in zip(own.tolist(), rows, strict=True)}
    )
    return series, velocities


def _step(joint, effort, motor, load, speeds, dt):
    """Move on; speeds of motor and load are changed in place."""
    pull = joint.weight * sin(load)
    if joint.stiffness:
        damping = 0.02 * (joint.stiffness * joint.load) ** 0.5
        passed = joint.stiffness * (motor - load) + damping * (speeds[0] - speeds[1])
        speeds[1] += dt * (passed - pull) / joint.load
        own, acting = joint.motor, effort - passed
    else:
        own, acting = joint.inertia, effort - pull
    free = speeds[0] + dt * (acting - joint.viscous * speeds[0]) / own
    speeds[0] = copysign(max(abs(free) - dt * joint.coulomb / own, 0.0), free)
    if not joint.stiffness:
        speeds[1] = speeds[0]
    motor += dt * speeds[0]
    return motor, load + dt * speeds[1] if joint.stiffness else motor
