"""What is read of a bag: a run's states, commands and references, and what their topics hold."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from hpid_ros.base.errors import (
    BagError,
    MessageError,
    SettingError,
    TrajectoryError,
    listed_names,
    unknown_name,
)
from hpid_ros.base.names import joint_of_controller
from hpid_ros.base.units import NANOSECONDS, Numbers
from hpid_ros.messages.bounds import RECORDED
from hpid_ros.messages.clocks import set_backs, states_set_right
from hpid_ros.messages.columns import (
    CONTROLLER_STATE,
    FLOAT64,
    FLOAT64_MULTI_ARRAY,
    JOINT_STATE,
    JOINT_TRAJECTORY,
    MULTI_DOF_STATE,
    Integers,
    JointSamples,
    JointStream,
    Layouts,
    Ordered,
    TopicBatch,
    finite,
)
from hpid_ros.messages.efforts import EffortContradiction
from hpid_ros.messages.joint_trajectory import TrajectoryArrays, decode_trajectory
from hpid_ros.messages.references import Disagreement, Flags, ReferenceCandidate
from hpid_ros.messages.senders import (
    Part,
    Senders,
    coarse_ns,
    contradict_at_one_instant,
    find_senders,
    has_several_clocks,
    may_be_several,
    returns,
    stands_every_other,
)
from hpid_ros.messages.series import HOLD, MEASURED, SeriesError, StampQuality
from hpid_ros.messages.spill import Spill
from hpid_ros.motion.joint_trajectory import Column, JointTrajectory

CLOCKS = ("header", "receive")
"""Where the time of states and stamped commands comes from.

``header`` is the stamp in the message, ``receive`` the time at which the recorder got it.
"""

REFERENCES = ("auto", "trajectory", "setpoint", "sampled", "controller_state", HOLD)
"""Kinds of reference: found in this order; see :class:`BagSelection`."""

NO_COMMANDS = "none"
"""As ``commands``: read no efforts."""

EFFORT_COMMANDS = "effort"
"""As ``commands``: what controllers publish on ``~/command`` or ``~/commands`` are efforts."""

Reference = str | JointTrajectory
"""A name of :data:`REFERENCES`, a topic, or the reference itself."""

_MAPPING = re.compile(r"(?P<joint>[^=]+)=(?P<topic>[^=\[\]]+)(\[(?P<element>\d+)\])?")


class CommandTopic(NamedTuple):
    """Where one joint's efforts are."""

    topic: str  # full name of the topic
    element: int = 0  # place in the data of a Float64MultiArray


@dataclass(frozen=True)
class BagSelection:
    """What is read from a bag, and on which clock. What is left out is found by name, then type.

    Topic names are full with a leading slash; without one their last parts are enough.

    Attributes:
        joints: Only these joints, in this order: names, shell patterns (``arm_*``), or names and
            patterns after ``!`` or ``^``, which leave joints out. All that are commanded or have
            a reference if None.
        namespace: Only topics below this namespace, for instance ``"/left"``: which of several
            robots.
        states: Topics of the states (``sensor_msgs/JointState``), each joint on one of them; a
            single name is one topic.
        commands: Topic of the efforts: ``sensor_msgs/JointState`` or
            ``control_msgs/JointTrajectoryControllerState`` (its output). The topic of the states
            gives their measured efforts, which are taken, too, where nothing else carries any.
            ``"effort"`` takes the numbers of ``*_controller/commands`` for efforts, which
            neither their names nor their types tell. ``"none"`` reads no efforts.
        command_topics: Topics with the efforts of single joints (``std_msgs/Float64``,
            ``std_msgs/Float64MultiArray``), by joint.
        reference: A name of :data:`REFERENCES`, or a topic: ``trajectory`` is
            ``trajectory_msgs/JointTrajectory``, ``setpoint`` a controller's
            ``std_msgs/Float64``, ``sampled`` its ``~/reference``, ``controller_state`` the
            reference of a ``JointTrajectoryControllerState``, ``hold`` the first position of
            each joint. ``auto`` takes the first of these, but for ``hold``, that the joint has.
            A trajectory is one that was followed from the first state on.
        clock: One of :data:`CLOCKS`. Commands without a stamp have their receive time in either.
        start: Begin of the window, seconds since the first state of any joint, in [s].
        end: End of the window (inclusive), likewise.
        separates_runs: Whether stamps that go back by a second or more begin another run, which
            then follows the one before after a gap; else all are put in the order of their stamps.
        sender: Which sender of joint states is taken where several send the same joints: its
            number in the warning, its rate (``50Hz``) or its layout; the one that goes on if None.
        kinds: Types of joints as a URDF has them, by name, for their turns: positions of
            ``continuous`` joints are unwrapped and their errors taken to the nearest turn, as are
            those of others, with a line, where the positions jump by a turn.
        every: Whether the other joints that the states name follow, as far as they can be read.

    Raises:
        SettingError: An unknown clock, an empty or reversed window, an empty name.
    """

    joints: Sequence[str] | None = None
    namespace: str | None = None
    states: str | Sequence[str] | None = None
    commands: str | None = None
    command_topics: Mapping[str, CommandTopic] = field(default_factory=dict)
    reference: Reference = "auto"
    clock: str = "header"
    start: float | None = None
    end: float | None = None
    separates_runs: bool = False
    every: bool = False
    sender: str | None = None
    kinds: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.joints is not None:
            object.__setattr__(self, "joints", tuple(self.joints))
            if not self.joints or len(set(self.joints)) < len(self.joints):
                raise SettingError(f"joints must name each joint once, got {list(self.joints)}")
        object.__setattr__(self, "command_topics", dict(self.command_topics))
        if isinstance(self.states, str):
            object.__setattr__(self, "states", (self.states,))
        elif self.states is not None:
            object.__setattr__(self, "states", tuple(self.states))
        for name in ("namespace", "states", "commands", "reference", "sender"):
            value = getattr(self, name)
            if value == "" or (name == "states" and value is not None and not all(value or [""])):
                raise SettingError(f"{name} must not be an empty text")
        if self.clock not in CLOCKS:
            raise SettingError(unknown_name("clock", self.clock, CLOCKS))
        for name in ("start", "end"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value >= 0.0):
                raise SettingError(f"{name} must be zero or more seconds, got {value}")
        if self.start is not None and self.end is not None and not self.start < self.end:
            raise SettingError(f"start must be before end, got {self.start} s and {self.end} s")


