"""The record of a URDF: links, joints, limits, meshes.

Source: the URDF joint element (http://wiki.ros.org/urdf/XML/joint). Rotor inertia and gear ratio
are read from the transmissions in Drake's convention, ``drake:rotor_inertia`` and
``drake:gear_ratio`` of an ``actuator`` element.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple
from xml.etree import ElementTree

from hpid_ros.base.errors import RobotDescriptionError, unknown_name
from hpid_ros.base.resources import find_resource, is_file, package_folder, read_text
from hpid_ros.base.units import Numbers
from hpid_ros.robot.joint_description import UNLIMITED, JointDescription
from hpid_ros.robot.mending import (
    HELD_AT,
    MOVING_TYPES,
    Mend,
    is_impossible,
    mass_of,
    mend,
    moments_of,
)

_logger = logging.getLogger(__name__)

_FILE, _PACKAGE = "file://", "package://"
_BEFORE_XML = "\ufeff \t\r\n"  # editors write a byte order mark, launch files read it as text


def robot_source(source: str, folders: Sequence[Path] = ()) -> str | Path:
    """Return a URDF's text as it is, and where the file is that anything else names."""
    return source if source.lstrip(_BEFORE_XML).startswith("<") else find_resource(source, folders)


def find_mesh(filename: str, folder: Path | None) -> Path | None:
    """Return the file that a mesh element names.

    A ``package://name/path`` is looked for as ``path`` and as ``name/path`` in the URDF's folder
    and in those above it, which finds it in a source tree as in an install space, and then in
    the package of that name. Any other name is an absolute path or relative to the URDF.
    """
    for path in _places(filename, folder):
        if is_file(path):
            return path.absolute()
    return None


def mesh_places(filename: str, folder: Path | None) -> str:
    """Say where a mesh was looked for, for a message."""
    if filename.startswith(_PACKAGE):
        name = filename.removeprefix(_PACKAGE).partition("/")[0]
        known = package_folder(name)
        package = f"in package {name}" if known else f"there is no package {name}"
        return package if folder is None else f"{package}; not near {folder}"
    if folder is None and not Path(filename.removeprefix(_FILE)).is_absolute():
        return "relative to a URDF that came as text"
    return f"looked in {folder}" if folder else "looked there"


def _places(filename: str, folder: Path | None) -> Iterator[Path]:
    if not filename.startswith(_PACKAGE):
        plain = Path(filename.removeprefix(_FILE))
        if folder is not None or plain.is_absolute():
            yield plain if folder is None else folder / plain
        return
    plain_name = filename.removeprefix(_PACKAGE)
    name, _, below = plain_name.partition("/")
    if folder is not None:
        for base in (folder, *folder.parents):
            yield from (base / plain_name, base / below)
    package = package_folder(name)
    if package is not None:
        yield package / below


DRAKE_NAMESPACE = "http://drake.mit.edu"
ElementTree.register_namespace("drake", DRAKE_NAMESPACE)
UNDRIVABLE_TYPES = frozenset({"floating", "planar"})
OTHER_TYPES = UNDRIVABLE_TYPES | {"fixed"}
PAYLOAD_EDGE = 0.08  # [m] of a payload, a solid cube


class LinkPose(NamedTuple):
    """A link's frame in the frame of the robot's root link."""

    position: Numbers  # [m] origin x, y, z
    rotation: Numbers  # its axes as columns, a rotation matrix of shape (3, 3)


def read_joint(
    element: ElementTree.Element, rotors: Mapping[str, tuple[float, float]], origin: str
) -> JointDescription | None:
    name, joint_type = element.get("name", ""), element.get("type", "")
    if joint_type in OTHER_TYPES:
        return None
    where = f"{origin}, joint {name!r}"
    if not name or joint_type not in MOVING_TYPES:
        known = MOVING_TYPES | OTHER_TYPES
        raise RobotDescriptionError(f"{where}: {unknown_name('joint type', joint_type, known)}")
    limit, dynamics = element.find("limit"), element.find("dynamics")
    is_bounded = joint_type != "continuous"
    rotor_inertia, gear_ratio = rotors.get(name, (0.0, 1.0))
    return JointDescription(
        name=name,
        type=joint_type,
        axis=_axis(element, where),
        parent=_link(element, "parent", where),
        child=_link(element, "child", where),
        lower=_number(limit, "lower", -math.inf, where) if is_bounded else -math.inf,
        upper=_number(limit, "upper", math.inf, where) if is_bounded else math.inf,
        # 0 says none, as many write it: whoever drives the joint must say what it can give
        effort=_number(limit, "effort", math.inf, where, 0.0) or math.inf,
        velocity=_number(limit, "velocity", math.inf, where, 0.0) or math.inf,
        damping=_number(dynamics, "damping", 0.0, where, 0.0),
        friction=_number(dynamics, "friction", 0.0, where, 0.0),
        rotor_inertia=rotor_inertia,
        gear_ratio=gear_ratio,
        has_zero_effort=_number(limit, "effort", math.inf, where, 0.0) == 0.0,
    )


