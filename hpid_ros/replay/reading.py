"""From a bag and its controllers' parameters to what is computed anew, joint by joint."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import yaml

from hpid_ros.bags.columns.batches import TopicBatch
from hpid_ros.bags.columns.storage import Storage
from hpid_ros.bags.message_types import JOINT_STATE
from hpid_ros.bags.metadata import PARAMETERS, recorded_slides
from hpid_ros.bags.parameter_events import PARAMETER_EVENTS, parameter_changes, read_event
from hpid_ros.bags.run.recording import decoded_trajectory
from hpid_ros.bags.run.topics import TopicChoice, choose_topics
from hpid_ros.bags.selection import BagSelection
from hpid_ros.base.errors import BagError, HpidError, MessageError, SettingError, unknown_name
from hpid_ros.base.names import node_sections
from hpid_ros.base.resources import find_resource
from hpid_ros.control import LOOP_PARAMETERS, JointLoop, LoopSettings
from hpid_ros.control.limited_law import ModelTerm
from hpid_ros.control.reference import Setpoint
from hpid_ros.control.settings.robot_limits import RobotLimits
from hpid_ros.documents.yaml_files import load_yaml
from hpid_ros.replay.record import (
    Answer,
    Instruction,
    JointRecord,
    RecordedCommand,
    RecordedState,
)
from hpid_ros.robot.description import RobotDescription
from hpid_ros.tuning.controller_files import settings_from_parameters
from hpid_ros.wire import EffortReader, JointReader, JointSample, RobotReader, decode_float64
from hpid_ros.wire.parameter_events import ParameterEvent

if TYPE_CHECKING:  # Pinocchio takes a moment to import, and most controllers have no model
    from hpid_ros.compensation.build import LoopModel


class Controller(NamedTuple):
    """A joint's controller as it began.

    Attributes:
        node: Its name, without a namespace.
        settings: Its settings, within the robot's limits.
        limits: What the robot allows the joint.
        robot: The robot's description: XML text or a path, empty for none.
    """

    node: str
    settings: LoopSettings
    limits: RobotLimits
    robot: str


def controllers_of(document: object, where: str) -> dict[str, Controller]:
    """Return the controllers of a ROS parameter file's content, by joint.

    Args:
        document: The content.
        where: What errors call it.

    Raises:
        HpidError: It has none, or one that cannot be used.
    """
    robots = {
        name.rpartition("/")[2]: str(own.get("robot_description", ""))
        for name, own in node_sections(document if isinstance(document, Mapping) else {}).items()
    }
    controllers = {}
    for name, settings in settings_from_parameters(document, where).items():
        node = name.rpartition("/")[2]
        robot = robots.get(node, "") or robots.get("**", "")
        limits = _limits(robot, settings.joint)
        settings = _in_force(settings, limits, robot)
        controllers[settings.joint] = Controller(node, settings, limits, robot)
    return controllers


def _in_force(settings: LoopSettings, limits: RobotLimits, robot: str) -> LoopSettings:
    """Return settings as a controller puts them in force."""
    settings = limits.within(settings)
    if not settings.model.is_on:
        return settings
    from hpid_ros.compensation.build import with_inertia

    return with_inertia(settings, robot)


def _model(controller: Controller) -> LoopModel | None:
    if not controller.settings.model.is_on:
        return None
    from hpid_ros.compensation.build import loop_model

    return loop_model(controller.settings, controller.robot)


def _limits(robot: str, joint: str) -> RobotLimits:
    if not robot:
        return RobotLimits()
    source = robot if robot.lstrip().startswith("<") else str(find_resource(robot))
    (found,) = RobotDescription.load(source).select([joint])
    return RobotLimits.of(found)


@dataclass
class _Joint:
    """What is collected of a joint while its bag is read."""

    controller: Controller
    reader: JointReader
    model: LoopModel | None
    states: list[RecordedState] = field(default_factory=list)
    commands: list[RecordedCommand] = field(default_factory=list)
    instructions: list[Instruction] = field(default_factory=list)


def read_records(
    path: Path,
    parameters: Path | None = None,
    joints: Sequence[str] | None = None,
    selection: BagSelection | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[list[JointRecord], list[str]]:
    """Read what is to be computed anew.

    Args:
        path: The bag.
        parameters: The controllers' parameters as they began; those that the bag holds if None.
        joints: Only these; all that the parameters name and the bag commands if None.
        selection: Topics; found by name and type if not given.
        progress: Takes the share of the bag that has been read, in [0, 1].

    Returns:
        The joints, and what could not be read, a line each.

    Raises:
        HpidError: The bag cannot be read, or lacks states, commands with stamps or parameters.
    """
    with Storage(path) as bag:
        where = f"bag {path}"
        types = {name: info.type for name, info in bag.topics().items()}
        choice = choose_topics(where, types, selection or BagSelection())
        commands = [name for name in choice.commands if types[name] == JOINT_STATE]
        if choice.is_measured or not commands:
            raise BagError(
                f"{where}: no topic of stamped commands (sensor_msgs/msg/JointState), which tell "
                "the state that they answer; topics: " + ", ".join(sorted(types))
            )
        controllers = _controllers(bag, parameters)
        wanted = list(controllers) if joints is None else list(joints)
        for joint in wanted:
            if joint not in controllers:
                raise SettingError(unknown_name("joint", joint, controllers))
        collected = _Collector(
            choice,
            commands,
            types,
            [controllers[each] for each in wanted],
            recorded_slides(bag.custom_data),
        )
        for batch in bag.batches(collected.topics, progress):
            collected.take(batch)
        unreadable = list(bag.unreadable)
    records = list(collected.records(is_asked_for=joints is not None))
    if not records:
        raise BagError(
            f"{where}: no command for {', '.join(wanted)}; commanded: "
            f"{', '.join(sorted(collected.commanded)) or 'nothing'}"
        )
    return records, [*unreadable, *collected.notes]


def recorded_controllers(path: Path, parameters: Path | None = None) -> dict[str, Controller]:
    """Return the controllers that ran while a bag was recorded, as they began, by joint.

    Args:
        path: The bag.
        parameters: A file that says them; what the bag holds if None.

    Raises:
        HpidError: Neither says them, or there is one that cannot be used.
    """
    with Storage(path) as bag:
        return _controllers(bag, parameters)


def _controllers(bag: Storage, parameters: Path | None) -> dict[str, Controller]:
    if parameters is not None:
        return controllers_of(load_yaml(parameters, SettingError), str(parameters))
    where = f"bag {bag.path}"
    text = bag.custom_data.get(PARAMETERS)
    if text is not None:
        try:
            return controllers_of(yaml.safe_load(text), f"{where}: {PARAMETERS}")
        except yaml.YAMLError as error:
            raise BagError(f"{where}: {PARAMETERS} is no YAML: {error}") from error
    document = _declared(bag)
    if document:
        return controllers_of(document, f"{where}: /parameter_events")
    raise SettingError(
        f"{where} does not hold its controllers' parameters: give them with --params FILE, a "
        "parameter file as ros2 param dump writes it, or record with bag_recorder and its "
        "parameter controllers_file"
    )


def _declared(bag: Storage) -> dict[str, Any]:
    """Return the parameters that controllers declared while the bag was recorded."""
    declared: dict[str, dict[str, Any]] = {}
    for told in parameter_changes(bag):
        declared.setdefault(told.node, {}).update(told.declared)
    return {
        node: {
            "ros__parameters": {name: value for name, value in own.items() if value is not None}
        }
        for node, own in declared.items()
        if own.get("joint")
    }


class _Collector:
    """Takes the messages of a bag, topic by topic.

    Attributes:
        topics: Those that are read.
        commanded: Joints that any command names.
        notes: What was left out, a line each.
    """

    def __init__(
        self,
        choice: TopicChoice,
        commands: Sequence[str],
        types: Mapping[str, str],
        controllers: Sequence[Controller],
        slides: frozenset[str],
    ) -> None:
        self._slides = slides
        self._joints = {
            each.settings.joint: _Joint(each, JointReader(each.settings.joint), _model(each))
            for each in controllers
        }
        self._robots = {
            joint: RobotReader(each.model.compensator.states.joints)
            for joint, each in self._joints.items()
            if each.model is not None
        }
        self._efforts = EffortReader()
        setpoints = {topic: joint for joint, topic in choice.references.setpoint.items()}
        self._takes: dict[str, Callable[[TopicBatch], None]] = {}
        self._takes |= dict.fromkeys(choice.states, self._take_states)
        self._takes |= dict.fromkeys(commands, self._take_commands)
        self._takes |= dict.fromkeys(choice.references.trajectory, self._take_trajectories)
        self._takes |= {
            topic: partial(self._take_setpoints, joint)
            for topic, joint in setpoints.items()
            if joint in self._joints
        }
        events = [name for name, kind in types.items() if kind == PARAMETER_EVENTS]
        self._takes |= dict.fromkeys(events, self._take_events)
        self.topics = frozenset(self._takes)
        self.commanded: set[str] = set()
        self._notes: dict[str, None] = {}

    @property
    def notes(self) -> list[str]:
        """What was left out, a line each."""
        return list(self._notes)

    def take(self, batch: TopicBatch) -> None:
        """Take messages of one topic."""
        self._takes[batch.topic](batch)

    def records(self, *, is_asked_for: bool) -> Iterator[JointRecord]:
        """Yield what was recorded of each joint; of those without commands only if asked for."""
        begins = [each.states[0].stamp_ns for each in self._joints.values() if each.states]
        for each in self._joints.values():
            if not (each.states and each.commands) and not is_asked_for:
                continue
            yield JointRecord(
                each.controller.settings,
                sorted(each.states, key=_place),
                sorted(each.commands, key=_place),
                sorted(each.instructions, key=_place),
                min(begins, default=0),
                self._is_slide(each.controller),
            )

    def _is_slide(self, controller: Controller) -> bool:
        return controller.limits.is_slide or controller.settings.joint in self._slides

    def _take_states(self, batch: TopicBatch) -> None:
        log_times, places = batch.log_times_ns.tolist(), batch.places.tolist()
        for index, (log_time_ns, place) in enumerate(zip(log_times, places, strict=True)):
            raw = batch.raw(index)
            for name, joint in self._joints.items():
                try:
                    sample = joint.reader.read(raw)
                except MessageError as error:
                    self._notes[f"a state was left out, as the controller does: {error}"] = None
                    continue
                if sample is not None:
                    answer = self._answer(name, joint, sample, raw)
                    joint.states.append(RecordedState(log_time_ns, place, sample.stamp_ns, answer))

    def _answer(self, name: str, joint: _Joint, sample: JointSample, raw: bytes) -> Answer:
        if joint.model is None:
            return partial(_step, sample)
        return _ModelAnswer(joint.model, self._robots[name], sample, raw)

    def _take_commands(self, batch: TopicBatch) -> None:
        for index, place in enumerate(batch.places.tolist()):
            try:
                stamp_ns, names, efforts = self._efforts.read(batch.raw(index))
            except MessageError as error:
                self._notes[f"a command was left out: {error}"] = None
                continue
            for name, effort in zip(names, efforts, strict=True):
                self.commanded.add(name)
                if name in self._joints:
                    command = RecordedCommand(place, stamp_ns, effort, self._efforts.sender)
                    self._joints[name].commands.append(command)

    def _take_trajectories(self, batch: TopicBatch) -> None:
        for index, place in enumerate(batch.places.tolist()):
            log_time_ns = int(batch.log_times_ns[index])
            try:
                places, column = decoded_trajectory(batch.raw(index))
            except HpidError as error:
                self._notes[f"a trajectory was left out, as controllers refuse it: {error}"] = None
                continue
            for name, joint in self._joints.items():
                if name in places:
                    try:
                        motion = column(name, places[name])
                    except HpidError as error:
                        self._notes[f"a trajectory was left out: {error}"] = None
                        continue
                    joint.instructions.append(
                        Instruction(log_time_ns, place, motion, "a trajectory")
                    )

    def _take_setpoints(self, name: str, batch: TopicBatch) -> None:
        for index, place in enumerate(batch.places.tolist()):
            try:
                motion = Setpoint(decode_float64(batch.raw(index)))
            except HpidError as error:
                self._notes[f"a setpoint was left out, as controllers refuse it: {error}"] = None
                continue
            self._joints[name].instructions.append(
                Instruction(int(batch.log_times_ns[index]), place, motion, "a setpoint")
            )

    def _take_events(self, batch: TopicBatch) -> None:
        for index, place in enumerate(batch.places.tolist()):
            told = read_event(batch.raw(index))
            if told is not None:
                self._take_change(int(batch.log_times_ns[index]), place, told)

    def _take_change(self, log_time_ns: int, place: int, told: ParameterEvent) -> None:
        node, _, changed = told
        values = {name: value for name, value in changed.items() if name in LOOP_PARAMETERS}
        for joint in self._joints.values():
            if values and node.rpartition("/")[2] == joint.controller.node:
                text = ", ".join(f"{name} = {value}" for name, value in values.items())
                change = partial(_changed, joint.controller, values)
                joint.instructions.append(Instruction(log_time_ns, place, change, text))


def _place(each: RecordedState | RecordedCommand | Instruction) -> int:
    return each.place


def _step(sample: JointSample, loop: JointLoop) -> float:
    return loop.step(*sample)


class _ModelAnswer:
    """Answers a state with the model's term, which is computed once for all branches."""

    def __init__(
        self, model: LoopModel, reader: RobotReader, sample: JointSample, raw: bytes
    ) -> None:
        self._model, self._reader, self._sample, self._raw = model, reader, sample, raw
        self._term: ModelTerm | None = None
        self._is_computed = False

    def __call__(self, loop: JointLoop) -> float:
        compensator, stamp_ns = self._model.compensator, self._sample.stamp_ns
        if not self._is_computed:
            try:
                self._term = compensator.term(stamp_ns, *self._reader.read(self._raw))
            except MessageError as error:
                self._term = compensator.hold(stamp_ns, str(error))
            self._is_computed = True
        return compensator.answer(loop, *self._sample, self._term)


def _changed(
    controller: Controller, values: Mapping[str, Any], settings: LoopSettings
) -> LoopSettings:
    """Return the settings after a change, as the controller makes them."""
    changed = LoopSettings.from_parameters({**settings.to_parameters(), **values})
    return _in_force(changed, controller.limits, controller.robot)
