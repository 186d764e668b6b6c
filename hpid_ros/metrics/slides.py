"""Which joints of a recording slide: as a robot's description says, or the recording itself."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from hpid_ros.bags.messages import read_robot_descriptions
from hpid_ros.bags.metadata import custom_data, recorded_slides
from hpid_ros.base.errors import RobotDescriptionError
from hpid_ros.robot.description import RobotDescription


class SlidingJoints(NamedTuple):
    """What is known of a recording's joints."""

    slides: frozenset[str]  # joints that slide; what is not named turns, or nobody knows
    doubts: tuple[str, ...] = ()  # what could not be used, one line each


def sliding_joints(
    bag: Path, description: RobotDescription | None, namespace: str | None = None
) -> SlidingJoints:
    """Return which joints slide: by the given description, else by what the bag holds.

    A bag of this package says so in its metadata; others may hold the ``robot_description`` that
    ``robot_state_publisher`` latches.
    """
    if description is not None:
        return SlidingJoints(description.slides)
    slides, turning, doubts = set(recorded_slides(custom_data(bag))), set[str](), []
    for topic, text in read_robot_descriptions(bag, namespace):
        try:
            robot = RobotDescription.load(text if text.lstrip().startswith("<") else "<robot/>")
        except RobotDescriptionError as error:
            doubts.append(f"{topic} does not tell which joints slide: {error}")
            continue
        slides |= robot.slides
        turning |= robot.joints.keys() - robot.slides
    return SlidingJoints(frozenset(slides - turning), tuple(doubts))