def read_rotors(root: ElementTree.Element, origin: str) -> dict[str, tuple[float, float]]:
    """Return rotor inertia in [kg m^2] and gear ratio by joint."""
    rotors = {}
    for transmission in root.findall("transmission"):
        joint, actuator = transmission.find("joint"), transmission.find("actuator")
        if joint is None or actuator is None:
            continue
        name = joint.get("name", "")
        where = f"{origin}, transmission of joint {name!r}"
        inertia = actuator.find(f"{{{DRAKE_NAMESPACE}}}rotor_inertia")
        ratio = actuator.find(f"{{{DRAKE_NAMESPACE}}}gear_ratio")
        pair = (_number(inertia, "value", 0.0, where), _number(ratio, "value", 1.0, where))
        if not (pair[0] >= 0.0 and pair[1] != 0.0):
            raise RobotDescriptionError(
                f"{where}: rotor inertia {pair[0]} and gear ratio {pair[1]};"
                " the inertia must be >= 0 and the ratio not 0"
            )
        rotors[name] = pair
    return rotors


def _number(
    element: ElementTree.Element | None,
    attribute: str,
    default: float,
    where: str,
    least: float = -math.inf,
) -> float:
    """Return a finite number of an element's attribute, or the default where it is absent."""
    text = None if element is None else element.get(attribute)
    if text is None:
        return default
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise RobotDescriptionError(f"{where}: {attribute}={text!r} is not a finite number")
    if value < least:
        raise RobotDescriptionError(f"{where}: {attribute}={text!r} must be >= {least:g}")
    return value


def _link(element: ElementTree.Element, tag: str, where: str) -> str:
    """Return the link that a parent or child element names."""
    name = end_of(element, tag)
    if not name:
        raise RobotDescriptionError(f"{where} has no <{tag} link=.../>")
    return name


def end_of(joint: ElementTree.Element, tag: str) -> str:
    """Return the link that a joint's parent or child element names; empty for none."""
    found = joint.find(tag)
    return "" if found is None else found.get("link", "")


def numbers_of(element: ElementTree.Element, attribute: str, default: str = "") -> list[float]:
    return [float(word) for word in (element.get(attribute) or default).split()]


def origin_of(element: ElementTree.Element) -> tuple[list[float], list[float]]:
    """Return xyz [m] and rpy [rad] of an element's origin."""
    origin = element.find("origin")
    if origin is None:
        return [0.0] * 3, [0.0] * 3
    return numbers_of(origin, "xyz", "0 0 0"), numbers_of(origin, "rpy", "0 0 0")


def _axis(element: ElementTree.Element, where: str) -> tuple[float, float, float]:
    """Return the joint's axis; the URDF's default is x."""
    found = element.find("axis")
    text = "1 0 0" if found is None else found.get("xyz", "1 0 0")
    try:
        x, y, z = (float(word) for word in text.split())
    except ValueError:
        x = y = z = math.nan
    if not math.isfinite(x + y + z) or x == y == z == 0.0:
        raise RobotDescriptionError(f"{where}: axis {text!r} is not a direction of three numbers")
    return x, y, z


class Contradiction(NamedTuple):
    """What no robot can be as it is described."""

    joints: tuple[str, ...]  # the joints that it is about; empty for a link
    text: str  # one line


