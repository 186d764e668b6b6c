"""``hpid replay``: whether every recorded command is what the law answers; ``hpid repair``."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

from hpid_bench.cli.commands import DONE, FAILED
from hpid_bench.cli.terminal import output_console, reading
from hpid_bench.tuning.recorded_loops import read_records
from hpid_bench.tuning.replay import CommandDifference, JointVerdict, RecordedLoop, replay_joint
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.messages.selection import BagSelection
from hpid_ros.messages.writer import repair_bag

_SHOWN = 5


def run(options: argparse.Namespace) -> int:
    selection = BagSelection(
        namespace=options.namespace, states=options.states or None, commands=options.commands
    )
    with reading() as tell:
        told = partial(tell, options.bag.name)
        records, unreadable = read_records(
            options.bag, options.params, options.joint or None, selection, told
        )
    verdicts = []
    with reading() as tell:
        for number, record in enumerate(records):

            def computed(
                share: float, number: int = number, record: RecordedLoop = record
            ) -> None:
                tell(f"replaying {record.settings.joint}", (number + share) / len(records))

            verdicts.append(replay_joint(record, computed))
    console = output_console()
    for line in unreadable:
        console.print(f"not read: {line}", soft_wrap=True)
    for verdict in verdicts:
        for line in _lines(verdict):
            console.print(line, soft_wrap=True)
    console.print(_summary(verdicts), soft_wrap=True)
    return DONE if all(each.is_the_law for each in verdicts) else FAILED


def _lines(verdict: JointVerdict) -> Iterator[str]:
    """Yield what a person wants to know of one joint."""
    whole = verdict.equal + verdict.different
    if not whole:
        yield f"{verdict.joint}: no command answers a state of the recording"
    elif verdict.is_undecidable:
        yield (
            f"{verdict.joint}: {_count(whole)} commands, of which nothing can be told: its "
            "controller ran before the recording began, and what it remembered is not in the bag"
        )
        return
    elif verdict.different:
        yield f"{verdict.joint}: {_count(verdict.different)} of {_count(whole)} commands differ"
    else:
        yield f"{verdict.joint}: {_count(whole)} commands, every one the law's"
    for each in verdict.differences[:_SHOWN]:
        yield f"  {_difference(each, 'N' if verdict.is_slide else 'N m')}"
    if len(verdict.differences) > _SHOWN:
        yield f"  and later {len(verdict.differences) - _SHOWN} times more"
    others = {
        "states without an answer": verdict.unanswered,
        "commands that answer a state which was not recorded": verdict.without_state,
        "commands before the first state or after the last": verdict.outside,
        "commands by another sender": verdict.foreign,
    }
    yield from (f"  {_count(count)} {what}" for what, count in others.items() if count)
    if verdict.foreign:
        yield f"  senders: {', '.join(verdict.senders)}"
    if verdict.fallbacks:
        yield f"  {_count(verdict.fallbacks)} fallback or last efforts that answer no state"
    for note in verdict.notes:
        yield f"  assumed: {note}"


def _difference(each: CommandDifference, unit: str) -> str:
    span = f"at {each.time:.3f} s"
    if each.commands > 1:
        length = (each.last_ns - each.stamp_ns) * 1e-9
        span = f"from {each.time:.3f} s for {length:.3f} s, {_count(each.commands)} commands"
    text = f"{span}: {each.recorded!r} {unit} was sent, the law answers {each.computed!r} {unit}"
    return f"{text} ({each.reason})" if each.reason else text


def _summary(verdicts: Sequence[JointVerdict]) -> str:
    whole = sum(each.equal + each.different for each in verdicts)
    equal = sum(each.equal for each in verdicts)
    if all(each.is_the_law for each in verdicts):
        return f"every one of {_count(whole)} commands is the law's, to the last bit"
    undecidable = sum(each.different for each in verdicts if each.is_undecidable)
    if undecidable == whole:
        return "nothing can be told: begin to record before the controllers do"
    others = f", {_count(undecidable)} cannot be told" if undecidable else ""
    return f"{_count(equal)} of {_count(whole)} commands are the law's{others}"


def _count(number: int) -> str:
    return f"{number:,}".replace(",", " ")


def repair(options: argparse.Namespace) -> int:
    bag: Path = options.bag
    found = bag.resolve()
    name = found.name if found.is_dir() else found.stem
    target = options.output or found.with_name(f"{name}_repaired")
    with reading() as tell:
        repaired = repair_bag(bag, target, partial(tell, bag.name))
    for name, count in sorted(repaired.saved.items()):
        print(f"saved: {count} messages on {name}")
    if repaired.span_ns is not None:
        first, last = (time_ns / NANOSECONDS for time_ns in repaired.span_ns)
        print(f"saved: {last - first:.3f} s, from {first:.3f} s to {last:.3f} s")
    for line in repaired.unreadable or ["nothing"]:
        print(f"lost: {line}")
    print(f"written: {repaired.target}")
    return DONE
