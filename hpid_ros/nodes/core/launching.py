"""What the launch files have in common: a launch ends with the reason when a process fails.

ROS's own launch goes on, and ends with 0, whatever becomes of its processes. It is imported by
nothing but launch files: it is not on PyPI.
"""

from __future__ import annotations

from launch import LaunchContext
from launch.actions import RegisterEventHandler
from launch.event_handlers import OnProcessExit, OnProcessIO
from launch.events.process import ProcessExited, ProcessIO


def failures() -> list[RegisterEventHandler]:
    """Return what ends the launch, with the last line that a failed process wrote to stderr.

    A process that a signal ended has not failed.
    """
    last_words: dict[int, str] = {}

    def note(event: ProcessIO) -> None:
        lines = event.text.decode(errors="replace").strip().splitlines()
        if lines:
            last_words[event.pid] = lines[-1]

    def ended(event: ProcessExited, context: LaunchContext) -> None:
        if event.returncode > 0 and not context.is_shutdown:
            reason = last_words.get(event.pid, "it said nothing")
            raise RuntimeError(
                f"{event.process_name} ended with exit code {event.returncode}: {reason}"
            )

    return [
        RegisterEventHandler(OnProcessIO(on_stderr=note)),
        RegisterEventHandler(OnProcessExit(on_exit=ended)),
    ]