def _contradictions(
    robot: ElementTree.Element, joints: Mapping[str, JointDescription]
) -> Iterator[Contradiction]:
    for name, joint in joints.items():
        if joint.lower > joint.upper:
            text = f"lower limit {joint.lower:g} is above its upper limit {joint.upper:g}"
            yield Contradiction((name,), f"joint {name!r}: its {text}: correct the URDF")
    for element in robot.findall("joint"):
        name, kind = element.get("name", ""), element.get("type")
        if kind in UNDRIVABLE_TYPES:
            out = f"make it fixed in the URDF, or hold it (robot.held: {{{name}: 0}})"
            free = " (a base is free without: fixed_base: false)" if kind == "floating" else ""
            yield Contradiction((), f"joint {name!r} is {kind}, which nothing drives: {out}{free}")
    yield from _mimic_contradictions(robot, joints)
    for link in robot.findall("link"):
        name = link.get("name", "")
        found = link.find("inertial/mass")
        if not 0.0 <= mass_of(link) < math.inf:
            text = "" if found is None else found.get("value", "0")
            yield Contradiction(
                (), f"link {name!r}: its mass {text!r} is no mass in kg, 0 or more"
            )
        elif link.find("inertial/inertia") is not None and moments_of(link) is None:
            out = "has six finite numbers: ixx ixy ixz iyy iyz izz"
            yield Contradiction((), f"link {name!r}: its inertia is no tensor, which {out}")
        elif is_impossible(link):
            text = "its inertia has a negative moment"
            out = f"correct the URDF, or say it in robot.links.{name}"
            yield Contradiction((), f"link {name!r}: {text}: {out}")


def _mimic_contradictions(
    robot: ElementTree.Element, joints: Mapping[str, JointDescription]
) -> Iterator[Contradiction]:
    """Yield joints that follow nothing, themselves, or each other in a circle."""
    known = {element.get("name", ""): element.find("mimic") for element in robot.findall("joint")}
    leader = {
        name: mimic.get("joint", "")
        for name, mimic in known.items()
        if mimic is not None and name in joints
    }
    lost = [name for name, other in leader.items() if other not in known]
    for number, name in enumerate(lost):
        other = leader[name]
        is_shown = number < _SHOWN  # to look for the nearest name takes as long as there are names
        found = unknown_name("joint", other, known) if is_shown else f"unknown joint {other!r}"
        yield Contradiction((name,), f"joint {name!r}: it mimics {found}")
    done = set(lost)
    for first in leader:
        row: dict[str, None] = {}  # of joints, each of which follows the next
        name = first
        while name in leader and name not in done and name not in row:
            row[name] = None
            name = leader[name]
        if name in row:
            circle = [*row][[*row].index(name) :]
            shown = " -> ".join([*circle[:_SHOWN], *(["..."] if circle[_SHOWN:] else []), name])
            text = f"joint {name!r}: it mimics itself: {shown}"
            yield Contradiction(tuple(circle), text)
        done.update(row)


LARGEST_FILE = 16 << 20
"""Bytes of a URDF; meshes are files of their own."""
MOST_JOINTS = 1000
"""Moving joints of a URDF; humanoids with hands have about a hundred."""
MOST_LINKS = 4000
"""Links of a URDF: libraries that build a robot look for each name among all others."""
_MOST_LEVELS = 32
"""Levels of elements; a URDF has six, and extensions few more."""
_LONGEST_CHAIN = 256
_PIECE = 1 << 16
_SHOWN = 5


