"""The controllers that ran while a bag was recorded: their parameters as they began."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from hpid_ros.bags.columns.storage import Storage
from hpid_ros.bags.metadata import PARAMETERS
from hpid_ros.bags.parameter_events import parameter_changes
from hpid_ros.bags.run.topics import is_below
from hpid_ros.base.errors import BagError, SettingError
from hpid_ros.base.names import ALLOW_RELAY, node_sections
from hpid_ros.base.resources import find_resource
from hpid_ros.control import LoopSettings
from hpid_ros.control.settings.robot_limits import RobotLimits
from hpid_ros.documents.yaml_files import load_yaml, parse_yaml
from hpid_ros.robot.description import RobotDescription
from hpid_ros.tuning.controller_files import settings_from_parameters

if TYPE_CHECKING:  # Pinocchio takes a moment to import, and most controllers have no model
    from hpid_ros.compensation.build import LoopModel


class Controller(NamedTuple):
    """A joint's controller as it began."""

    node: str  # its name, without a namespace
    settings: LoopSettings  # its settings, within the robot's limits
    limits: RobotLimits  # what the robot allows the joint
    robot: str  # the robot's description: XML text or a path, empty for none
    allows_relay: bool  # whether it obeys ~/relay

    def model(self) -> LoopModel | None:
        """Return the model that its settings ask for; None for none."""
        if not self.settings.model.is_on:
            return None
        from hpid_ros.compensation.build import loop_model

        return loop_model(self.settings, self.robot)

    def changed(self, values: Mapping[str, Any], settings: LoopSettings) -> LoopSettings:
        """Return settings after a change, as the controller makes them."""
        changed = LoopSettings.from_parameters({**settings.to_parameters(), **values})
        return _in_force(changed, self.limits, self.robot)


def controllers_of(document: object, where: str, namespace: str = "") -> dict[str, Controller]:
    """Return the controllers of a ROS parameter file's content, by joint."""
    sections = {
        name.rpartition("/")[2]: own
        for name, own in node_sections(document if isinstance(document, Mapping) else {}).items()
    }
    everywhere = sections.get("**", {})
    controllers: dict[str, Controller] = {}
    names: dict[str, str] = {}
    for name, settings in settings_from_parameters(document, where).items():
        node = name.rpartition("/")[2]
        if name.startswith("/") and "*" not in name and not is_below(name, namespace):
            continue
        own = {**everywhere, **sections.get(node, {})}
        robot = str(own.get("robot_description", ""))
        limits = _limits(robot, settings.joint)
        settings = _in_force(settings, limits, robot)
        if settings.joint in controllers:
            raise SettingError(
                f"{where} has two controllers of {settings.joint!r}: {names[settings.joint]} and "
                f"{name}; give a parameter file with the one that drove it (--params FILE)"
            )
        names[settings.joint] = name
        controllers[settings.joint] = Controller(
            node, settings, limits, robot, own.get(ALLOW_RELAY, False) is True
        )
    if not controllers:
        raise SettingError(f"{where} has no joint controller below namespace {namespace}")
    return controllers


def _in_force(settings: LoopSettings, limits: RobotLimits, robot: str) -> LoopSettings:
    """Return settings as a controller puts them in force."""
    settings = limits.within(settings)
    if not settings.model.is_on:
        return settings
    from hpid_ros.compensation.build import with_inertia

    return with_inertia(settings, robot)


def _limits(robot: str, joint: str) -> RobotLimits:
    if not robot:
        return RobotLimits()
    source = robot if robot.lstrip().startswith("<") else str(find_resource(robot))
    (found,) = RobotDescription.load(source).select([joint])
    return RobotLimits.of(found)


def recorded_controllers(path: Path, parameters: Path | None = None) -> dict[str, Controller]:
    """Return the controllers that ran while a bag was recorded, as they began, by joint."""
    with Storage(path) as bag:
        return controllers_in(bag, parameters)


def controllers_in(
    bag: Storage, parameters: Path | None, namespace: str = ""
) -> dict[str, Controller]:
    """Return the same of a bag that is open, and of a namespace."""
    if parameters is not None:
        document = load_yaml(parameters, SettingError)
        return controllers_of(document, str(parameters), namespace)
    where = f"bag {bag.path}"
    text = bag.custom_data.get(PARAMETERS)
    if text is not None:
        where = f"{where}: {PARAMETERS}"
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
    for told in parameter_changes(bag):
        declared.setdefault(told.node, {}).update(told.declared)
    return {
        node: {
            "ros__parameters": {name: value for name, value in own.items() if value is not None}
        }
        for node, own in declared.items()
        if own.get("joint") and own.get("law")  # another's node may have a joint, too
    }
