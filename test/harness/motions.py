"""A joint's motion along a multisine: what it needs, and under control, without an engine."""

from dataclasses import dataclass

import numpy as np

from hpid_bench.tuning.identification.joint_record import JointRecord
from hpid_ros.control import JointLoop
from hpid_ros.messages.series import complete_run
from hpid_ros.motion import Column, Knot

FREQUENCIES = np.array([0.13, 0.37, 0.71, 1.19, 1.93])  # [Hz]


@dataclass(frozen=True)
class Plant:
    """What a joint is made of, SI units."""

    inertia: float = 0.5
    viscous: float = 0.8
    coulomb: float = 0.6
    offset: float = 0.3
    gravity_sin: float = 0.0
    gravity_cos: float = 0.0
    stribeck: float = 0.0
    stribeck_speed: float = 0.3
    delay: float = 0.003


def motion(time, seed=1, amplitude=0.25):
    """Return position, velocity and acceleration at any times."""
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, len(FREQUENCIES))
    rates = 2.0 * np.pi * FREQUENCIES[:, None]
    sizes = amplitude / (1.0 + FREQUENCIES)
    angles = rates * np.asarray(time) + phases[:, None]
    return (
        sizes @ np.sin(angles),
        sizes @ (rates * np.cos(angles)),
        -sizes @ (rates**2 * np.sin(angles)),
    )


def needed(plant, position, velocity, acceleration):
    """Return the effort that a motion needs."""
    creeping = plant.stribeck * np.exp(-((velocity / plant.stribeck_speed) ** 2))
    return (
        plant.inertia * acceleration
        + plant.viscous * velocity
        + (plant.coulomb + creeping) * np.sign(velocity)
        + plant.offset
        + plant.gravity_sin * np.sin(position)
        + plant.gravity_cos * np.cos(position)
    )


def record(
    plant,
    times=None,
    *,
    seed=1,
    noise=0.0,
    effort_noise=0.0,
    name="joint",
    amplitude=0.25,
    along=motion,
):
    """Return what is recorded: positions, and measured efforts that act after the delay."""
    times = np.arange(0.0, 12.0, 2e-3) if times is None else times
    chance = np.random.default_rng([seed, 7])
    position = along(times, seed, amplitude)[0] + noise * chance.standard_normal(len(times))
    effort = needed(plant, *along(times + plant.delay, seed, amplitude))
    effort = effort + effort_noise * chance.standard_normal(len(times))
    return JointRecord(name, times, position, times, effort, is_held=False)


def multisine(samples, amplitude, lines, period, seed=1):
    """Return a reference of neighbouring lines with random phases, faded in, in [rad]."""
    draw = np.random.default_rng(seed)
    turns = np.arange(samples) / samples
    phases = draw.uniform(0.0, 2.0 * np.pi, len(lines))
    waves = (np.cos(2.0 * np.pi * k * turns + at) for k, at in zip(lines, phases, strict=True))
    return amplitude * sum(waves) * np.minimum(1.0, np.arange(samples) * period / 0.5)


def reference_column(joint, reference, period):
    """Return samples of a reference as what a loop follows."""
    knots = (Knot(round(k * period * 1e9), float(x)) for k, x in enumerate(reference))
    return Column(joint, tuple(knots))


def excited_run(settings, joint, reference, noise=0.0, disturbance=0.0):
    """Return the run of a loop on a sampled joint whose delay is less than a period.

    Noise of the measured position [rad] and disturbance of the effort [N m]: standard deviations.
    """
    loop, held, draw = JointLoop(settings), joint.held, np.random.default_rng(2)
    loop.follow(reference_column(settings.joint, reference, joint.period))
    position = velocity = before = 0.0
    positions, efforts = [], []
    for k in range(len(reference)):
        measured = position + noise * draw.standard_normal()
        effort = loop.step(round(k * joint.period * 1e9), measured, None)
        positions.append(measured)
        efforts.append(effort)
        newer, older = effort + disturbance * draw.standard_normal(), before
        position += held.reach * velocity + held.newer[0] * newer + held.older[0] * older
        velocity = held.keep * velocity + held.newer[1] * newer + held.older[1] * older
        before = newer
    stamps = np.round(np.arange(len(reference)) * joint.period * 1e9).astype(np.int64)
    columns = (np.array(each)[:, None] for each in (positions, reference, efforts))
    return complete_run("excited", [settings.joint], stamps, columns)
