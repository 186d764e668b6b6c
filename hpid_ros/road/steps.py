"""What to do with a proposal, in the order in which it is safe."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path

from hpid_ros.analysis.quantities import ITAE, IVC
from hpid_ros.base.names import controller_name
from hpid_ros.control import LoopSettings
from hpid_ros.road.prediction import Prediction
from hpid_ros.road.proposal import Answer

_HALF = 0.5


def first_steps(
    found: Answer, prediction: Prediction, files: Mapping[str, Path]
) -> list[tuple[str, Sequence[str]]]:
    """Return what to do, each in words and as lines of commands, if there are any."""
    if not prediction.is_credible:
        bag, robot = (shlex.quote(str(each)) for each in (found.question.bag, found.question.urdf))
        return [
            (
                "See which joint's efforts the model does not explain.",
                (f"hpid identify {bag} --urdf {robot} --plot efforts.png",),
            ),
            ("See whether the parameters are those that ran.", (f"hpid replay {bag}",)),
        ]
    changed = [each for each in found.settings if each.law == "hpid"]
    if not changed:
        return [
            ("Nothing needs to be tried: keep what you have.", ()),
            *(
                (f"To see what the goal {goal} proposes, ask for it.", (_again(found, goal),))
                for goal in found.others
            ),
        ]
    first = min(changed, key=lambda each: _benefit(each.joint, prediction))
    parameters = shlex.quote(str(files["parameters"]))
    prediction_file = shlex.quote(str(files["prediction"]))
    bag = shlex.quote(str(found.question.bag))
    return [
        (
            "Start the controllers from the new file with the motors off; where your own file "
            "says more, as topics or a robot_description, give that first.",
            (f"ros2 run hpid_ros joint_controllers --ros-args --params-file {parameters}",),
        ),
        (
            f"Begin with {first.joint}, which has most to gain, and with half of its degree; the "
            "others get mu 0, which is the PID that you know. Then switch the motors on.",
            [_half(each, each is first) for each in changed],
        ),
        (
            "Move as the robot is going to work. If all is well, give it the whole degree, and "
            "the next joint half of its own.",
            (_set(first, first.mu),),
        ),
        (
            "Record the motion of the first recording once more, with all that was proposed.",
            (
                "ros2 run hpid_ros bag_recorder --ros-args -p bag:=after \\",
                f"    -p controllers_file:={parameters}",
            ),
        ),
        (
            "Hold the prediction against it.",
            (f"hpid upgrade --verify {bag} after --prediction {prediction_file}",),
        ),
    ]


def _benefit(joint: str, prediction: Prediction) -> float:
    known = prediction.joints[joint]
    return known[IVC.key].ratio + known[ITAE.key].ratio


def _half(settings: LoopSettings, is_first: bool) -> str:
    return _set(settings, _HALF * settings.mu if is_first else 0.0)


def _set(settings: LoopSettings, degree: float) -> str:
    node = shlex.quote(f"/{controller_name(settings.joint)}")
    return f"ros2 param set {node} mu {round(degree, 3)!r}"


def _again(found: Answer, goal: str) -> str:
    bag, robot = (shlex.quote(str(each)) for each in (found.question.bag, found.question.urdf))
    return f"hpid upgrade {bag} --urdf {robot} --goal {goal}"
