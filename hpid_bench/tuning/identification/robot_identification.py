"""A recorded robot's joints, identified: base, links, findings."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hpid_bench.tuning.identification.identify import Method, identify
from hpid_bench.tuning.identification.joint_identification import (
    JointIdentification,
    not_identified,
)
from hpid_bench.tuning.identification.joint_record import JointRecord
from hpid_bench.tuning.identification.regression import INERTIA
from hpid_ros.base.errors import BagError, SettingError, unknown_name
from hpid_ros.base.units import NANOSECONDS, Numbers
from hpid_ros.messages.messages import BagMessages, odometry_topics
from hpid_ros.messages.quality import MEASURED
from hpid_ros.messages.reading.topic_choice import is_below
from hpid_ros.messages.series import JointSeries, RunSeries, seconds_since
from hpid_ros.robot.amendments import JointAmendment, amended
from hpid_ros.robot.description import GivenRobot
from hpid_ros.robot.dynamics import Dynamics, InverseDynamics

_STILL = 1e-3  # [m] and [rad]
_WHEEL = "wheel"


class BaseTravel(NamedTuple):
    """How far a base moved while it was recorded."""

    way: float  # [m] between its ends
    turn: float  # [rad] likewise

    @property
    def is_moving(self) -> bool:
        return self.way > _STILL or self.turn > _STILL

    def __str__(self) -> str:
        return f"{self.way:.2g} m and {self.turn:.2g} rad by its odometry"


def base_travel(bag: Path, namespace: str = "") -> BaseTravel | None:
    """Return how far a base moved by all odometry that a bag has; None if it has none."""
    found = []
    topics = [name for name in odometry_topics(bag) if is_below(name, f"/{namespace.strip('/')}")]
    for topic in topics:
        with suppress(BagError):  # without messages, or with damaged ones
            found.append(BagMessages(bag).planar(topic).poses)
    if not found:
        return None
    ways = [float(np.hypot(*np.ptp(poses[:, :2], axis=0))) for poses in found]
    return BaseTravel(max(ways), max(float(np.ptp(poses[:, 2])) for poses in found))


def is_wheel(joint: str, robot: GivenRobot | None, motion: BaseTravel | None) -> bool:
    """Return whether a joint is a wheel of the base: the robot says so, or its name does."""
    is_fixed = robot is not None and robot.fixed_base and not (motion and motion.is_moving)
    if robot is not None and (robot.wheels or is_fixed):
        return joint in robot.wheels
    return _WHEEL in joint.lower()


def why_not_wheel(motion: BaseTravel | None, *, is_asked_for: bool) -> str:
    """Return why a wheel's numbers would be none of its own; nothing if they are."""
    if motion is None:
        if is_asked_for:
            return ""
        return (
            "a wheel by its name, and no odometry tells whether the robot rolled: what it moves "
            "would be the robot; if it turned freely, ask for it with --joint"
        )
    if not motion.is_moving:
        return ""
    return (
        f"the robot rolled on it ({motion}): what it moves is the robot, and changes with all "
        "that the robot does; turn it freely, off the ground"
    )


def remark_on_base(motion: BaseTravel) -> str:
    """Return what must be known of joints that a base carries that moved."""
    return (
        f"the base moved ({motion}), but the links are known on a base that stands still: what "
        "its motion needs is in these numbers, for whose intervals nothing stands"
    )


_FEW_UNANSWERED = 0.01  # of the states; idle machines lose less
_MANY = 0.05  # of the states or commands of a joint: numbers are of what is left
_GAP = 1.5  # periods
_PAUSE = 1.0  # [s]: nobody recorded meanwhile
_REPEATING = 0.5  # of the measured efforts: where more change, they are measured again
_REGULAR = 0.8  # of the holds: those of a sensor with few steps depend on the motion
_LEAST_HOLDS = 20
_MILLISECONDS = 1e3
_DENSE = 0.2  # of the driven joints' states, for a joint whose motion is followed