@dataclass(frozen=True)
class RobotDescription:
    """A robot as its URDF describes it."""

    name: str  # name of the robot
    xml: str  # the URDF's text
    joints: Mapping[str, JointDescription]  # moving joints by name, in the order of the file
    links: tuple[str, ...]  # names of all links, in the order of the file
    root: str  # name of the link that hangs on no joint
    folder: Path | None = None  # folder of the file, for meshes with relative paths
    contradictions: tuple[Contradiction, ...] = ()  # what no robot can be
    held: Mapping[str, float] = field(default_factory=dict)  # joints that could move, and where
    mends: tuple[Mend, ...] = ()  # what was mended when it was loaded

    @property
    def slides(self) -> frozenset[str]:
        """Names of the joints that slide: their units are m and N."""
        return frozenset(name for name, joint in self.joints.items() if joint.is_slide)

    @property
    def kinds(self) -> dict[str, str]:
        """Types of the joints by name."""
        return {name: joint.type for name, joint in self.joints.items()}

    def start(self, given: Mapping[str, float]) -> dict[str, float]:
        """Return positions that were given, and the nearest of joints that cannot be at 0."""
        nearest = {name: min(max(0.0, j.lower), j.upper) for name, j in self.joints.items()}
        return {name: at for name, at in nearest.items() if at} | dict(given)

    def undriven(self, driven: Collection[str]) -> str:
        """Say which joints nobody drives, and what they do; empty where there are none."""
        free = tuple(name for name in self.joints if name not in driven)
        said = [f"held: {listed(tuple(self.held))}"] if self.held else []
        if free:
            said.append(
                f"free: {listed(free)}: nobody drives them, they move against their friction "
                "alone; robot.held holds them"
            )
        return "; ".join(said)

    @property
    def last_link(self) -> str:
        """Name of the last link in the file: of an arm, as a rule, its tip."""
        return self.links[-1]

    @classmethod
    def load(cls, source: str | Path) -> RobotDescription:
        if isinstance(source, str) and source.lstrip(_BEFORE_XML).startswith("<"):
            return _parse(source.lstrip(_BEFORE_XML), "robot description", None)
        path = Path(source)
        if not path.exists():
            raise RobotDescriptionError(f"robot description {path} does not exist")
        text = read_text(path, LARGEST_FILE, RobotDescriptionError)
        return _parse(text.lstrip(_BEFORE_XML), str(path), path.resolve().parent)

    def select(self, names: Iterable[str]) -> tuple[JointDescription, ...]:
        """Return the joints of the given names, in their order, as what uses them needs them."""
        found = self.named(names)
        wanted = {joint.name for joint in found}
        _refuse(each for each in self.contradictions if not wanted.isdisjoint(each.joints))
        return found

    def named(self, names: Iterable[str]) -> tuple[JointDescription, ...]:
        """Return the joints of the given names, whatever is said of them."""
        found: dict[str, JointDescription] = {}
        for name in names:
            if name in self.held:
                raise RobotDescriptionError(
                    f"joint {name!r} does not move: it is held at {self.held[name]:g}, by "
                    "robot.held, or because its limits in the URDF are the same number"
                )
            if name not in self.joints:
                raise RobotDescriptionError(unknown_name("joint", name, self.joints))
            if name in found:
                raise RobotDescriptionError(f"joint {name!r} is given twice")
            found[name] = self.joints[name]
        return tuple(found.values())

    def require_sound(self) -> None:
        """Refuse a description that contradicts itself, for what needs the whole robot."""
        _refuse(self.contradictions)

    def link(self, name: str) -> str:
        """Return the name of a link that exists."""
        if name not in self.links:
            raise RobotDescriptionError(unknown_name("link", name, self.links))
        return name


def _refuse(found: Iterable[Contradiction]) -> None:
    lines = [each.text for each in found]
    if lines:
        more = f"; and {len(lines) - _SHOWN} more" if len(lines) > _SHOWN else ""
        raise RobotDescriptionError("; ".join(lines[:_SHOWN]) + more)


def _parse(xml: str, origin: str, folder: Path | None) -> RobotDescription:
    """Parse URDF text; ``origin`` names it in messages."""
    root = _elements(xml, origin)
    if root.tag != "robot":
        raise RobotDescriptionError(
            f"{origin} is not a URDF: its root is <{root.tag}>, not <robot>"
        )
    _require_no_xacro(root, origin)
    mends, is_other = mend(root)
    for each in mends:
        _say(f"{origin}: {listed(each.names)}: {each.text}")
    if is_other:
        xml = ElementTree.tostring(root, encoding="unicode")
    rotors = read_rotors(root, origin)
    joints: dict[str, JointDescription] = {}
    for element in root.findall("joint"):
        joint = read_joint(element, rotors, origin)
        if joint is None:
            continue
        if joint.name in joints:
            raise RobotDescriptionError(f"{origin} has two joints of the name {joint.name!r}")
        joints[joint.name] = joint
        if len(joints) > MOST_JOINTS:
            raise RobotDescriptionError(f"{origin} has more than {MOST_JOINTS} moving joints")
    links = tuple(link.get("name", "") for link in root.findall("link"))
    if len(links) > MOST_LINKS:
        raise RobotDescriptionError(f"{origin} has more than {MOST_LINKS} links")
    return RobotDescription(
        root.get("name", ""),
        xml,
        MappingProxyType(joints),
        links,
        _root_link(root, links, origin),
        folder,
        tuple(_contradictions(root, joints)),
        held_joints(root),
        tuple(mends),
    )


def held_joints(robot: ElementTree.Element) -> dict[str, float]:
    """Return where joints stand that could move, by the attribute that was left at them."""
    elements = [each for each in robot.findall("joint") if each.get(HELD_AT) is not None]
    origin = "a held joint"
    return {each.get("name", ""): _number(each, HELD_AT, 0.0, origin) for each in elements}


def listed(names: Sequence[str], most: int = _SHOWN) -> str:
    """Return a few names and how many more there are."""
    few = names if len(names) <= most else names[: most - 1]
    more = f" and {len(names) - len(few)} more" if len(names) > len(few) else ""
    return ", ".join(few) + more


