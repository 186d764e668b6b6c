"""What came of one joint, as samples on its control clock."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hpid_ros.base.arrays import Numbers
from hpid_ros.live.graph import Samples
from hpid_ros.live.streams import ControlClock, JointClock, JointNumbers


class Heard(NamedTuple):
    """What came of one joint, by where it came from."""

    states: JointNumbers
    commands: JointNumbers  # its commands, stamped with the states that they answer
    bare_commands: Numbers  # [N m] its commands where they have no stamps, (n,)
    references: JointNumbers  # what its controller told as its reference


class JointSampler:
    """Makes samples of what comes of one joint."""

    def __init__(self, clock: ControlClock) -> None:
        self.clock = JointClock(clock)
        self._has_commands = False

    def take(self, heard: Heard) -> Samples:
        """Return what came since the last call; what nobody can place in time is left out."""
        stamps = heard.states.stamps_ns
        first, is_restarted = self.clock.take(stamps) if len(stamps) else (0, False)
        states = heard.states.picked(slice(first, None))
        times = self.clock.seconds(states.stamps_ns)
        references = self._answers(heard.references, is_restarted)
        return Samples(
            np.column_stack((times, states.position, states.velocity)),
            self._efforts(heard, states, times, is_restarted),
            np.column_stack(
                (
                    self.clock.seconds(references.stamps_ns),
                    references.position,
                    references.velocity,
                )
            ),
            is_restarted,
        )

    def _answers(self, told: JointNumbers, is_restarted: bool) -> JointNumbers:
        """Return what answers states of the present time."""
        return told.picked(self.clock.present(told.stamps_ns, is_restarted))

    def _efforts(
        self, heard: Heard, states: JointNumbers, times: Numbers, is_restarted: bool
    ) -> Numbers:
        """Return times and efforts: as commanded, or else as measured."""
        bare = heard.bare_commands
        self._has_commands |= bool(len(heard.commands.stamps_ns) or len(bare))
        if len(bare):
            return np.column_stack((self._times_of(len(bare), times), bare))
        if self._has_commands:
            commands = self._answers(heard.commands, is_restarted)
            return np.column_stack((self.clock.seconds(commands.stamps_ns), commands.effort))
        is_told = np.isfinite(states.effort)
        return np.column_stack((times[is_told], states.effort[is_told]))

    def _times_of(self, count: int, times: Numbers) -> Numbers:
        """Return times of so many commands without stamps: the newest answers the newest state."""
        if not len(times):
            last_ns = self.clock.last_ns
            return np.full(count, np.nan if last_ns is None else self.clock.now(last_ns))
        return times[np.clip(np.arange(len(times) - count, len(times)), 0, None)]
