"""The model's part in a controller: from the bytes of a state to the model's term."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from rclpy.node import Node

from hpid_ros.base.errors import MessageError
from hpid_ros.control import JointLoop, LoopSettings
from hpid_ros.control.limited_law import ModelTerm
from hpid_ros.wire import JointSample, RobotReader

if TYPE_CHECKING:
    from hpid_ros.compensation.build import LoopModel


def model_compensation(node: Node, settings: LoopSettings, robot: str) -> ModelCompensation | None:
    """Build the model that a controller's settings ask for, and say in its log what it is."""
    if not settings.model.is_on:
        return None
    # Pinocchio takes a moment to import, and a controller without a model does without.
    from hpid_ros.compensation.build import loop_model

    model = loop_model(settings, robot)
    if model is None:
        return None
    node.get_logger().info(model.text)
    return ModelCompensation(model, settings.model.compensation)


class ModelCompensation:
    """Lets a loop answer states with the model's term."""

    def __init__(self, model: LoopModel, kind: str) -> None:
        self._compensator = model.compensator
        self._reader = RobotReader(model.compensator.states.joints)
        self._kind = kind

    def answer(self, loop: JointLoop, sample: JointSample, raw: bytes) -> float:
        """Return the effort that answers a state, in [N m].

        A state that the model cannot use is answered with the term of the last one that it
        could, for at most ``state_timeout``; after that the loop gives ``fallback_effort``.
        """
        return self._compensator.answer(loop, *sample, self._term(sample.stamp_ns, raw))

    def _term(self, stamp_ns: int, raw: bytes) -> ModelTerm | None:
        """Return the model's term of a state; None when it has none that may be used."""
        try:
            robot = self._reader.read(raw)
        except MessageError as error:
            return self._compensator.hold(stamp_ns, str(error))
        return self._compensator.term(stamp_ns, *robot)

    @property
    def fault(self) -> str:
        """What was last wrong with a state, in words; empty if nothing was."""
        return self._compensator.states.last_fault

    @property
    def lacks_efforts(self) -> bool:
        """Whether the efforts that the model needs have all been exactly 0 for a while."""
        return self._compensator.states.lacks_efforts

    @property
    def held(self) -> int:
        """States that were answered with the term of an earlier one."""
        return self._compensator.states.held

    def reset(self) -> None:
        """Forget the past: the next state is the first one."""
        self._compensator.reset()

    def retune(self, settings: LoopSettings) -> None:
        """Find velocities, and hold terms, by other settings of the loop from now on."""
        self._compensator.states.retune(settings)

    def readings(self) -> Mapping[str, object]:
        """Return what ``/diagnostics`` tells of the model."""
        states = self._compensator.states
        return {
            "compensation": self._kind,
            "model terms held": states.held,
            "states without a model term": states.lost,
            "last fault of the model": states.last_fault or "none",
        }
