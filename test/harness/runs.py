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
