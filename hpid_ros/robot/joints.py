"""One moving joint of a URDF, and how it is read.

Source: the URDF joint element (http://wiki.ros.org/urdf/XML/joint). Rotor inertia and gear ratio
are read from the transmissions in Drake's convention, ``drake:rotor_inertia`` and
``drake:gear_ratio`` of an ``actuator`` element.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from xml.etree import ElementTree

from hpid_ros.errors import RobotDescriptionError, unknown_name

DRAKE_NAMESPACE = "http://drake.mit.edu"
MOVING_TYPES = frozenset({"revolute", "continuous", "prismatic"})
OTHER_TYPES = frozenset({"fixed", "floating", "planar"})


@dataclass(frozen=True)
class JointDescription:
    """One moving joint; "per rad" reads "per m" where the joint is prismatic.

    Attributes:
        name: Name of the joint.
        type: ``revolute``, ``continuous`` or ``prismatic``.
        axis: Axis of motion in the frame of the joint, as the URDF gives it.
        parent: Name of the parent link.
        child: Name of the child link.
        lower: Lowest position, in [rad]; -inf where there is none.
        upper: Highest position, in [rad]; +inf where there is none.
        effort: Largest absolute effort, in [N m] or [N]; +inf where there is none.
        velocity: Largest absolute velocity, in [rad/s]; +inf where there is none.
        damping: Viscous friction, in [N m s/rad].
        friction: Coulomb friction, in [N m] or [N].
        rotor_inertia: Inertia of the motor's rotor about its own axis, in [kg m^2].
        gear_ratio: Turns of the rotor for one turn of the joint; 1 without a gear.
    """

    name: str
    type: str
    axis: tuple[float, float, float]
    parent: str
    child: str
    lower: float = -math.inf
    upper: float = math.inf
    effort: float = math.inf
    velocity: float = math.inf
    damping: float = 0.0
    friction: float = 0.0
    rotor_inertia: float = 0.0
    gear_ratio: float = 1.0

    @property
    def reflected_inertia(self) -> float:
        """Rotor inertia as the joint feels it, Jr N^2, in [kg m^2]."""
        return self.rotor_inertia * self.gear_ratio**2


def read_joint(
    element: ElementTree.Element,
    rotors: Mapping[str, tuple[float, float]],
    origin: str,
) -> JointDescription | None:
    """Read one joint.

    Args:
        element: The URDF's joint element.
        rotors: Rotor inertia and gear ratio by joint, from :func:`read_rotors`.
        origin: Where the URDF came from, for messages.

    Returns:
        The joint; None for one that no motor moves (fixed, floating, planar).

    Raises:
        RobotDescriptionError: An entry is missing or is not what it should be.
    """
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
        effort=_number(limit, "effort", math.inf, where),
        velocity=_number(limit, "velocity", math.inf, where),
        damping=_number(dynamics, "damping", 0.0, where),
        friction=_number(dynamics, "friction", 0.0, where),
        rotor_inertia=rotor_inertia,
        gear_ratio=gear_ratio,
    )


def read_rotors(root: ElementTree.Element, origin: str) -> dict[str, tuple[float, float]]:
    """Return rotor inertia in [kg m^2] and gear ratio by joint.

    Args:
        root: The URDF's root element.
        origin: Where the URDF came from, for messages.

    Raises:
        RobotDescriptionError: A value is not a number or not possible.
    """
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
    element: ElementTree.Element | None, attribute: str, default: float, where: str
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
    return value


def _link(element: ElementTree.Element, tag: str, where: str) -> str:
    """Return the link that a parent or child element names."""
    found = element.find(tag)
    name = "" if found is None else found.get("link", "")
    if not name:
        raise RobotDescriptionError(f"{where} has no <{tag} link=.../>")
    return name


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