@lru_cache(maxsize=256)
def _say(line: str) -> None:
    """Log a line, once for all the times that a process loads a robot."""
    _logger.warning("%s", line)


def _elements(xml: str, origin: str) -> ElementTree.Element:
    """Return the root of an XML text that is no deeper than a URDF can be."""
    parser: Any = ElementTree.XMLPullParser(("start", "end"))
    root: ElementTree.Element | None = None
    depth = 0
    try:
        for begin in range(0, len(xml), _PIECE):
            parser.feed(xml[begin : begin + _PIECE])
            for event, element in parser.read_events():
                root = element if root is None else root
                depth += 1 if event == "start" else -1
                if depth > _MOST_LEVELS:  # what walks through it calls itself for each
                    raise RobotDescriptionError(
                        f"{origin} is no URDF: its elements have more than {_MOST_LEVELS} levels"
                    )
        parser.close()
    except (ElementTree.ParseError, ValueError) as error:
        if isinstance(error, RobotDescriptionError):
            raise
        raise RobotDescriptionError(f"{origin} is not readable XML: {error}") from error
    if root is None:
        raise RobotDescriptionError(f"{origin} is not readable XML: no element found")
    return root


def _require_no_xacro(robot: ElementTree.Element, origin: str) -> None:
    for element in robot.iter():
        if "/xacro" in element.tag or any("${" in text for text in element.attrib.values()):
            raise RobotDescriptionError(
                f"{origin} is xacro and not a URDF yet: expand it first (xacro FILE > robot.urdf)"
            )


def _root_link(robot: ElementTree.Element, links: tuple[str, ...], origin: str) -> str:
    """Return the one link that is no joint's child, after a look at whether they are a tree."""
    known = set(links)
    for name in links:
        if name not in known:
            raise RobotDescriptionError(f"{origin} has two links of the name {name!r}")
        known.remove(name)
    below: dict[str, list[str]] = {name: [] for name in links}
    joint_of: dict[str, str] = {}
    for joint in robot.findall("joint"):
        name = joint.get("name", "")
        ends = []
        for tag in ("parent", "child"):
            end = end_of(joint, tag)
            if end not in below:
                raise RobotDescriptionError(
                    f"{origin}, joint {name!r}, {tag}: {unknown_name('link', end, links)}"
                )
            ends.append(end)
        parent, child = ends
        if child in joint_of:
            raise RobotDescriptionError(
                f"{origin}: link {child!r} hangs on two joints, {joint_of[child]!r} and {name!r}"
            )
        joint_of[child] = name
        below[parent].append(child)
    roots = [link for link in links if link not in joint_of]
    if len(roots) != 1:
        raise RobotDescriptionError(
            f"{origin} must have one root link, not {len(roots)}: {', '.join(roots) or 'none'}"
        )
    _require_tree(roots[0], below, origin)
    return roots[0]


def _require_tree(root: str, below: Mapping[str, list[str]], origin: str) -> None:
    """Raise RobotDescriptionError for links in a circle, and for more in a row than arms have."""
    reached: set[str] = set()
    row, length = [root], 0
    while row:
        length += 1
        if length > _LONGEST_CHAIN:  # libraries that walk it call themselves for each link
            raise RobotDescriptionError(f"{origin} has more than {_LONGEST_CHAIN} links in a row")
        reached.update(row)
        row = [child for link in row for child in below[link]]
    circle = [name for name in below if name not in reached]
    if circle:
        raise RobotDescriptionError(
            f"{origin}: links hang in a circle, on no root: {', '.join(circle[:_SHOWN])}"
        )


@dataclass(frozen=True)
class GivenRobot:
    """A robot that an option names."""

    source: str  # path of its URDF, or the XML text where more is known than the URDF says
    description: RobotDescription  # what that says
    fixed_base: bool = False  # whether its root is held
    initial_positions: Mapping[str, float] = field(default_factory=dict)
    driven: tuple[str, ...] | None = None  # joints that are driven; None where nobody says
    wheels: tuple[str, ...] = ()  # joints on which its base rolls, as far as they are named


def robot_limits(source: str, joint: str) -> JointDescription:
    """Return a joint of a description, XML text or a file; without one a joint without limits."""
    if not source or not joint:
        return UNLIMITED
    (found,) = RobotDescription.load(robot_source(source)).select([joint])
    return found


def robot_xml(source: str) -> str:
    """Return the XML text that a source is or names."""
    found = robot_source(source)
    return found if isinstance(found, str) else RobotDescription.load(found).xml
