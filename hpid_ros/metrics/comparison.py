"""The indices of any number of bags."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from hpid_ros.analysis import Comparison, run_indices
from hpid_ros.analysis.comparability import common_cuts
from hpid_ros.bags.columns.storage import Progress
from hpid_ros.bags.run.reader import read_run
from hpid_ros.bags.selection import BagSelection
from hpid_ros.base.errors import BagError
from hpid_ros.recordings.series import RunSeries


def read_runs(
    paths: Sequence[Path],
    labels: Sequence[str] = (),
    joints: Sequence[str] | None = None,
    *,
    selection: BagSelection | None = None,
    progress: Progress | None = None,
) -> tuple[RunSeries, ...]:
    """Read the runs of several bags.

    Args:
        paths: The bags.
        labels: One for each bag; their folders' names if empty, with as much of the path as
            tells them apart.
        joints: Only these joints; all that are controlled if None.
        selection: What is read of each bag.
        progress: Takes the share of all bags that has been read, in [0, 1].

    Raises:
        BagError: A bag cannot be read, or there is not one label for each bag.
    """
    selections = [selection or BagSelection()] * len(paths)
    return tuple(_each_run(paths, labels, joints, selections, progress))


def compare_bags(
    paths: Sequence[Path],
    labels: Sequence[str] = (),
    joints: Sequence[str] | None = None,
    *,
    selection: BagSelection | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Return the indices of several bags, the first one the baseline.

    Bags of unlike length are cut to the time that all of them have, unless the selection has a
    window.

    Args:
        paths: The bags.
        labels: As for :func:`read_runs`.
        joints: As for :func:`read_runs`.
        selection: As for :func:`read_runs`.
        progress: As for :func:`read_runs`.

    Raises:
        BagError: As for :func:`read_runs`.
        SeriesError: The bags' joints differ, or two labels are equal.
    """
    chosen = selection or BagSelection()
    runs = _each_run(paths, labels, joints, [chosen] * len(paths), progress)
    numbers = [run_indices(run) for run in runs]
    is_whole = chosen.start is None and chosen.end is None
    cuts = common_cuts(numbers) if is_whole else ()
    if cuts:
        parts = [replace(chosen, start=each.start, end=each.end) for each in cuts]
        again = _each_run(paths, labels, joints, parts, progress)
        numbers = [
            replace(run_indices(run), cut=each.text) for run, each in zip(again, cuts, strict=True)
        ]
    return Comparison(tuple(numbers))


def _each_run(
    paths: Sequence[Path],
    labels: Sequence[str],
    joints: Sequence[str] | None,
    selections: Sequence[BagSelection],
    progress: Progress | None,
) -> Iterator[RunSeries]:
    """Yield the runs one after the other, so that the caller need not hold them all."""
    if labels and len(labels) != len(paths):
        raise BagError(f"there must be one label for each of {len(paths)} bags, not {len(labels)}")
    names = labels or _distinct_names(paths)
    for number, (path, label) in enumerate(zip(paths, names, strict=True)):

        def told(share: float, number: int = number) -> None:
            if progress is not None:
                progress((number + share) / len(paths))

        yield read_run(path, label, joints=joints, selection=selections[number], progress=told)


def _distinct_names(paths: Sequence[Path]) -> list[str]:
    parts = [path.absolute().with_suffix("").parts for path in paths]
    longest = max(len(part) for part in parts)
    for depth in range(1, longest + 1):
        names = ["/".join(part[-depth:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    return [f"{part[-1]} ({number})" for number, part in enumerate(parts, 1)]
