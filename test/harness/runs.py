"""Runs and their numbers, made up."""

import numpy as np

from hpid_ros.messages.series import JointSeries, RunSeries
from hpid_ros.metrics.results import RunIndices


def indices(ivc, iavc, itae):
    return {"ivc": float(ivc), "iavc": float(iavc), "itae": float(itae)}


def run(label, rows, norms=(1.0, 1.0), names=None):
    names = names or [f"joint{k + 1}" for k in range(len(rows))]
    joints = {name: indices(*row) for name, row in zip(names, rows, strict=True)}
    totals = indices(*(sum(column) for column in zip(*rows, strict=True)))
    norms = dict(zip(("effort_l2", "error_l2"), map(float, norms), strict=True))
    return RunIndices(label, joints, totals | norms)


def response(label, damping, names=("shoulder", "elbow"), losses=None, samples=301, **others):
    """Return a run of nine seconds: joints that swing to where they are told to be."""
    t = np.linspace(0.0, 9.0, samples)
    stamps = np.round(t * 1e9).astype(np.int64)
    joints = []
    for k, name in enumerate(names):
        reference = np.full(t.size, 1.0 + k)
        position = reference * (1.0 - np.exp(-damping * t) * np.cos(3 * t))
        effort = 5 * (reference - position)
        joints.append(JointSeries(name, stamps, position, reference, stamps, effort))
    return RunSeries(label, tuple(joints), losses or {}, **others)


def recording(
    label="PID", scale=1.0, duration=2.0, shift=0.0, names=("a", "b"), period=1e-3, **options
):
    """A joint that steps and one that follows a sine."""
    t = np.arange(round(duration / period) + 1) * period
    stamps = np.round(t * 1e9).astype(np.int64)
    step, sine = np.ones(t.size), np.sin(t + shift)
    pairs = ((step * (1 - scale * np.exp(-t / 0.1)), step), (sine - 0.01 * scale, sine))
    joints = (
        JointSeries(name, stamps, y, r, stamps, 5.0 * (r - y))
        for name, (y, r) in zip(names, pairs, strict=True)
    )
    return RunSeries(label, tuple(joints), **options)
