"""Measuring in turn, so that what the machine does in the meantime happens to all alike."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Collection, Mapping

from benchmarks.figures import Figure, Group, Measure, Outcome
from hpid_ros.base.processes import raise_if_interrupted

Tell = Callable[[str], None]
"""Takes one line about what is going on."""


class Measured(dict[str, list[Mapping[str, float]]]):
    """The quantities of each contender, one mapping for each round."""

    def __init__(self) -> None:
        super().__init__()
        self.failures: dict[str, str] = {}


def measure_in_turn(contenders: Mapping[str, Measure], rounds: int, tell: Tell) -> Measured:
    """Measure every contender once in each round.

    Every round begins with another contender, so that none is always the first. A contender
    that fails is not measured again.
    """
    measured = Measured()
    names = list(contenders)
    for k in range(rounds if names else 0):
        for name in names[k % len(names) :] + names[: k % len(names)]:
            if name in measured.failures:
                continue
            tell(f"round {k + 1} of {rounds}: {name}")
            try:
                measured.setdefault(name, []).append(contenders[name]())
            except Exception as error:  # one that fails must not cost the figures of the others
                line = " ".join(str(error).split()) or "no reason given"
                measured.failures[name] = f"{name}: {type(error).__name__}: {line}"
            raise_if_interrupted()
    return measured


def figures_of(
    group: Group, wanted: Collection[str], rounds: int, tell: Tell
) -> list[Outcome | str]:
    """Measure the wanted figures of a group.

    Returns:
        For each wanted figure its outcome, or one line that says why there is none.
    """
    figures = [figure for figure in group.figures if figure.name in wanted]
    needed = {side.contender for each in figures for side in (each.ours, each.reference)}
    contenders = {name: each for name, each in group.contenders.items() if name in needed}
    if group.rounds_at_most is not None:
        rounds = min(rounds, group.rounds_at_most)
    measured = measure_in_turn(contenders, rounds, tell)
    return [_outcome(figure, measured) for figure in figures]


def _outcome(figure: Figure, measured: Measured) -> Outcome | str:
    for side in (figure.ours, figure.reference):
        if side.contender in measured.failures:
            return f"{figure.name}: not measured: {measured.failures[side.contender]}"
    ours, reference = measured[figure.ours.contender], measured[figure.reference.contender]
    try:
        return Outcome.of(figure, ours, reference)
    except (KeyError, ValueError) as error:
        return f"{figure.name}: not measured: {type(error).__name__}: {error}"


def time_per_item(run: Callable[[], object], items: int) -> float:
    """Return the time that a run takes for each of its items, in [s], without the collector."""
    was_collecting = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        begin = time.perf_counter()
        run()
        return (time.perf_counter() - begin) / items
    finally:
        if was_collecting:
            gc.enable()
