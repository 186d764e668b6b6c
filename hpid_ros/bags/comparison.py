"""The indices of any number of bags."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hpid_ros.analysis import Comparison, RunSeries, run_indices
from hpid_ros.bags.reader import read_run
from hpid_ros.errors import BagError


def read_runs(
    paths: Sequence[Path], labels: Sequence[str] = (), joints: Sequence[str] | None = None
) -> tuple[RunSeries, ...]:
    """Read the runs of several bags.

    Args:
        paths: The bags.
        labels: One for each bag; their folders' names if empty, with as much of the path as
            tells them apart.
        joints: Only these joints; all that are controlled if None.

    Raises:
        BagError: A bag cannot be read, or there is not one label for each bag.
    """
    if labels and len(labels) != len(paths):
        raise BagError(f"there must be one label for each of {len(paths)} bags, not {len(labels)}")
    names = labels or _distinct_names(paths)
    return tuple(
        read_run(path, label, joints=joints) for path, label in zip(paths, names, strict=True)
    )


def compare_bags(
    paths: Sequence[Path], labels: Sequence[str] = (), joints: Sequence[str] | None = None
) -> Comparison:
    """Return the indices of several bags, the first one the baseline.

    Args:
        paths: The bags.
        labels: As for :func:`read_runs`.
        joints: As for :func:`read_runs`.

    Raises:
        BagError: As for :func:`read_runs`.
        SeriesError: The bags' joints differ, or two labels are equal.
    """
    return Comparison(tuple(run_indices(run) for run in read_runs(paths, labels, joints)))


def _distinct_names(paths: Sequence[Path]) -> list[str]:
    parts = [path.absolute().with_suffix("").parts for path in paths]
    longest = max(len(part) for part in parts)
    for depth in range(1, longest + 1):
        names = ["/".join(part[-depth:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    return [f"{part[-1]} ({number})" for number, part in enumerate(parts, 1)]
