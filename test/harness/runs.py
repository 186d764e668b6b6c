"""Numbers of runs, made up."""

from hpid_ros.metrics.results import RunIndices


def indices(ivc, iavc, itae):
    return {"ivc": float(ivc), "iavc": float(iavc), "itae": float(itae)}


def run(label, rows, norms=(1.0, 1.0), names=None):
    names = names or [f"joint{k + 1}" for k in range(len(rows))]
    joints = {name: indices(*row) for name, row in zip(names, rows, strict=True)}
    totals = indices(*(sum(column) for column in zip(*rows, strict=True)))
    norms = dict(zip(("effort_l2", "error_l2"), map(float, norms), strict=True))
    return RunIndices(label, joints, totals | norms)
