"""Options of a run on the graph: processes, pace and recording."""

from __future__ import annotations

from dataclasses import dataclass

from hpid_ros.base.errors import SettingError

PROCESSES = ("each", "composed", "single")


@dataclass(frozen=True)
class GraphOptions:
    """Choices that change how fast a run goes and, in lock-step, nothing of its numbers."""

    processes: str = "each"  # each: every controller in a process of its own
    is_recorded: bool = True  # whether a recorder writes a bag
    # the wall clock paces the states, and no state waits for its answers
    is_realtime: bool = False
    realtime_priority: int = 0  # SCHED_FIFO priority of controllers and bridge; 0 asks for none

    def __post_init__(self) -> None:
        if self.processes not in PROCESSES:
            raise SettingError(
                f"processes must be one of {', '.join(PROCESSES)}, not {self.processes!r}"
            )
        if not 0 <= self.realtime_priority <= 99:
            raise SettingError(
                f"realtime_priority must lie in [0, 99], not {self.realtime_priority}"
            )
