"""Joint loops with models, without ROS."""

from __future__ import annotations

from collections.abc import Sequence

from hpid_ros.control import JointLoop
from hpid_ros.control.compensation import Compensator
from hpid_ros.errors import SettingError, unknown_name

Vector = Sequence[float]


class CompensatedLoops:
    """Answers one state after the other as the controllers' nodes would.

    Args:
        joints: The joints of every state.
        loops: One loop for each joint.
        compensators: The model of each loop; None for one without.

    Raises:
        SettingError: A model has a joint that the states lack.
    """

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
        positions: Vector,
        velocities: Vector | None,
        efforts: Vector,
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
            if term is None:
                fault = f"no model term: {model.states.last_fault}"
                answers.append(loop.reject(stamp_ns, fault))
            else:
                answers.append(loop.step(stamp_ns, positions[row], velocity, term))
        return answers


def _place(joint: str, joints: Sequence[str]) -> int:
    if joint not in joints:
        raise SettingError(
            f"the states lack a joint of the model: {unknown_name('joint', joint, joints)}; "
            f"model.locked_joints holds joints that are not driven"
        )
    return joints.index(joint)