class MovedInertia(NamedTuple):
    """What a joint's motor moves, over the poses of a recording, in [kg m^2]; [kg] of a slide."""

    least: float  # of all poses
    mean: float  # over the poses
    largest: float  # of all poses


@dataclass(frozen=True)
class RobotIdentification:
    """What came of a recording."""

    joints: tuple[JointIdentification, ...]  # what was found of each joint
    sources: Mapping[str, str]  # where each joint's efforts are from
    slides: tuple[str, ...] = ()  # joints that slide
    moved: Mapping[str, MovedInertia] = field(default_factory=dict)
    # one line for each thing that the whole recording is known to lack
    missing: tuple[str, ...] = ()


def identify_robot(
    recording: RunSeries,
    robot: GivenRobot | None,
    method: Method | None = None,
    asked: Sequence[str] | None = None,
    robot_name: str = "the robot",
    bag_name: str = "the recording",
    base: BaseTravel | None = None,
) -> RobotIdentification:
    for joint in asked or ():
        if joint not in recording.joint_names:
            raise SettingError(unknown_name("joint", joint, recording.joint_names))
    driven = [each.joint for each in recording.joints if each.has_effort or each.has_reference]
    driven = driven or list(recording.joint_names)
    looked_at = driven if asked is None else asked
    kept = {each.joint for each in recording.joints if _has_moved(each)}.union(looked_at)
    sparse: set[str] = set()
    if robot is not None:
        sparse = _sparse(recording, driven) - {*looked_at}
        kept = kept.union(driven) - sparse
        robot = as_recorded(robot, recording.joints, sparse)
    recording = recording.narrowed(kept)
    records = _records(recording)
    missing = (
        *recording.quality.missing_lines,
        *_losses(recording),
        *_holds(records, recording),
        *_rare(records),
        *(f"{name} moved, but has few states: taken for still" for name in sorted(sparse)),
    )
    wheels = _wheels(records, robot, base, asked)
    if robot is None:
        alone = [name for name in looked_at if name not in wheels]
        found = _with_losses(identify(records, method=method, wanted=alone), recording)
        slides = tuple(name for name in recording.joint_names if name in recording.slides)
        refused = [each for joint, each in wheels.items() if joint in looked_at]
        every = _in_order([*found, *refused], records)
        return RobotIdentification(every, _sources(recording), slides, missing=missing)
    joints = robot.description.joints
    records = [each for each in records if each.joint in joints]
    wanted = [name for name in driven if name in joints] if asked is None else asked
    if not wanted:
        raise SettingError(
            f"{robot_name} has none of the joints of {bag_name}: {', '.join(driven)}"
        )
    for joint in wanted:
        if joint not in joints:
            raise SettingError(f"{robot_name}: {unknown_name('joint', joint, joints)}")
    own = [joint for joint in wanted if joint not in wheels]
    names = [each.joint for each in records]
    others = {name: at for name, at in robot.initial_positions.items() if name not in names}
    body = InverseDynamics(robot.description, names, others)
    found = _with_losses(identify(records, body.efforts, method, own, body.spin), recording)
    if base is not None and base.is_moving:
        remark = remark_on_base(base)
        found = tuple(replace(each, remarks=(*each.remarks, remark)) for each in found)
    refused = [each for joint, each in wheels.items() if joint in wanted]
    found = _in_order([*found, *refused], records)
    slides = tuple(name for name in wanted if joints[name].is_slide)
    moved = _moved(robot, recording, found)
    return RobotIdentification(found, _sources(recording), slides, moved, missing)


def _sparse(recording: RunSeries, driven: Collection[str]) -> set[str]:
    """Return joints that nobody drives with too few states beside those that somebody does."""
    most = max(len(each.position) for each in recording.joints if each.joint in driven)
    return {
        each.joint
        for each in recording.joints
        if each.joint not in driven and _has_moved(each) and len(each.position) < _DENSE * most
    }


