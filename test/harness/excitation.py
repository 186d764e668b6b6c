"""A joint under control, excited: on its exact sampled model, without an engine."""

import numpy as np

from hpid_ros.control import JointLoop
from hpid_ros.messages.series import complete_run
from hpid_ros.motion import Column, Knot


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

    Args:
        settings: Of the loop.
        joint: The :class:`SampledJoint`.
        reference: At the samples, in [rad].
        noise: Standard deviation of what is added to the measured position, in [rad].
        disturbance: Of what is added to the effort, in [N m].
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
