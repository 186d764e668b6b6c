"""From a bag and its controllers' parameters to the records that are computed again."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from hpid_bench.tuning.replay import (
    AskedReference,
    Instruction,
    LoopAnswer,
    RecordedCommand,
    RecordedLoop,
    RecordedState,
    driven,
    following,
    retuned,
)
from hpid_ros.base.errors import BagError, HpidError, MessageError, SettingError
from hpid_ros.base.names import ALLOW_RELAY, NamePatterns, node_sections
from hpid_ros.base.yaml_files import load_yaml, parse_yaml
from hpid_ros.control.joint_loop import JointLoop
from hpid_ros.control.model import ModelTerm
from hpid_ros.control.overrides import RelayRequest
from hpid_ros.control.parameter_files import settings_from_parameters
from hpid_ros.control.reference import Setpoint
from hpid_ros.control.settings import LOOP_PARAMETERS, LoopSettings, Value
from hpid_ros.messages.columns import JOINT_STATE, TopicBatch
from hpid_ros.messages.joint_state import EffortReader, JointReader, JointSample, RobotReader
from hpid_ros.messages.joint_trajectory import decode_float64
from hpid_ros.messages.messages import PARAMETER_EVENTS, parameter_events, read_event
from hpid_ros.messages.metadata import CONTROLLERS_ENTRY, recorded_slides
from hpid_ros.messages.reading.recorded_run import decoded_trajectory
from hpid_ros.messages.reading.topic_choice import (
    TopicChoice,
    choose_topics,
    is_below,
    joint_of,
    last_part,
    namespace_of,
)
from hpid_ros.messages.reports import ParameterEvent, decode_numbers
from hpid_ros.messages.selection import BagSelection
from hpid_ros.messages.storage import Storage
from hpid_ros.robot.description import robot_limits
from hpid_ros.robot.joint_description import JointDescription
from hpid_ros.robot.loop_settings import loop_settings
from hpid_ros.robot.on_demand import loop_model

if TYPE_CHECKING:
    from hpid_ros.robot.compensation import LoopModel


class RecordedController(NamedTuple):
    """A joint's controller as it began."""

    node: str  # its name, without a namespace
    parameters: Mapping[str, Value]  # of its loop, as it was given them
    settings: LoopSettings  # what it made of them, within the robot's limits
    limits: JointDescription  # what the robot allows the joint
    robot: str  # the robot's description: XML text or a path, empty for none
    allows_relay: bool  # whether it obeys ~/relay

    def changed(self, values: Mapping[str, object]) -> LoopSettings:
        """Return what it makes of its parameters after all that was set until then."""
        return loop_settings({**self.parameters, **values}, self.limits, self.robot)


def controllers_of(
    document: object, where: str, namespace: str = ""
) -> dict[str, RecordedController]:
    """Return the controllers of a ROS parameter file's content, by joint."""
    sections = {
        name.rpartition("/")[2]: own
        for name, own in node_sections(document if isinstance(document, Mapping) else {}).items()
    }
    everywhere = sections.get("**", {})
    controllers: dict[str, RecordedController] = {}
    names: dict[str, str] = {}
    for name, settings in settings_from_parameters(document, where).items():
        node = name.rpartition("/")[2]
        if name.startswith("/") and "*" not in name and not is_below(name, namespace):
            continue
        own = {**everywhere, **sections.get(node, {})}
        robot = str(own.get("robot_description", ""))
        limits = robot_limits(robot, settings.joint)
        if settings.joint in controllers:
            raise SettingError(
                f"{where} has two controllers of {settings.joint!r}: {names[settings.joint]} and "
                f"{name}; give a parameter file with the one that drove it (--params FILE)"
            )
        names[settings.joint] = name
        parameters = settings.to_parameters()
        controllers[settings.joint] = RecordedController(
            node,
            parameters,
            loop_settings(parameters, limits, robot),
            limits,
            robot,
            own.get(ALLOW_RELAY, False) is True,
        )
    if not controllers:
        raise SettingError(f"{where} has no joint controller below namespace {namespace}")
    return controllers


