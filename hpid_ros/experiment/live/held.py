"""A motion that goes on while somebody holds a button, carried out beside whoever asked for it."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from hpid_ros.excitation.plan import ExcitationPlan
from hpid_ros.experiment.live.button import HELD_WITHIN, Button
from hpid_ros.experiment.live.excitation import carry_out
from hpid_ros.experiment.live.graph import RunningController, RunningGraph
from hpid_ros.experiment.live.watching import Ending

HeldStage = Literal["preparing", "ready", "moving", "ended"]


class HeldMotion:
    """One motion, in a thread of its own; every method returns at once unless it says so.

    It begins with the first :meth:`press` after it is ``ready``, goes on while presses come at
    least as often as they must, and otherwise the joints come to rest. It is recorded either way.
    """

    def __init__(
        self,
        plan: ExcitationPlan,
        controllers: Sequence[RunningController],
        graph: RunningGraph,
        bag: Path,
        states: str = "joint_states",
        within: float = HELD_WITHIN,
    ) -> None:
        self.bag = bag
        self.stage: HeldStage = "preparing"
        self.seconds = 0.0
        self._button = Button(within)
        self._ending: Ending | None = None
        self._failure: BaseException | None = None
        self._has_ended = threading.Event()
        arguments = (plan, controllers, graph, bag, states, self._tell, self._button)
        # Its children get SIGTERM from the kernel when the thread that started them ends.
        self._thread = threading.Thread(
            target=self._run, args=arguments, name="held motion", daemon=True
        )
        self._thread.start()

    def press(self) -> None:
        """Say that the button is held."""
        self._button.press()

    def release(self) -> None:
        """Have the joints come to rest; the motion cannot be taken up again."""
        self._button.release()

    @property
    def ending(self) -> Ending | None:
        """How it ended, once its recording is closed; None before."""
        if self._failure is not None:
            raise self._failure
        return self._ending

    def wait(self, timeout: float | None = None) -> Ending | None:
        """Wait until it has ended, and its recording is closed."""
        self._has_ended.wait(timeout)
        return self.ending

    def _run(self, *arguments: object) -> None:
        try:
            self._ending = carry_out(*arguments)  # type: ignore[arg-type]
        except BaseException as error:  # raised where somebody waits for the end
            self._failure = error
        finally:
            self._button.release()
            self.stage = "ended"
            self._has_ended.set()

    def _tell(self, event: str, seconds: float) -> None:
        self.seconds = max(self.seconds, seconds)
        if event == "ready":
            self.stage = "ready"
        elif event in ("begun", "at"):
            self.stage = "moving"
