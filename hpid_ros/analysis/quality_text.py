"""How complete a recording is, in words: one line for a run, one row for a joint."""

from __future__ import annotations

from collections.abc import Iterator

from hpid_ros.analysis.quality import DataQuality, StampQuality
from hpid_ros.analysis.series import RunSeries
from hpid_ros.analysis.unfollowed import unfollowed_lines
from hpid_ros.foreign_text import shown

COLUMNS = (
    *("joint", "stream", "clock", "samples", "rate [Hz]", "from [s]", "to [s]"),
    *("lost", "gaps", "longest gap [ms]", "at [s]", "repeated", "out of order", "not finite"),
)


def quality_lines(run: RunSeries) -> Iterator[str]:
    """Yield one line for each thing about a recording that its numbers must be read with.

    Args:
        run: The run.
    """
    for line in _lines(run):
        yield shown(line)


def _lines(run: RunSeries) -> Iterator[str]:
    joints = run.quality.joints
    for line in run.quality.lines:
        yield f"run {run.label!r}: {line}"
    for stream in ("states", "commands"):
        qualities = {name: getattr(quality, stream) for name, quality in joints.items()}
        parts = [f"{name}: {_defects(each)}" for name, each in qualities.items() if _defects(each)]
        if parts:
            shown = "; ".join(parts[:3]) + (f"; {len(parts) - 3} more" if len(parts) > 3 else "")
            yield f"run {run.label!r}: {stream} are not complete: {shown}"
    received = [
        stream
        for stream in ("state", "command")
        if any(getattr(each, f"{stream}_clock") == "receive" for each in joints.values())
    ]
    if received:
        streams = " and ".join(f"{stream}s" for stream in received)
        yield f"run {run.label!r}: {streams} have their receive time, not a stamp of their own"
    yield from unfollowed_lines([run])


def quality_rows(joint: str, quality: DataQuality) -> Iterator[tuple[object, ...]]:
    """Yield the rows of a joint's states and commands, see :data:`COLUMNS`.

    Args:
        joint: Its name.
        quality: Its quality.
    """
    streams = (
        ("states", quality.states, quality.state_clock),
        ("commands", quality.commands, quality.command_clock),
    )
    for name, each, clock in streams:
        yield (
            *(joint, name, clock, each.count),
            f"{1.0 / each.period:.4g}" if each.period else "–",
            *(f"{each.begin:.3f}", f"{each.end:.3f}", each.lost, each.gaps),
            f"{1e3 * each.longest_gap:.3f}" if each.gaps else "–",
            f"{each.longest_gap_at:.3f}" if each.gaps else "–",
            *(each.repeated, each.out_of_order, each.not_finite),
        )


def _defects(quality: StampQuality) -> str:
    counts = {
        "lost": quality.lost,
        "repeated": quality.repeated,
        "out of order": quality.out_of_order,
        "not finite": quality.not_finite,
    }
    parts = [f"{count} {name}" for name, count in counts.items() if count]
    if quality.gaps:
        parts.append(
            f"longest gap {1e3 * quality.longest_gap:.3g} ms at {quality.longest_gap_at:.3f} s"
        )
    return ", ".join(parts)