def recorded_controllers(
    path: Path, parameters: Path | None = None
) -> dict[str, RecordedController]:
    """Return the controllers that ran while a bag was recorded, as they began, by joint."""
    with Storage(path) as bag:
        return _controllers_in(bag, parameters)


def _controllers_in(
    bag: Storage, parameters: Path | None, namespace: str = ""
) -> dict[str, RecordedController]:
    if parameters is not None:
        document = load_yaml(parameters, SettingError)
        return controllers_of(document, str(parameters), namespace)
    where = f"bag {bag.path}"
    text = bag.custom_data.get(CONTROLLERS_ENTRY)
    if text is not None:
        where = f"{where}: {CONTROLLERS_ENTRY}"
        return controllers_of(parse_yaml(where, str(text), BagError), where, namespace)
    document = _declared(bag)
    if document:
        return controllers_of(document, f"{where}: /parameter_events", namespace)
    raise SettingError(
        f"{where} does not hold its controllers' parameters: give them with --params FILE, a "
        "parameter file as ros2 param dump writes it, or record with bag_recorder and its "
        "parameter controllers_file"
    )


def _declared(bag: Storage) -> dict[str, Any]:
    """Return the parameters that controllers declared while the bag was recorded."""
    declared: dict[str, dict[str, Any]] = {}
    for _, event in parameter_events(bag):
        declared.setdefault(event.node, {}).update(event.declared)
    return {
        node: {
            "ros__parameters": {name: value for name, value in own.items() if value is not None}
        }
        for node, own in declared.items()
        if own.get("joint") and own.get("law")  # another's node may have a joint, too
    }


@dataclass
class _CollectedJoint:
    """What is collected of a joint while its bag is read."""

    controller: RecordedController
    reader: JointReader
    model: LoopModel | None
    states: list[RecordedState] = field(default_factory=list)
    asked: AskedReference = field(default_factory=lambda: AskedReference({}))
    motions: list[Instruction] = field(default_factory=list)
    commands: list[RecordedCommand] = field(default_factory=list)
    instructions: list[Instruction] = field(default_factory=list)
    changes: list[tuple[int, dict[str, object]]] = field(default_factory=list)
    """Where in the log parameters of the loop were set, and to what."""
    permissions: list[tuple[int, bool]] = field(default_factory=list)
    """Where in the log ``allow_relay`` was set, and to what."""

    def retunes(self) -> Iterator[Instruction]:
        """Yield each change, with the settings that the controller made of all until then."""
        values: dict[str, object] = {}
        for place, change in sorted(self.changes, key=lambda each: each[0]):
            values = {**values, **change}
            text = ", ".join(f"{name} = {value}" for name, value in change.items())
            settings = partial(self.controller.changed, values)
            yield Instruction(place, retuned(settings), text)

    def relay(self, place: int, request: RelayRequest | None, loop: JointLoop) -> None:
        """Do what a message on ``~/relay`` asks for, as the controller does."""
        before = (each for each in self.permissions if each[0] < place)
        _, is_allowed = max(before, default=(0, self.controller.allows_relay))
        if request is not None and not is_allowed:
            raise SettingError(f"relays are not allowed: {ALLOW_RELAY} is false")
        driven(request)(loop)


