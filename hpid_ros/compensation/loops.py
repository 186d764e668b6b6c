"""Joint loops with models, without ROS."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

from hpid_ros.base.errors import SettingError, unknown_name
from hpid_ros.compensation.states import RobotState, RobotStates
from hpid_ros.control import JointLoop
from hpid_ros.control.limited_law import ModelTerm


class JointModel(Protocol):
    """A model of the robot, as one of its joints sees it."""

    @property
    def needs_efforts(self) -> bool:
        """Whether it decouples the joint, by the others' efforts."""

    def term(self, state: RobotState) -> tuple[float, float]:
        """Return gain and effort [N m] at a state; see :class:`ModelTerm`."""


class Compensator:
    """Gives one joint's loop the model's term of each state."""

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
        """Return the term of one measured state."""
        return self._of(self.states.observe(stamp_ns, positions, velocities, efforts))

    def hold(self, stamp_ns: int, reason: str) -> ModelTerm | None:
        """Return the term of the last usable state for one that is not, if it is recent."""
        return self._of(self.states.hold(stamp_ns, reason))

    def answer(
        self,
        loop: JointLoop,
        stamp_ns: int,
        position: float,
        velocity: float | None,
        term: ModelTerm | None,
    ) -> float:
        """Return the effort that answers a state, in [N m]: ``fallback_effort`` without a term.

        The one rule for a controller's node and for the engine without ROS.
        """
        if term is None:
            return loop.reject(stamp_ns, f"no model term: {self.states.last_fault}")
        return loop.step(stamp_ns, position, velocity, term)

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
            self.states.last_fault = f"the model gave an effort of {effort} and a gain of {gain}"
            return None
        return ModelTerm(gain, effort, self._follows)


class CompensatedLoops:
    """Answers one state after the other as the controllers' nodes would."""

    def __init__(
        self,
        joints: Sequence[str],
        loops: Sequence[JointLoop],
        compensators: Sequence[Compensator | None],
    ) -> None:
        self._loops = tuple(zip(loops, compensators, strict=True))
        self._places = {
            each.states.joints: [_place(name, joints) for name in each.states.joints]
            for each in compensators
            if each is not None
        }

    def step(
        self,
        stamp_ns: int,
        positions: Sequence[float],
        velocities: Sequence[float] | None,
        efforts: Sequence[float],
    ) -> list[float]:
        """Take one state and return the efforts that answer it, in [N m].

        Args:
            stamp_ns: Its stamp in [ns].
            positions: Measured positions in [rad].
            velocities: Measured velocities in [rad/s]; None where the robot measures none.
            efforts: Efforts that the motors gave in the period before, in [N m].
        """
        seen = {
            names: (
                [positions[place] for place in places],
                None if velocities is None else [velocities[place] for place in places],
                [efforts[place] for place in places],
            )
            for names, places in self._places.items()
        }
        answers = []
        for row, (loop, model) in enumerate(self._loops):
            velocity = None if velocities is None else velocities[row]
            if model is None:
                answers.append(loop.step(stamp_ns, positions[row], velocity))
                continue
            term = model.term(stamp_ns, *seen[model.states.joints])
            answers.append(model.answer(loop, stamp_ns, positions[row], velocity, term))
        return answers


def _place(joint: str, joints: Sequence[str]) -> int:
    if joint not in joints:
        raise SettingError(
            f"the states lack a joint of the model: {unknown_name('joint', joint, joints)}; "
            f"model.locked_joints holds joints that are not driven"
        )
    return joints.index(joint)
