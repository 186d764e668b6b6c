"""Numbers of runs, made up."""

from hpid_ros.metrics.results import JointIndices, RunIndices


def run(label, rows, norms=(1.0, 1.0), names=None):
    names = names or [f"joint{k + 1}" for k in range(len(rows))]
    joints = {name: JointIndices(*map(float, row)) for name, row in zip(names, rows, strict=True)}
    totals = JointIndices(*(float(sum(column)) for column in zip(*rows, strict=True)))
    return RunIndices(label, joints, totals, *map(float, norms))
