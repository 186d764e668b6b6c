"""A URDF as a frozen record of its moving joints and its links."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from xml.etree import ElementTree

from hpid_ros.errors import RobotDescriptionError, unknown_name
from hpid_ros.robot.joints import JointDescription, read_joint, read_rotors


@dataclass(frozen=True)
class RobotDescription:
    """A robot as its URDF describes it.

    Attributes:
        name: Name of the robot.
        xml: The URDF's text.
        joints: Moving joints by name, in the order of the file.
        links: Names of all links, in the order of the file.
        root: Name of the link that hangs on no joint.
        folder: Folder of the file, for meshes with relative paths; None when it came as text.
    """

    name: str
    xml: str
    joints: Mapping[str, JointDescription]
    links: tuple[str, ...]
    root: str
    folder: Path | None = None

    @property
    def last_link(self) -> str:
        """Name of the last link in the file: of an arm, as a rule, its tip."""
        return self.links[-1]

    @classmethod
    def load(cls, source: str | Path) -> RobotDescription:
        """Read a URDF.

        Args:
            source: Path of the file, or the XML text itself (what a ``robot_description``
                parameter holds): text that starts with ``<`` is XML.

        Returns:
            The description.

        Raises:
            RobotDescriptionError: The file is missing, or is not a URDF that can be read.
        """
        if isinstance(source, str) and source.lstrip().startswith("<"):
            return _parse(source.lstrip(), "robot description", None)
        path = Path(source)
        try:
            text = path.read_text(encoding="utf-8")
        except FileNotFoundError:
            raise RobotDescriptionError(f"robot description {path} does not exist") from None
        except (OSError, ValueError) as error:
            raise RobotDescriptionError(f"robot description {path}: {error}") from error
        return _parse(text.lstrip("\ufeff \t\r\n"), str(path), path.resolve().parent)

    def select(self, names: Iterable[str]) -> tuple[JointDescription, ...]:
        """Return the joints of the given names, in their order.

        Raises:
            RobotDescriptionError: The robot has no moving joint of that name, or a name is
                given twice.
        """
        wanted = tuple(names)
        for index, name in enumerate(wanted):
            if name not in self.joints:
                raise RobotDescriptionError(unknown_name("joint", name, self.joints))
            if name in wanted[:index]:
                raise RobotDescriptionError(f"joint {name!r} is given twice")
        return tuple(self.joints[name] for name in wanted)

    def link(self, name: str) -> str:
        """Return the name of a link that exists.

        Raises:
            RobotDescriptionError: The robot has no such link.
        """
        if name not in self.links:
            raise RobotDescriptionError(unknown_name("link", name, self.links))
        return name


def _parse(xml: str, origin: str, folder: Path | None) -> RobotDescription:
    """Parse URDF text; ``origin`` names it in messages."""
    try:
        root = ElementTree.fromstring(xml)
    except (ElementTree.ParseError, ValueError) as error:
        raise RobotDescriptionError(f"{origin} is not readable XML: {error}") from error
    if root.tag != "robot":
        raise RobotDescriptionError(
            f"{origin} is not a URDF: its root is <{root.tag}>, not <robot>"
        )
    rotors = read_rotors(root, origin)
    joints: dict[str, JointDescription] = {}
    for element in root.findall("joint"):
        joint = read_joint(element, rotors, origin)
        if joint is None:
            continue
        if joint.name in joints:
            raise RobotDescriptionError(f"{origin} has two joints of the name {joint.name!r}")
        joints[joint.name] = joint
    links = tuple(link.get("name", "") for link in root.findall("link"))
    return RobotDescription(
        root.get("name", ""),
        xml,
        MappingProxyType(joints),
        links,
        _root_link(root, links, origin),
        folder,
    )


def _root_link(robot: ElementTree.Element, links: tuple[str, ...], origin: str) -> str:
    """Return the one link that is no joint's child."""
    children = {child.get("link") for child in robot.findall("joint/child")}
    roots = [link for link in links if link not in children]
    if len(roots) != 1:
        raise RobotDescriptionError(
            f"{origin} must have one root link, not {len(roots)}: {', '.join(roots) or 'none'}"
        )
    return roots[0]