def parse_command_topics(texts: Sequence[str]) -> dict[str, CommandTopic]:
    """Return the mapping that options like ``elbow=/elbow_controller/commands[0]`` give."""
    topics: dict[str, CommandTopic] = {}
    for text in texts:
        match = _MAPPING.fullmatch(text)
        if match is None:
            raise SettingError(f"must be JOINT=TOPIC or JOINT=TOPIC[ELEMENT], got {text!r}")
        joint = match["joint"]
        if joint in topics:
            raise SettingError(f"joint {joint!r} has two command topics, the second in {text!r}")
        topics[joint] = CommandTopic(match["topic"], int(match["element"] or 0))
    return topics


def find_topic(where: str, name: str, types: Mapping[str, str], allowed: Collection[str]) -> str:
    """Return the full name of a topic."""
    found = matching(name, types)
    if not found:
        raise BagError(f"{where}: {unknown_name('topic', name, types)}")
    if len(found) > 1:
        raise BagError(f"{where}: topic {name!r} could be any of {', '.join(found)}")
    (topic,) = found
    if types[topic] not in allowed:
        raise BagError(
            f"{where}: topic {topic} is {types[topic]}, but must be {' or '.join(allowed)}"
        )
    return topic


def matching(name: str, topics: Collection[str]) -> list[str]:
    """Return the topics that a name can mean, in order: one if it is a full name."""
    bare = name.lstrip("/")
    found = [topic for topic in topics if topic.lstrip("/") == bare]
    if not found and not name.startswith("/"):
        found = [topic for topic in topics if topic.endswith(f"/{bare}")]
    return sorted(found)


def namespace_of(topic: str) -> str:
    """Return the part before the last slash: ``/left`` for ``/left/joint_states``."""
    return topic.rpartition("/")[0]


def last_part(topic: str) -> str:
    return topic.rpartition("/")[2]


def is_below(topic: str, namespace: str) -> bool:
    """Return whether a topic is in a namespace or in one below it."""
    return f"/{topic.lstrip('/')}".startswith(f"{namespace.rstrip('/')}/")


def joint_of(topic: str) -> str:
    """Return the joint of a controller's own topic: ``elbow`` of ``/elbow_controller/command``."""
    return joint_of_controller(last_part(namespace_of(topic)))


_FLOATS = (FLOAT64, FLOAT64_MULTI_ARRAY)
REPORTS = (CONTROLLER_STATE, MULTI_DOF_STATE)
"""Types in which controllers of ros2_control report reference and output of each joint."""
_OF_CONTROLLERS = (*REPORTS, JOINT_TRAJECTORY)
_WITHOUT_JOINT = ("control_msgs/msg/PidState", "control_msgs/msg/JointControllerState")
"""Types in which a single PID reports, which name no joint."""
_GOALS = (
    "control_msgs/msg/FollowJointTrajectoryActionGoal",  # of ROS 1
    "control_msgs/msg/FollowJointTrajectoryActionFeedback",
    "control_msgs/action/FollowJointTrajectory_SendGoal_Event",
    "control_msgs/action/FollowJointTrajectory_FeedbackMessage",
)
_EFFORTS_OF_A_JOINT = ("cmd_force", "cmd_effort")
_COMMANDS_OF_A_JOINT = ("command", "commands")
"""Positions, velocities or efforts: only who ran the controllers knows."""
_SPEED_SCALING = "speed_scaling"
"""Of ur_robot_driver's speed_scaling_state_broadcaster, a Float64."""
_COMMANDS_OF_JOINTS = ("joint_commands", "joint_command")
"""The second is Isaac Sim's."""
_NEITHER_STATES_NOR_COMMANDS = ("reference", "terms", "estimate")


class ReferenceTopics(NamedTuple):
    """Topics that say what the joints were to follow."""

    trajectory: tuple[str, ...] = ()  # JointTrajectory, of the controllers
    setpoint: Mapping[str, str] = {}  # Float64, by joint
    sampled: tuple[str, ...] = ()  # JointState with sampled references
    # JointTrajectoryControllerState and MultiDOFStateStamped, with references
    controller_state: tuple[str, ...] = ()
    further: tuple[str, ...] = ()  # JointTrajectory, of other controllers or of planners

    @property
    def trajectories(self) -> tuple[str, ...]:
        return (*self.trajectory, *self.further)


NO_REFERENCES = ReferenceTopics()
"""Nothing says what the joints were to follow."""


@dataclass(frozen=True)
class TopicChoice:
    states: tuple[str, ...]  # of the states; each joint is on one of them
    # of stamped commands, JointState or JointTrajectoryControllerState
    commands: tuple[str, ...] = ()
    command_topics: Mapping[str, CommandTopic] = field(default_factory=dict)
    references: ReferenceTopics = NO_REFERENCES
    # whether efforts are wanted, and there is anything that may carry them
    has_commands: bool = True
    is_measured: bool = False  # whether the efforts are those that the states measured
    may_be_measured: bool = False  # whether those are to be taken if nothing else carries efforts
    measured_joints: frozenset[str] = (
        frozenset()
    )  # whose measured efforts are read beside commands
    beside: tuple[str, ...] = ()  # those of the commands that are reports beside joint_commands
    in_doubt: tuple[str, ...] = ()  # topics that may carry efforts, or something else
    others: tuple[str, ...] = ()  # of commands, taken for another robot's, where there are no more
    other_states: tuple[str, ...] = ()  # joint_states that nobody chose or left out
    not_own: tuple[str, ...] = ()  # reports and trajectories that are taken for another robot's
    relays: tuple[str, ...] = ()  # where controllers are asked for relays
    nameless: tuple[str, ...] = ()  # on which a single PID reports without its joint's name
    goals: tuple[str, ...] = ()  # of an action, and its feedback
    speed_scalings: tuple[str, ...] = ()  # how fast trajectories are followed

    def measured(self, joints: Collection[str] | None = None) -> TopicChoice:
        """Return the same with the efforts that the states measured: of some joints, or alone."""
        if joints is not None:
            return replace(self, measured_joints=frozenset(joints), may_be_measured=False)
        return replace(
            self,
            commands=self.states,
            command_topics={},
            is_measured=True,
            may_be_measured=False,
            beside=(),
        )

    @property
    def all(self) -> frozenset[str]:
        references = self.references
        return frozenset(
            (
                *self.states,
                *self.commands,
                *(each.topic for each in self.command_topics.values()),
                *references.trajectories,
                *references.setpoint.values(),
                *references.sampled,
                *references.controller_state,
            )
        )