def as_recorded(
    robot: GivenRobot, recorded: Sequence[JointSeries], still: Collection[str] = ()
) -> GivenRobot:
    """Return a robot whose joints that stood still, or are taken for it, are where they were."""
    places = dict(robot.initial_positions)
    for each in recorded:
        joint = robot.description.joints.get(each.joint)
        if joint is not None and (each.joint in still or not _has_moved(each)):
            places[each.joint] = float(np.clip(np.mean(each.position), joint.lower, joint.upper))
    return replace(robot, initial_positions=places)


def _has_moved(series: JointSeries) -> bool:
    return float(np.ptp(series.position)) > _STILL


def _losses(recording: RunSeries) -> Iterator[str]:
    """Yield a line for each kind of sample of which many are missing, with the joints."""
    lost: dict[str, list[str]] = {}
    for each in recording.joints:
        commands, quality = each.command_stamps_ns, recording.quality.joints[each.joint]
        if not each.has_effort:
            continue
        shares = {"of the states are missing": _missing(each.state_stamps_ns)}
        if not quality.effort.startswith(MEASURED):
            shares["of the commands are missing"] = _missing(commands)
            if quality.answers_states and len(commands):
                alone = float(np.mean(~np.isin(commands, each.state_stamps_ns)))
                shares["of the commands answer no state that was recorded"] = alone
        for what, share in shares.items():
            if share >= _MANY:
                lost.setdefault(f"{share:.0%} {what}", []).append(each.joint)
    for what, joints in lost.items():
        yield f"{', '.join(joints)}: {what}"


def _missing(stamps_ns: NDArray[np.int64]) -> float:
    """Return the share of samples that would fill the gaps between stamps, pauses aside."""
    steps = np.diff(stamps_ns) / NANOSECONDS
    if not len(steps):
        return 0.0
    period = float(np.median(steps))
    gaps = steps[(steps > _GAP * period) & (steps < _PAUSE)]
    lost = float(np.sum(np.round(gaps / period) - 1.0))
    return lost / (lost + len(stamps_ns))


def _holds(records: Sequence[JointRecord], recording: RunSeries) -> Iterator[str]:
    """Yield a line for measured efforts that are held, with the joints."""
    sources, held = _sources(recording), dict[str, list[str]]()
    for each in records:
        if each.is_held and sources[each.joint].startswith(MEASURED):
            changes = each.effort_time[1:][np.diff(each.effort) != 0.0]
            hold = float(np.median(np.diff(changes))) * _MILLISECONDS
            line = (
                f"the measured efforts repeat, for {hold:.3g} ms each, and are taken as held: if "
                f"they are only measured so seldom, they and the delay are {hold / 2.0:.3g} ms off"
            )
            held.setdefault(line, []).append(each.joint)
    for line, joints in held.items():
        yield f"{', '.join(joints)}: {line}"


def _rare(records: Sequence[JointRecord]) -> Iterator[str]:
    """Yield a line for joints with fewer commands than states."""
    joints = [
        each.joint
        for each in records
        if each.is_held
        and len(each.effort) > 1
        and np.median(np.diff(each.effort_time)) > _GAP * each.period
    ]
    if joints:
        yield (
            f"{', '.join(joints)}: efforts were recorded more rarely than states: if there were "
            "others between, the delay is half an effort's period too short"
        )


def _is_held(effort: Numbers, source: str) -> bool:
    """Return whether efforts act until the next one: commands, and measured ones that repeat."""
    if not source.startswith(MEASURED):
        return True
    changes = np.flatnonzero(np.diff(effort))
    holds = np.diff(changes)
    if len(holds) < _LEAST_HOLDS or len(changes) > _REPEATING * len(effort):
        return False
    return bool(np.mean(np.abs(holds - np.median(holds)) <= 1.0) > _REGULAR)


