"""From states of the whole robot to what a model adds to one joint's effort."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

from hpid_ros.control.model_term import ModelTerm
from hpid_ros.control.robot_states import RobotState, RobotStates


class JointModel(Protocol):
    """A model of the robot, as one of its joints sees it."""

    @property
    def needs_efforts(self) -> bool:
        """Whether it decouples the joint, by the others' efforts."""

    def term(self, state: RobotState) -> tuple[float, float]:
        """Return gain and effort [N m] at a state; see :class:`ModelTerm`.

        Raises:
            ArithmeticError: The model has none at this state.
        """


class Compensator:
    """Gives one joint's loop the model's term of each state.

    Attributes:
        states: Completes and checks the states; the joints of one process may share them.

    Args:
        model: The model.
        states: Its states.
    """

    def __init__(self, model: JointModel, states: RobotStates) -> None:
        self.states = states
        self._model = model
        self._follows = model.needs_efforts

    def term(
        self,
        stamp_ns: int,
        positions: Sequence[float],
        velocities: Sequence[float] | None,
        efforts: Sequence[float] | None,
    ) -> ModelTerm | None:
        """Return the term of one measured state.

        Args:
            stamp_ns: Its stamp in [ns].
            positions: Of the model's joints in [rad].
            velocities: In [rad/s]; None when the robot reports none.
            efforts: In [N m], of the period before; None when the robot reports none.

        Returns:
            None when the state cannot be used and there was none for ``state_timeout``; then
            the joint must not be driven by its law.
        """
        return self._of(self.states.observe(stamp_ns, positions, velocities, efforts))

    def hold(self, stamp_ns: int, reason: str) -> ModelTerm | None:
        """Return the term of the last usable state in place of one that is not, if it is recent.

        Args:
            stamp_ns: Stamp of the state that cannot be used, in [ns].
            reason: What is wrong with it, in words.
        """
        return self._of(self.states.hold(stamp_ns, reason))

    def reset(self) -> None:
        """Forget the past: the next state is the first one."""
        self.states.reset()

    def _of(self, state: RobotState | None) -> ModelTerm | None:
        if state is None:
            return None
        try:
            gain, effort = self._model.term(state)
        except ArithmeticError as error:
            self.states.last_fault = str(error)
            return None
        if not (0.0 < gain < math.inf and math.isfinite(effort)):
            self.states.last_fault = f"the model gave {effort} N m and a gain of {gain}"
            return None
        return ModelTerm(gain, effort, self._follows)