def choose_topics(where: str, types: Mapping[str, str], selection: BagSelection) -> TopicChoice:
    return _Chooser(where, types, selection).choice()


class _Chooser:
    def __init__(self, where: str, types: Mapping[str, str], selection: BagSelection) -> None:
        self.where, self.selection, self.types = where, selection, types
        if selection.namespace is not None:
            namespace = f"/{selection.namespace.strip('/')}"
            self.types = {name: types[name] for name in types if is_below(name, namespace)}
            if not self.types:
                raise BagError(
                    f"{where}: no topic is below namespace {namespace}; topics: {_listed(types)}"
                )

    def choice(self) -> TopicChoice:
        states = self.states()
        self.near = _common([namespace_of(topic) for topic in states])
        self.others = {
            namespace_of(topic)
            for topic in self.of_type(JOINT_STATE)
            if last_part(topic) == "joint_states" and topic not in states
        }
        explicit = {
            joint: each._replace(topic=self.named(each.topic, _FLOATS))
            for joint, each in self.selection.command_topics.items()
        }
        asked = self.selection.commands
        commands, found = self.commands(states, bool(explicit))
        topics = {**found, **explicit}
        are_missed = asked is None and not commands and not topics
        choice = TopicChoice(
            states,
            commands=commands,
            command_topics=topics,
            references=self.references(),
            has_commands=asked != NO_COMMANDS,
            is_measured=commands == states,
            beside=tuple(
                name
                for name in commands
                if self.types[name] in REPORTS and self.types[commands[0]] == JOINT_STATE
            ),
            may_be_measured=asked is None and not explicit,
            in_doubt=self.in_doubt({*commands, *(each.topic for each in topics.values())}),
            others=tuple(
                matching("joint_commands", self.of_type(JOINT_STATE)) if are_missed else ()
            ),
            other_states=tuple(
                name
                for name in self.of_type(JOINT_STATE)
                if self.selection.states is None
                and last_part(name) == "joint_states"
                and name not in (*states, *commands)
            ),
            not_own=tuple(sorted({*self.below(*_OF_CONTROLLERS)} - {*self.own(*_OF_CONTROLLERS)})),
            relays=tuple(
                name for name in self.below(FLOAT64_MULTI_ARRAY) if last_part(name) == "relay"
            ),
            nameless=tuple(self.own(*_WITHOUT_JOINT)),
            goals=tuple(self.own(*_GOALS)),
            speed_scalings=tuple(x for x in self.own(FLOAT64) if last_part(x) == _SPEED_SCALING),
        )
        if are_missed:
            return choice.measured()
        return choice

    def named(self, name: str, allowed: tuple[str, ...]) -> str:
        return find_topic(self.where, name, self.types, allowed)

    def of_type(self, *types: str) -> list[str]:
        return sorted(name for name, kind in self.types.items() if kind in types)

    def below(self, *types: str) -> list[str]:
        """Return the topics of some types in the namespace of the states, the nearest first."""
        found = [name for name in self.of_type(*types) if is_below(name, self.near)]
        return sorted(found, key=lambda name: name.count("/"))

    def own(self, *types: str) -> list[str]:
        """Return :meth:`below` without what is another robot's, which has states of its own."""
        found = self.below(*types)
        return [x for x in found if not any(self.is_of_another(x, each) for each in self.others)]

    def is_of_another(self, topic: str, namespace: str) -> bool:
        return is_below(topic, namespace) and not is_below(f"{self.near}/", namespace)

    def one(self, what: str, found: list[str], option: str) -> str:
        if len(found) > 1:
            raise BagError(
                f"{self.where}: {what} could be any of {', '.join(found)}; "
                f"choose by --namespace, or name the topic ({option})"
            )
        return found[0]

    def states(self) -> tuple[str, ...]:
        if self.selection.states is not None:
            found = [self.named(name, (JOINT_STATE,)) for name in self.selection.states]
            return tuple(dict.fromkeys(found))
        candidates = self.of_type(JOINT_STATE)
        found = matching("joint_states", candidates)
        if not found:
            found = [name for name in candidates if not _is_of_a_controller(name)]
        if not found:
            raise BagError(
                f"{self.where}: no topic of states ({JOINT_STATE}); topics: {self.listed()}"
            )
        return (self.one("the states", found, "--states, several times for one robot's"),)

    def listed(self) -> str:
        return _listed(self.types)

    def commands(
        self, states: tuple[str, ...], has_explicit: bool
    ) -> tuple[tuple[str, ...], dict[str, CommandTopic]]:
        """Return topics with stamps, and those of single joints without; none if there is none."""
        asked = self.selection.commands
        if asked == NO_COMMANDS:
            return (), {}
        if asked not in (None, EFFORT_COMMANDS):
            named = self.named(asked, (JOINT_STATE, *REPORTS))
            return (states if named in states else (named,)), {}
        candidates = self.of_type(JOINT_STATE)
        here = f"{self.near}/joint_commands"
        found = [here] if here in candidates else matching("joint_commands", candidates)
        are_several = len([x for x in candidates if last_part(x) == "joint_states"]) > 1  # robots
        if asked is None and are_several:
            found = [each for each in found if self.is_near(each)]
        reports = tuple(self.own(*REPORTS))
        if found and asked is None and len(states) > 1:  # as its states, so its commands
            own = tuple(name for name in found if is_below(name, self.near))
            return (*own, *reports) if own else (), {}
        if found and asked is None:
            return (self.one("the commands", found, "--commands"), *reports), {}
        wanted: tuple[str, ...] = _EFFORTS_OF_A_JOINT
        if asked == EFFORT_COMMANDS:
            wanted += _COMMANDS_OF_A_JOINT
        floats = {
            joint_of(name): CommandTopic(name)
            for name in reversed(self.below(*_FLOATS))
            if last_part(name) in wanted
        }
        if asked == EFFORT_COMMANDS:
            if not floats:
                raise BagError(
                    f"{self.where}: no topic of a controller's commands, such as "
                    f"/elbow_controller/commands ({FLOAT64}, {FLOAT64_MULTI_ARRAY}); topics: "
                    f"{self.listed()}"
                )
            return (), floats
        if floats or reports or has_explicit:
            return reports, floats
        found = [
            name
            for name in candidates
            if name not in states
            and _may_be_commands(name)
            and (self.is_near(name) or not are_several)
        ]
        return (self.one("the commands", found, "--commands"),) if found else (), {}

    def is_near(self, topic: str) -> bool:
        """Return whether a topic is below the states' namespace, or in one above it.

        What has states of its own there is another robot.
        """
        if any(is_below(each, self.near) and is_below(topic, each) for each in self.others):
            return False
        return is_below(topic, self.near) or is_below(f"{self.near}/", namespace_of(topic))

    def in_doubt(self, taken: Collection[str]) -> tuple[str, ...]:
        """Return topics without names of joints that may carry efforts, or something else."""
        return tuple(
            name
            for name in self.below(*_FLOATS)
            if last_part(name) in _COMMANDS_OF_A_JOINT and name not in taken
        )

    def references(self) -> ReferenceTopics:
        asked = self.selection.reference
        if isinstance(asked, JointTrajectory) or asked == HOLD:
            return NO_REFERENCES
        if asked not in REFERENCES:
            return self.named_reference(asked)
        here = f"{self.near}/joint_trajectory"
        trajectories = self.own(JOINT_TRAJECTORY)
        nearest = (here,) if here in trajectories else tuple(trajectories)
        found = ReferenceTopics(
            nearest,
            {
                joint_of(name): name
                for name in reversed(self.below(FLOAT64))
                if last_part(name) == "setpoint"
            },
            tuple(name for name in self.own(JOINT_STATE) if last_part(name) == "reference"),
            tuple(self.own(*REPORTS)),
            tuple(name for name in trajectories if name not in nearest),
        )
        if asked == "auto":
            return found
        wanted = getattr(found, asked)
        if not wanted:
            raise BagError(f"{self.where}: no {asked} as reference; topics: {self.listed()}")
        if asked == "trajectory":
            return NO_REFERENCES._replace(trajectory=wanted, further=found.further)
        return NO_REFERENCES._replace(**{asked: wanted})

    def named_reference(self, name: str) -> ReferenceTopics:
        allowed = (JOINT_TRAJECTORY, FLOAT64, JOINT_STATE, *REPORTS)
        topic = self.named(name, allowed)
        kind = self.types[topic]
        if kind == FLOAT64:
            joints = self.selection.joints or ()
            joint = joints[0] if len(joints) == 1 else joint_of(topic)
            return ReferenceTopics(setpoint={joint: topic})
        if kind == JOINT_TRAJECTORY:
            return ReferenceTopics(trajectory=(topic,))
        if kind == JOINT_STATE:
            return ReferenceTopics(sampled=(topic,))
        return ReferenceTopics(controller_state=(topic,))