def _with_losses(
    found: Iterable[JointIdentification], recording: RunSeries
) -> tuple[JointIdentification, ...]:
    """Remark on joints whose controllers may have been late: intervals know nothing of that."""
    counts = {each.joint: len(each.position) for each in recording.joints}
    remarked = []
    for each in found:
        states, unanswered = counts[each.joint], recording.losses[each.joint].unanswered_states
        if unanswered > _FEW_UNANSWERED * states:
            remark = (
                f"{unanswered} of {states} states have no command of their own: if the controller "
                f"was late, when its commands came into force is a guess"
            )
            each = replace(each, remarks=(*each.remarks, remark))
        remarked.append(each)
    return tuple(remarked)


def _wheels(
    records: Sequence[JointRecord],
    robot: GivenRobot | None,
    base: BaseTravel | None,
    asked: Sequence[str] | None,
) -> dict[str, JointIdentification]:
    """Return the wheels under a robot that rolls, each with why nothing is said of it."""
    refused = {}
    for each in records:
        if is_wheel(each.joint, robot, base):
            reason = why_not_wheel(base, is_asked_for=each.joint in (asked or ()))
            if reason:
                refused[each.joint] = not_identified(each, reason)
    return refused


def _in_order(
    found: Iterable[JointIdentification], records: Sequence[JointRecord]
) -> tuple[JointIdentification, ...]:
    order = {each.joint: place for place, each in enumerate(records)}
    return tuple(sorted(found, key=lambda each: order[each.joint]))


def _sources(recording: RunSeries) -> dict[str, str]:
    qualities = recording.quality.joints
    return {name: qualities[name].effort for name in recording.joint_names}


def _records(recording: RunSeries) -> list[JointRecord]:
    """Return the recording's joints, in seconds since its first state."""
    sources = _sources(recording)
    return [
        JointRecord(
            each.joint,
            seconds_since(each.state_stamps_ns, recording.start_ns),
            each.position,
            seconds_since(each.command_stamps_ns, recording.start_ns),
            each.effort,
            each.reference,
            is_held=_is_held(each.effort, sources[each.joint]),
        )
        for each in recording.joints
    ]


def _moved(
    robot: GivenRobot, recording: RunSeries, found: Sequence[JointIdentification]
) -> dict[str, MovedInertia]:
    """Return what the motors move, with the rotors that were found."""
    known = {
        each.joint: JointAmendment(rotor_inertia=rotor.value, gear_ratio=1.0)
        for each in found
        if (rotor := each.reliable(INERTIA)) is not None
    }
    dynamics = Dynamics(amended(robot.description, known, {}, {}))
    names = list(known)
    poses = [
        {name: at for name, at in pose.items() if name in robot.description.joints}
        for pose in visited_poses(recording.joints)
    ]
    try:
        met = [
            dynamics.joint_inertias(names, {**robot.initial_positions, **pose}) for pose in poses
        ]
    except np.linalg.LinAlgError:  # a joint that moves nothing with mass, and no rotor was found
        return {}
    found_of = {name: [each[name] for each in met] for name in names}
    return {
        name: MovedInertia(min(each), math.fsum(each) / len(each), max(each))
        for name, each in found_of.items()
    }


_VISITED = 200  # poses of a recording


def visited_poses(recorded: Sequence[JointSeries]) -> list[dict[str, float]]:
    """Return poses of a recording, evenly spaced among its states: none in a long gap."""
    if not recorded:
        return []
    known = np.unique(np.concatenate([each.state_stamps_ns for each in recorded]))
    places = np.linspace(0.0, len(known) - 1.0, _VISITED)
    stamps = np.interp(places, np.arange(len(known)), known)
    columns = [np.interp(stamps, each.state_stamps_ns, each.position) for each in recorded]
    names = [each.joint for each in recorded]
    return [dict(zip(names, map(float, row), strict=True)) for row in zip(*columns, strict=True)]