def read_records(
    path: Path,
    parameters: Path | None = None,
    joints: Sequence[str] | None = None,
    selection: BagSelection | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[list[RecordedLoop], list[str]]:
    """Read what is to be computed again."""
    with Storage(path) as bag:
        where = f"bag {path}"
        types = {name: info.type for name, info in bag.topics().items()}
        choice = choose_topics(where, types, selection or BagSelection())
        commands = [name for name in choice.commands if types[name] == JOINT_STATE]
        if choice.is_measured or not commands:
            raise BagError(
                f"{where}: no topic of stamped commands (sensor_msgs/msg/JointState), which tell "
                f"the state that they answer{_without_stamps(choice)}; topics: "
                + ", ".join(sorted(types))
            )
        asked = selection.namespace if selection is not None else None
        namespace = f"/{asked.strip('/')}" if asked else ""
        controllers = _controllers_in(bag, parameters, namespace)
        wanted = NamePatterns(joints or ()).chosen("joint", controllers, SettingError)
        collected = _Collector(
            choice,
            commands,
            types,
            [controllers[each] for each in wanted],
            recorded_slides(bag.custom_data),
            namespace,
        )
        for batch in bag.batches(collected.topics, progress):
            collected.take(batch)
        unreadable = list(bag.unreadable)
    records = list(collected.records(is_asked_for=joints is not None))
    if not records:
        commanded = ", ".join(sorted(collected.commanded)) or "nothing"
        if collected.notes:
            commanded += f" ({next(iter(collected.notes))})"
        raise BagError(f"{where}: no command for {', '.join(wanted)}; commanded: {commanded}")
    return records, [*unreadable, *collected.notes]


def _without_stamps(choice: TopicChoice) -> str:
    """Return which commands have no stamps, to be put behind what is missing."""
    topics = {*(each.topic for each in choice.command_topics.values()), *choice.in_doubt}
    return f" (those on {', '.join(sorted(topics))} have no stamps)" if topics else ""


class _Collector:
    """Takes the messages of a bag, topic by topic."""

    def __init__(
        self,
        choice: TopicChoice,
        commands: Sequence[str],
        types: Mapping[str, str],
        controllers: Sequence[RecordedController],
        slides: frozenset[str],
        namespace: str,
    ) -> None:
        self._slides, self._namespace = slides, namespace
        self._joints = {
            each.settings.joint: _CollectedJoint(
                each, JointReader(each.settings.joint), loop_model(each.settings, each.robot)
            )
            for each in controllers
        }
        self._robots = {
            joint: RobotReader(each.model.compensator.states.joints)
            for joint, each in self._joints.items()
            if each.model is not None
        }
        self._efforts = EffortReader()
        events = [name for name, kind in types.items() if kind == PARAMETER_EVENTS]
        self._takes: dict[str, Callable[[TopicBatch], None]] = {
            **dict.fromkeys(choice.states, self._take_states),
            **dict.fromkeys(commands, self._take_commands),
            **dict.fromkeys(choice.references.trajectory, self._take_trajectories),
            **dict.fromkeys(events, self._take_events),
        }
        own = dict.fromkeys(choice.references.setpoint.values(), self._take_setpoints)
        for topic, take in (own | dict.fromkeys(choice.relays, self._take_relays)).items():
            joint = self._joint_of_topic(topic)
            if joint is not None:
                self._takes[topic] = partial(take, joint)
        self.topics = frozenset(self._takes)
        self.commanded: set[str] = set()
        self.notes: dict[str, None] = {}  # what was left out, a line each, in order

    def take(self, batch: TopicBatch) -> None:
        self._takes[batch.topic](batch)

    def records(self, *, is_asked_for: bool) -> Iterator[RecordedLoop]:
        """Yield what was recorded of each joint; of those without commands only if asked for."""
        begins = [each.states[0].stamp_ns for each in self._joints.values() if each.states]
        for each in self._joints.values():
            if not (each.states and each.commands) and not is_asked_for:
                continue
            motions = [] if each.asked.samples else each.motions
            yield RecordedLoop(
                each.controller.settings,
                sorted(each.states, key=_place),
                sorted(each.commands, key=_place),
                sorted([*each.instructions, *each.retunes(), *motions], key=_place),
                min(begins, default=0),
                each.controller.limits.is_slide or each.controller.settings.joint in self._slides,
            )

    def _joint_of_topic(self, topic: str) -> _CollectedJoint | None:
        """Return the joint whose controller subscribes to a topic of its own."""
        node = last_part(namespace_of(topic))
        own = [each for each in self._joints.values() if each.controller.node == node]
        return own[0] if own else self._joints.get(joint_of(topic))

    def _take_states(self, batch: TopicBatch) -> None:
        for log_time_ns, place, raw in batch.messages():
            for name, joint in self._joints.items():
                try:
                    sample = joint.reader.read(raw)
                except MessageError as error:
                    self.notes[f"a state was left out, as the controller does: {error}"] = None
                    continue
                if sample is not None:
                    answer: LoopAnswer = partial(_step, sample, joint.asked)
                    if joint.model is not None:
                        answer = _ModelAnswer(joint.model, self._robots[name], sample, raw)
                    joint.states.append(RecordedState(log_time_ns, place, sample.stamp_ns, answer))

    def _take_commands(self, batch: TopicBatch) -> None:
        for _, place, raw in batch.messages():
            try:
                stamp_ns, names, efforts = self._efforts.read(raw)
            except MessageError as error:
                self.notes[f"a command was left out: {error}"] = None
                continue
            asked = self._efforts.asked
            for at, (name, effort) in enumerate(zip(names, efforts, strict=True)):
                self.commanded.add(name)
                if name in self._joints:
                    joint = self._joints[name]
                    command = RecordedCommand(place, stamp_ns, effort, self._efforts.sender)
                    joint.commands.append(command)
                    if asked is not None:
                        joint.asked.samples[stamp_ns] = asked[0][at], asked[1][at]

    def _take_trajectories(self, batch: TopicBatch) -> None:
        for _, place, raw in batch.messages():
            with self._leaving_out("a trajectory was left out, as controllers refuse it"):
                trajectory = decoded_trajectory(raw)
                for name in (each for each in self._joints if each in trajectory.names):
                    with self._leaving_out("a trajectory was left out"):
                        motion = Instruction(
                            place, following(trajectory.column(name)), "a trajectory"
                        )
                        self._joints[name].motions.append(motion)

    def _take_setpoints(self, joint: _CollectedJoint, batch: TopicBatch) -> None:
        for _, place, raw in batch.messages():
            with self._leaving_out("a setpoint was left out, as controllers refuse it"):
                motion = following(Setpoint(decode_float64(raw)))
                joint.motions.append(Instruction(place, motion, "a setpoint"))

    def _take_relays(self, joint: _CollectedJoint, batch: TopicBatch) -> None:
        for _, place, raw in batch.messages():
            with self._leaving_out("a relay was left out, as controllers refuse it"):
                request = RelayRequest.from_message(decode_numbers(raw))
                text = "the end of a relay" if request is None else "a relay"
                what = partial(joint.relay, place, request)
                joint.instructions.append(Instruction(place, what, text))

    @contextmanager
    def _leaving_out(self, what: str) -> Iterator[None]:
        try:
            yield
        except HpidError as error:
            self.notes[f"{what}: {error}"] = None

    def _take_events(self, batch: TopicBatch) -> None:
        for _, place, raw in batch.messages():
            event = read_event(raw)
            if event is not None and is_below(event.node, self._namespace):
                self._take_change(place, event)

    def _take_change(self, place: int, event: ParameterEvent) -> None:
        node, _, changed = event
        values = {name: value for name, value in changed.items() if name in LOOP_PARAMETERS}
        is_allowed = changed.get(ALLOW_RELAY)
        for joint in self._joints.values():
            if node.rpartition("/")[2] != joint.controller.node:
                continue
            if isinstance(is_allowed, bool):
                joint.permissions.append((place, is_allowed))
            if is_allowed is False:
                ended = Instruction(place, driven(None), f"{ALLOW_RELAY} = False")
                joint.instructions.append(ended)
            if values:
                joint.changes.append((place, dict(values)))


def _place(each: RecordedState | RecordedCommand | Instruction) -> int:
    return each.place


def _step(sample: JointSample, asked: AskedReference, loop: JointLoop) -> float:
    if asked.samples:
        if loop.following.motion is None:
            loop.follow(asked)
        if not asked.is_usable(sample.stamp_ns):
            return loop.reject(sample.stamp_ns, "the reference")
    return loop.step(*sample)


@dataclass
class _ModelAnswer:
    """Answers a state with the model's term, which is computed once for all branches."""

    model: LoopModel
    reader: RobotReader
    sample: JointSample
    raw: bytes
    term: ModelTerm | None = None
    is_computed: bool = False

    def __call__(self, loop: JointLoop) -> float:
        compensator, stamp_ns = self.model.compensator, self.sample.stamp_ns
        if not self.is_computed:
            try:
                self.term = compensator.term(stamp_ns, *self.reader.read(self.raw))
            except MessageError as error:
                self.term = compensator.hold(stamp_ns, str(error))
            self.is_computed = True
        return compensator.answer(loop, *self.sample, self.term)