def _common(namespaces: Sequence[str]) -> str:
    """Return the namespace that others share: ``/robot`` of ``/robot/arm`` and ``/robot/hand``."""
    parts = [namespace.split("/") for namespace in namespaces]
    shared = []
    for level in zip(*parts, strict=False):
        if len(set(level)) > 1:
            break
        shared.append(level[0])
    return "/".join(shared)


def _is_of_a_controller(topic: str) -> bool:
    """Return whether a JointState topic is a controller's output by its name."""
    return last_part(topic) in (*_NEITHER_STATES_NOR_COMMANDS, *_COMMANDS_OF_JOINTS)


def _may_be_commands(topic: str) -> bool:
    """Return whether a JointState topic that is not the states' may be commands by its name."""
    last = last_part(topic)
    return last not in _NEITHER_STATES_NOR_COMMANDS and "state" not in last


def _listed(types: Mapping[str, str]) -> str:
    return ", ".join(f"{name} ({types[name]})" for name in sorted(types)) or "none"


FOREIGN = 0.05, 0.1, 0.3  # [rad], share of the range, at most: what is farther is no position
UNLIKE = 0.005, 0.05  # [rad] and share of the range: feedback that is farther is another position


def _by_up_to(found: Mapping[str, float]) -> str:
    return f"(by up to {max(found.values()):.3g} rad)"


_MOST_NAMES = 5
_SHARED_MOVE = 0.05  # of the states that share a stamp; with fewer that move they are repeats
_COARSE_STEPS = 1.5  # by so many steps coarse stamps are behind receive times, at most


def _farthest(found: Mapping[str, float]) -> str:
    """Return joints and how far their references are apart, at most."""
    return f"{listed_names(list(found), 3)} {_by_up_to(found)}"


def _turns_of(joints: Mapping[str, int], kind: str | None) -> str:
    """Return how often each joint jumps by a turn, and what becomes of it."""
    why = "nobody says whether they turn without end" if kind is None else f"they are {kind}"
    counts = ", ".join(f"{joint} {count} times" for joint, count in joints.items())
    return f"{counts} ({why}): the turns are added up, and errors taken to the nearest turn"


def _may_be_several(
    stream: JointStream,
    joints: Sequence[str],
    layout: tuple[str, list[Integers]],
) -> bool:
    """Return whether messages of one layout may be of several senders, by a glance."""
    stamps_ns, log_times_ns, _ = layout[1]
    if may_be_several(stamps_ns) or has_several_clocks(stamps_ns, log_times_ns):
        return True
    return any(returns(some) for joint in joints for some in stream.probes(joint))


def _coarse(joints: Iterable[JointSamples]) -> tuple[int, bool]:
    """Return the step of stamps that unlike states share, and whether they are receive times.

    The step is 0 where stamps are not coarse, in [ns].
    """
    for samples in joints:
        stamps_ns, log_times_ns, _, values = samples
        step = coarse_ns(stamps_ns, log_times_ns)
        if not step:
            return 0, False
        is_shared = stamps_ns[1:] == stamps_ns[:-1]
        moved = np.count_nonzero(np.abs(np.diff(values))[is_shared] > 0.0)
        if moved > _SHARED_MOVE * np.count_nonzero(is_shared):
            return step, bool(np.ptp(log_times_ns - stamps_ns) < _COARSE_STEPS * step)
    return 0, False


def _doubt_lines(
    topic: str, stream: JointStream, efforts: JointStream | None, joints: Sequence[str]
) -> Iterator[str]:
    """Yield a line for numbers that alternate, where nothing else tells of a second sender."""
    alternate = (
        (stream, returns, "positions come back from state to state, by more than 0.02"),
        (efforts, stands_every_other, "every other effort is one and the same number"),
    )
    for of, does, what in alternate:
        names = [
            joint
            for joint in joints
            if of is not None and any(does(some) for some in of.probes(joint))
        ]
        if names:
            yield (
                f"{listed_names(names, 3)} on {topic}: {what}: taken for one sender's, "
                "as neither stamps nor positions prove a second one"
            )


def _has_two_efforts(samples: JointSamples | None) -> bool:
    if samples is None:
        return False
    stamps_ns = states_set_right(samples, set_backs(samples))
    return contradict_at_one_instant(stamps_ns, samples.values)


def _set_right(layouts: list[tuple[str, list[Integers]]]) -> list[tuple[str, list[Integers]]]:
    """Return messages by layout with stamps as if their clock had never been set back."""
    if all((times[0][1:] > times[0][:-1]).all() for _, times in layouts):
        return layouts
    joined = JointSamples.joined(
        [JointSamples(stamps, logs, places, np.empty(0)) for _, (stamps, logs, places) in layouts]
    )
    order = np.lexsort((joined.places, joined.log_times_ns))
    logged = JointSamples(
        joined.stamps_ns[order], joined.log_times_ns[order], joined.places[order], joined.values
    )
    found = set_backs(logged)
    if not found:
        return layouts
    stamps_ns = np.empty_like(joined.stamps_ns)
    stamps_ns[order] = states_set_right(logged, found)
    parts = np.split(stamps_ns, np.cumsum([len(times[0]) for _, times in layouts])[:-1])
    return [(text, [part, *times[1:]]) for (text, times), part in zip(layouts, parts, strict=True)]


def _parts(
    stream: JointStream | None,
    efforts: JointStream | None,
    joints: Sequence[str],
    layouts: Sequence[tuple[str, list[Integers]]],
) -> list[Part]:
    """Return the messages of some joints by layout, with their positions and measured efforts."""

    def columns(of: JointStream | None) -> list[dict[str, Numbers]]:
        found: list[dict[str, Numbers]] = [{} for _ in layouts]
        for joint in joints:
            samples = None if of is None else of.peek(joint)
            if samples is None:
                continue
            order = np.argsort(samples.places)
            known = samples.places[order]
            for (_, (_, _, places)), numbers in zip(layouts, found, strict=True):
                at = np.minimum(np.searchsorted(known, places), len(known) - 1)
                if (known[at] == places).all():
                    numbers[joint] = np.nan_to_num(samples.values[order[at]])
        return found

    parts = zip(layouts, columns(stream), columns(efforts), strict=True)
    return [
        Part(text, stamps_ns, log_times_ns, places, values, numbers)
        for (text, (stamps_ns, log_times_ns, places)), values, numbers in parts
    ]


def _senders_line(topic: str, what: str, joints: Sequence[str], found: Senders) -> str:
    names = listed_names(joints, 3)
    left = " and ".join(map(str, found.left))
    if len(found.left) == len(found.each) - 1:
        left = "the others are left out"
    else:
        left += " is left out" if len(found.left) == 1 else " are left out"
    return (
        f"{names} on {topic}: {what} of {len(found.each)} senders, {'; '.join(found.texts())}: "
        f"sender {found.taken} is taken, {left} (--sender NUMBER, RATEHz or LAYOUT takes another)"
    )


class Glimpse(NamedTuple):
    """What the first messages on a topic of states hold."""

    topic: str
    period: float  # [s] usual time between two; zero if there are not two
    joints: frozenset[str]  # whose positions they have
    joints_with_efforts: frozenset[str]  # whose efforts they have, and not 0 throughout

    def __str__(self) -> str:
        rate = f"{1.0 / self.period:.3g} Hz, " if self.period else ""
        return f"{self.topic} ({rate}{'with' if self.joints_with_efforts else 'without'} efforts)"


_GLIMPSED = 100  # messages that tell the rate


def glimpse(topic: str, batches: Iterable[TopicBatch]) -> Glimpse:
    """Return what the first messages on a topic of states hold."""
    layouts = Layouts(JOINT_STATE)
    positions, efforts = (JointStream(layouts, field) for field in ("position", "effort"))
    times = np.empty(0, dtype=np.int64)
    for batch in batches:
        positions.add(batch)
        efforts.add(batch)
        times = np.concatenate((times, batch.log_times_ns))
        if len(times) >= _GLIMPSED:
            break
    steps = np.diff(np.sort(times))
    with_efforts = []
    for joint in efforts.joints():
        samples = efforts.peek(joint)
        if samples is not None and finite(samples)[0].values.any():
            with_efforts.append(joint)
    return Glimpse(
        topic,
        float(np.median(steps)) / NANOSECONDS if len(steps) else 0.0,
        positions.joints(),
        frozenset(with_efforts),
    )


def decoded_trajectory(raw: bytes) -> TrajectoryArrays:
    """Return a serialised trajectory, checked."""
    decoded = decode_trajectory(raw, RECORDED)
    decoded.require()
    return decoded


class RecordedRun:
    """The messages of a run as columns and trajectories."""

    def __init__(
        self,
        choice: TopicChoice,
        types: Mapping[str, str],
        joints: Container[str] | None,
    ) -> None:
        self.choice = choice
        self.notes: list[str] = []
        # log time in [ns], place in the files, topic and content of each
        self.trajectories: list[tuple[int, int, str, TrajectoryArrays]] = []
        spill, layouts = Spill(), dict[str, Layouts]()

        def of(topic: str) -> Layouts:
            if topic not in layouts:
                layouts[topic] = Layouts(types[topic], spill)
            return layouts[topic]

        self.states = {
            topic: JointStream(of(topic), "position", joints) for topic in choice.states
        }
        self.commands = {
            topic: JointStream(of(topic), "effort", joints) for topic in choice.commands
        }
        self.reports = {topic for topic in choice.commands if types[topic] in REPORTS}
        self.measured = {
            topic: JointStream(of(topic), "effort", choice.measured_joints)
            for topic in (choice.states if choice.measured_joints else ())
        }
        elements: dict[str, dict[int, str]] = {}
        for joint, (topic, element) in choice.command_topics.items():
            elements.setdefault(topic, {})[element] = joint
        self.floats = {
            topic: JointStream(of(topic), "data", elements=of_topic)
            for topic, of_topic in elements.items()
        }
        references = choice.references
        self.setpoints = {
            topic: JointStream(of(topic), "data", elements={0: joint})
            for joint, topic in references.setpoint.items()
        }
        self.sampled = {
            topic: JointStream(of(topic), "position", joints) for topic in references.sampled
        } | {
            topic: JointStream(of(topic), "reference", joints)
            for topic in references.controller_state
        }
        # where controllers say that joints were; of a PID controller it may be a velocity
        self.feedbacks = {
            topic: JointStream(of(topic), "feedback", joints)
            for topic in references.controller_state
        }
        self._of_pids = {x for x in references.controller_state if types[x] == MULTI_DOF_STATE}
        # of the streams that were looked at last
        self._qualities: list[tuple[Integers, int, StampQuality]] = []
        self._disagreements: dict[tuple[str, str, bool], dict[str, float]] = {}
        self._overruled: dict[tuple[str, str], dict[str, float]] = {}
        self._contradictions: dict[tuple[str, str, bool], dict[str, float]] = {}
        self._numberless: dict[tuple[tuple[str, ...], str], list[str]] = {}
        # topic of states that are not read, but have efforts of a joint
        self.efforts_elsewhere: dict[str, str] = {}
        self._unstamped: dict[str, int] = {}
        self._set_backs: dict[tuple[str, str], None] = {}
        self._ahead: dict[str, tuple[str, int]] = {}
        self._turned: dict[str | None, dict[str, int]] = {}  # turns by joint, by its type
        # the same of references, by their topics, too
        self._turned_references: dict[tuple[str, str | None], dict[str, int]] = {}
        self._unlike: dict[str, dict[str, float]] = {}  # [rad] by joint, by topic of feedback
        self._refused: dict[str, dict[int, str]] = {}  # reasons by place, by topic
        self._foreign: dict[str, list[str]] = {}  # joints by topic whose references are no angles

    def streams(self) -> Iterator[tuple[str, JointStream]]:
        """Yield topic and stream of everything but trajectories."""
        every = (self.states, self.commands, self.floats, self.setpoints, self.sampled)
        for streams in (*every, self.feedbacks, self.measured):
            yield from streams.items()

    def odd_lines(self) -> Iterator[str]:
        """Yield a line for each thing that is not taken, for the names that messages have."""
        for topic, stream in self.streams():
            yield from stream.odd_lines(topic)

    def add(self, batch: TopicBatch) -> None:
        if batch.topic in self.choice.references.trajectories:
            self._add_trajectories(batch)
            return
        for topic, stream in self.streams():
            if topic == batch.topic:
                stream.add(batch)

    def _add_trajectories(self, batch: TopicBatch) -> None:
        for log_time_ns, place, raw in batch.messages():
            try:
                decoded = decoded_trajectory(raw)
            except TrajectoryError as error:
                self.notes.append(f"a trajectory is left out, as controllers refuse it: {error}")
                continue
            except MessageError as error:
                # Whatever was followed from here on is unknown.
                raise BagError(f"{batch.topic} at {log_time_ns} ns: {error}") from error
            self.trajectories.append((log_time_ns, place, batch.topic, decoded))

    @cached_property
    def _places(self) -> Mapping[str, Sequence[tuple[int, int]]]:
        """Where each joint is: which trajectory, and which of its names."""
        places: dict[str, list[tuple[int, int]]] = {}
        for number, (*_, arrays) in enumerate(self.trajectories):
            for at, name in enumerate(arrays.names):
                places.setdefault(name, []).append((number, at))
        return places

    def trajectories_of(self, joint: str) -> Iterator[tuple[int, int, str, Column]]:
        """Yield a joint's columns, each with log time in [ns], place in the files and topic.

        To be asked when all messages have been added.
        """
        for number, at in self._places.get(joint, ()):
            log_time_ns, place, topic, arrays = self.trajectories[number]
            yield log_time_ns, place, topic, arrays.column_at(at)

    def take_feedback(self, topic: str, joint: str) -> JointSamples | None:
        """Return where a controller says that a joint was and forget it; None if it does not."""
        stream = self.feedbacks.get(topic)
        return None if stream is None else stream.take(joint)

    def may_be_foreign(self, topic: str) -> bool:
        """Return whether reports may be about something else than positions."""
        return topic in self._of_pids

    def be_foreign(self, topic: str, joint: str) -> None:
        """Note that a report is about something else than the joint's position."""
        self._foreign.setdefault(topic, []).append(joint)

    def differ(self, topic: str, joint: str, largest: float) -> None:
        """Note that a controller reports other positions than the states."""
        self._unlike.setdefault(topic, {})[joint] = largest

    def disagree(self, joint: str, found: Disagreement) -> None:
        """Note that two topics said different things about a joint."""
        key = found.taken, found.left, found.is_mixed
        self._disagreements.setdefault(key, {})[joint] = found.largest

    def overrule(
        self, joint: str, found: ReferenceCandidate, asked: ReferenceCandidate, differ: Flags
    ) -> None:
        """Note that a controller reported something else than it was asked."""
        largest = float(np.abs(found.values - asked.values)[differ].max())
        self._overruled.setdefault((found.topic, asked.topic), {})[joint] = largest

    def note_unstamped(self, topic: str, count: int) -> None:
        """Note messages that are left out, as they alone have no stamp."""
        self._unstamped[topic] = max(count, self._unstamped.get(topic, 0))

    def note_set_back(self, topic: str, at: float, by: float) -> None:
        """Note that the clock of the states was set back, seconds after the first."""
        self._set_backs[topic, f"{by:.3g} s at {at:.3f} s"] = None

    def compares(self, topic: str) -> bool:
        """Return whether the clock of a topic is still to be compared; once is enough."""
        return topic not in self._ahead

    def note_ahead(self, topic: str, states: str, ahead_ns: int) -> None:
        """Note by how much the stamps of a topic are ahead of the states'."""
        self._ahead[topic] = states, ahead_ns

    def clock_lines(self) -> Iterator[str]:
        """Yield a line for each thing about the stamps that was decided."""
        for topic, count in self._unstamped.items():
            messages = "1 message" if count == 1 else f"{count} messages"
            their, stamps = ("its", "stamp is") if count == 1 else ("their", "stamps are")
            yield (
                f"{messages} on {topic} left out: {their} {stamps} 0, and those of the others are "
                "not"
            )
        for topic, text in self._set_backs:
            yield (
                f"the clock of {topic} was set back by {text}: what follows is shifted by as "
                "much, so that it begins one period later"
            )
        for topic, (states, ahead_ns) in self._ahead.items():
            apart = f"{abs(ahead_ns) / NANOSECONDS:.2g} s"
            if ahead_ns and states:
                how = "later" if ahead_ns > 0 else "earlier"
                yield (
                    f"{topic} is stamped {apart} {how} than {states}, against the times at which "
                    "both were received: their clocks differ, or one is late; --clock receive "
                    "compares by the latter"
                )
            elif ahead_ns:
                yield (
                    f"{topic} is stamped {apart} before it was received, by the stamps of the "
                    "states: their clocks differ, or it came late; it counts from its stamp on"
                )

    def note_other_states(self, read: Glimpse, others: Sequence[Glimpse]) -> None:
        """Note topics that have states of the joints, too, where one was chosen by its name."""
        known = self.known_joints()
        for each in others:
            shared = [joint for joint in known if joint in each.joints]
            namespace = namespace_of(each.topic)
            beside = [name for name in self.choice.not_own if is_below(name, namespace)]
            left = f"; what is beside them is not read: {', '.join(beside)}" if beside else ""
            if shared:
                self.notes.append(
                    f"{each} has states of {listed_names(shared, _MOST_NAMES)}, too: {read} is "
                    f"read (--states {each.topic} takes the other){left}"
                )
            for joint in each.joints_with_efforts:
                self.efforts_elsewhere.setdefault(joint, each.topic)

    def contradict(self, joint: str, found: EffortContradiction) -> None:
        """Note that two topics had unlike efforts of a joint."""
        key = found.taken, found.left, found.is_left_out
        self._contradictions.setdefault(key, {})[joint] = found.largest

    def note_no_numbers(self, joint: str, topics: Sequence[str], instead: str) -> None:
        """Note that the efforts of a joint on some topics are no numbers, and what is taken."""
        self._numberless.setdefault((tuple(topics), instead), []).append(joint)

    def effort_lines(self) -> Iterator[str]:
        """Yield a line for each thing about the efforts that was decided."""
        for (topics, instead), joints in self._numberless.items():
            taken = f"those of {instead} are taken" if instead else "nothing else has any"
            if instead.startswith(MEASURED):
                taken = f"those that {' and '.join(self.choice.states)} measured are read"
            names = listed_names(joints, _MOST_NAMES)
            yield (
                f"the efforts of {names} on {' and '.join(topics)} are not a number throughout: "
                f"{taken}"
            )
        for (taken, left, is_left_out), found in self._contradictions.items():
            names = listed_names(list(found), _MOST_NAMES)
            how = f"{left} is left out" if is_left_out else f"{left} counts where that has none"
            yield (
                f"{taken} and {left} have unlike efforts of {names} at the same time (by up to "
                f"{max(found.values()):.3g}): {taken} is taken, {how} (--commands TOPIC or "
                "--command-topic JOINT=TOPIC[INDEX] names one)"
            )

    def refuse(self, topic: str, place: int, reason: str) -> None:
        """Note a trajectory that no controller takes."""
        self._refused.setdefault(topic, {})[place] = reason

    def unwrap(self, joint: str, turns: int, kind: str | None) -> None:
        """Note positions that jumped by a turn though nobody says that the joint turns so."""
        self._turned.setdefault(kind, {})[joint] = turns

    def unwrap_reference(self, topic: str, joint: str, turns: int, kind: str | None) -> None:
        """Note a reference that jumped by a turn where the joint did not."""
        self._turned_references.setdefault((topic, kind), {})[joint] = turns

    def turn_lines(self) -> Iterator[str]:
        """Yield a line for joints whose positions were unwrapped by what they look like alone."""
        for kind, joints in self._turned.items():
            yield (
                "positions jump by a turn, as of a driver that reports one turn alone: "
                f"{_turns_of(joints, kind)}"
            )
        for (topic, kind), joints in self._turned_references.items():
            yield (
                f"references on {topic} jump by a turn where the positions do not: "
                f"{_turns_of(joints, kind)}"
            )

    def reference_lines(self) -> Iterator[str]:
        """Yield a line for each thing about the references that was decided."""
        for topic, reasons in self._refused.items():
            those = "1 trajectory" if len(reasons) == 1 else f"{len(reasons)} trajectories"
            first = next(iter(reasons.values()))
            yield f"{those} on {topic} left out, as controllers refuse them: {first}"
        for topic, joints in self._foreign.items():
            yield (
                f"{topic} reports no positions of {', '.join(joints)}: its feedback is something "
                "else than joint_states say: not taken as the reference"
            )
        for topic, unlike in self._unlike.items():
            yield (
                f"{topic} reports other positions of {listed_names(list(unlike), 3)} than "
                f"{' and '.join(self.choice.states)} has {_by_up_to(unlike)}: the error is "
                "against the states"
            )
        for (taken, left, is_mixed), found in self._disagreements.items():
            how = "each where the joint follows it" if is_mixed else f"the joint follows {taken}"
            yield f"{taken} and {left} have unlike references of {_farthest(found)}: {how}"
        for (report, asked), found in self._overruled.items():
            yield (
                f"{report} reports another reference than {asked} asks for, of "
                f"{_farthest(found)}: what the controller reports is taken"
            )

    def quality(self, samples: Ordered, origin_ns: int) -> StampQuality:
        """Return what the stamps of samples say; joints that share them are looked at once."""
        stamps_ns = samples.stamps_ns
        for known, of, found in self._qualities:
            if known is stamps_ns and of == origin_ns:
                return replace(
                    found,
                    repeated=samples.repeated,
                    out_of_order=samples.out_of_order,
                    not_finite=samples.not_finite,
                )
        found = samples.quality(origin_ns)
        self._qualities = [(stamps_ns, origin_ns, found), *self._qualities[:1]]
        return found

    def commanded(self) -> tuple[set[str], dict[str, list[str]]]:
        """Return joints with commanded efforts, and those whose efforts are no numbers.

        The latter with the topics of these.
        """
        commanded: set[str] = set()
        numberless: dict[str, list[str]] = {}
        for topic, stream in (*self.floats.items(), *self.commands.items()):
            for joint in stream.joints():
                if stream.has_numbers(joint):
                    commanded.add(joint)
                else:
                    numberless.setdefault(joint, []).append(topic)
        return commanded, {k: numberless[k] for k in sorted(numberless) if k not in commanded}

    def resolve_senders(self, wanted: str | None) -> None:
        """Keep one sender of each joint, the wanted one or the one that goes on, and say so.

        Raises:
            SettingError: No sender of any joint is the wanted one.
        """
        found: list[tuple[str, Senders]] = []
        for topic, stream in self.states.items():
            measured = self.commands if self.choice.is_measured else self.measured
            efforts = measured.get(topic)
            for joints, logged in stream.shared():
                layouts, senders = _set_right(logged), None
                if len(layouts) > 1 or _may_be_several(stream, joints, layouts[0]):
                    senders = find_senders(_parts(stream, efforts, joints, layouts), wanted)
                if senders is None:
                    self.notes.extend(_doubt_lines(topic, stream, efforts, joints))
                    continue
                found.append((_senders_line(topic, "states", joints, senders), senders))
                for each in (stream,) if efforts is None else (stream, efforts):
                    for joint in joints:
                        each.leave_out(joint, senders.left_out)
        for topic, stream in self.commands.items():
            if self.choice.is_measured or topic in self.reports:
                continue
            for joints, logged in stream.shared():
                layouts = _set_right(logged)
                if not any(_has_two_efforts(stream.peek(joint)) for joint in joints):
                    continue
                senders = find_senders(_parts(None, stream, joints, layouts), wanted)
                if senders is None:
                    continue
                found.append((_senders_line(topic, "efforts", joints, senders), senders))
                for joint in joints:
                    stream.leave_out(joint, senders.left_out)
        lines = [line for line, _ in found]
        self.notes.extend(lines)
        if wanted is not None and not any(senders.is_wanted for _, senders in found):
            raise SettingError(
                f"no sender is {wanted!r}: "
                + ("; ".join(lines) or "each joint has one sender, by what can be seen")
            )

    def resolve_clock(self, clock: str) -> str:
        """Return the clock to read with, the receive times where stamps are those made coarse."""
        if clock != "header":
            return clock
        for topic, stream in self.states.items():
            for joints, layouts in stream.shared():
                if len(layouts) == 1 and (np.diff(layouts[0][1][0]) > 0).all():
                    continue
                step, is_receive = _coarse(filter(None, map(stream.peek, joints)))
                if not step:
                    continue
                line = (
                    f"the stamps of {topic} come in steps of {step / NANOSECONDS:.3g} s, and "
                    "several states of one sender share each: "
                )
                if is_receive:
                    self.notes.append(f"{line}receive times are taken (as with --clock receive)")
                    return "receive"
                self.notes.append(f"{line}the last one stands (--clock receive takes all)")
                return clock
        return clock

    def known_joints(self) -> list[str]:
        """Return the joints that states name, in their order."""
        return list(dict.fromkeys(name for each in self.states.values() for name in each.names))

    def topic_of_states(self, joint: str) -> str:
        """Return the topic of a joint's states; empty if there is none."""
        return next((topic for topic, stream in self.states.items() if stream.has(joint)), "")

    def take_states(self, joint: str) -> JointSamples | None:
        """Return one joint's positions and forget them; None if there are none."""
        topics = [topic for topic, stream in self.states.items() if stream.has(joint)]
        if len(topics) > 1:
            raise SeriesError(
                f"joint {joint!r}: its states are on {' and on '.join(topics)}, but must be on "
                f"one of the topics (--states)"
            )
        return self.states[topics[0]].take(joint) if topics else None

    def concerned_joints(self) -> set[str]:
        """Return those that are commanded or have a reference, known or not."""
        concerned: set[str] = set()
        commands = {} if self.choice.is_measured else self.commands
        for topic, stream in (*commands.items(), *self.sampled.items()):
            is_beside = topic in self.choice.beside and topic not in self.sampled
            concerned.update(stream.joints() if is_beside else stream.names)
        for stream in (*self.floats.values(), *self.setpoints.values()):
            concerned.update(stream.joints())
        for _, _, _, arrays in self.trajectories:
            concerned.update(arrays.names)
        return concerned
