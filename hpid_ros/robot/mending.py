"""What is mended of a URDF while it is loaded: what no engine takes, and what none needs.

Robots that go from hand to hand have links that are frames, with a made-up inertia, axes that are
not of length 1, joints whose limits leave no room. Engines differ in what they refuse and in what
they take at its word, so that the one text that all of them read is mended, in one place. What
cannot be mended without a guess is a contradiction of :mod:`hpid_ros.robot.description`.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from typing import NamedTuple, cast
from xml.etree import ElementTree

import numpy as np

from hpid_ros.base.errors import RobotDescriptionError
from hpid_ros.base.units import Numbers

MOVING_TYPES = frozenset({"revolute", "continuous", "prismatic"})
HELD_AT = "held_at"
"""The attribute of a fixed joint that could move: where it stands."""
LIGHT = 1e-3
"""Mass in [kg] of a link whose inertia nobody can have meant."""

_MOVING_ONLY = ("axis", "limit", "dynamics", "mimic", "calibration", "safety_controller")
_NUMBERS = frozenset({"mass", "inertia", "limit", "dynamics", "origin", "axis"})
_ROUNDING = 1e-3  # of an axis, as "0.707 0 0.707" has it: nobody needs to be told
_MOMENTS = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
# Of the largest moment: by so much the sum of two exceeds the third, since engines turn tensors,
# with roundings of their own, before they look at them.
_SLACK = 1e-6
_TINY = 1e-6  # [m^2] of a mass: what is less is a rounding
_GYRATION = 3e-3  # [m] radius of a body whose inertia is given as none
_LEAST_MASS, _LEAST_MOMENT = 1e-9, 1e-12  # [kg], [kg m^2] of a body; MuJoCo takes 1e-14 for 0
_TOLD = 1e-4  # share of the largest moment; less is a rounding of who wrote the file


class Mend(NamedTuple):
    """One thing that a robot was mended in."""

    names: tuple[str, ...]  # joints or links that it is about
    text: str  # what came, and what counts instead


def mend(robot: ElementTree.Element) -> tuple[list[Mend], bool]:
    """Mend a URDF in place; return what to say of it, and whether anything is another."""
    joints = [each for each in robot.findall("joint") if each.get("type") in MOVING_TYPES]
    before = ElementTree.tostring(robot)
    _strip(robot)
    found = [*_axes(joints), *_ranges(joints), *_inertias(robot)]
    return found, ElementTree.tostring(robot) != before


def _strip(robot: ElementTree.Element) -> None:
    """Take blanks from around numbers: to some readers one with a blank after it is none."""
    for element in robot.iter():
        if element.tag in _NUMBERS:
            for name, value in element.attrib.items():
                if value != value.strip():
                    element.set(name, value.strip())


def vector(text: str | None) -> Numbers | None:
    """Return three finite numbers of an attribute; None if it has others."""
    try:
        values = np.array([float(word) for word in (text or "").split()])
    except ValueError:
        return None
    return values if values.shape == (3,) and np.isfinite(values).all() else None


def _axes(joints: list[ElementTree.Element]) -> Iterator[Mend]:
    """Give axes the length 1: Bullet multiplies motions by it, MuJoCo and Pinocchio do not."""
    told = []
    for joint in joints:
        element = joint.find("axis")
        axis = vector(None if element is None else element.get("xyz"))
        if element is None or axis is None or not axis.any():
            continue
        scale = np.abs(axis).max()  # first, so that no square overflows or vanishes
        length = float(np.linalg.norm(axis / scale) * scale)
        if abs(length - 1.0) > 4e-16:
            element.set("xyz", _text(axis / scale / np.linalg.norm(axis / scale)))
        if abs(length - 1.0) > _ROUNDING:
            told.append(joint.get("name", ""))
    if told:
        yield Mend(tuple(told), "axis not of length 1: its direction counts")


def _ranges(joints: list[ElementTree.Element]) -> Iterator[Mend]:
    """Hold joints whose limits are one number."""
    told = []
    for joint in joints:
        limit = joint.find("limit")
        if limit is None or joint.get("type") == "continuous":
            continue
        try:
            lower, upper = (float(limit.get(name, "nan")) for name in ("lower", "upper"))
        except ValueError:
            continue
        if lower == upper and math.isfinite(lower):
            hold(joint, lower)
            told.append(joint.get("name", ""))
    if told:
        yield Mend(tuple(told), "lower and upper limit are the same: held there, as if fixed")


def hold(element: ElementTree.Element, position: float) -> None:
    """Make a moving joint a fixed one that stands at a position."""
    origin = element.find("origin")
    if origin is None:
        origin = ElementTree.SubElement(element, "origin")
    found = element.find("axis")
    axis = vector("1 0 0" if found is None else found.get("xyz", "1 0 0"))
    place, angles = (vector(origin.get(name, "0 0 0")) for name in ("xyz", "rpy"))
    if axis is None or place is None or angles is None:
        name = element.get("name", "")
        raise RobotDescriptionError(f"joint {name!r}: its origin or axis is not three numbers")
    if position:
        from scipy.spatial.transform import Rotation  # slow to import, and only needed here

        axis = axis / np.linalg.norm(axis)
        turn = Rotation.from_euler("xyz", angles)  # about fixed axes
        if element.get("type") == "prismatic":
            place = place + turn.as_matrix() @ (axis * position)
        else:
            turn = turn * Rotation.from_rotvec(axis * position)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # pitch upright: any roll will do
                origin.set("rpy", _text(turn.as_euler("xyz")))
    origin.set("xyz", _text(place))
    element.set("type", "fixed")
    element.set(HELD_AT, repr(float(position)))
    for tag in _MOVING_ONLY:
        for child in element.findall(tag):
            element.remove(child)


def _text(numbers: Numbers) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def _inertias(robot: ElementTree.Element) -> Iterator[Mend]:
    """Give links the moments of inertia that some body can have, the nearest to what they had."""
    told: list[str] = []
    frames: list[str] = []
    most = 0.0
    for link in robot.findall("link"):
        element = link.find("inertial/inertia")
        moments = None if element is None else inertia_of(element)
        if element is None or moments is None or is_impossible(link):
            continue
        mass = mass_of(link)
        if not (moments.any() or mass > 0.0):
            continue  # a frame that says so
        if mass < _LEAST_MASS and np.abs(moments).max() < _LEAST_MOMENT:
            link.remove(cast(ElementTree.Element, link.find("inertial")))
            frames.append(link.get("name", ""))
            continue
        better = nearest_possible(moments, mass, is_turned(link))
        if better is moments:
            continue
        values = better[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]].tolist()
        for name, value in zip(_MOMENTS, values, strict=True):
            element.set(name, repr(value))
        change = float(np.abs(better - moments).max())
        if change > _TOLD * np.abs(moments).max():
            told.append(link.get("name", ""))
            most = max(most, change)
    if frames:
        yield Mend(tuple(frames), "next to no mass and inertia: without any, as a frame")
    if told:
        text = "moments of inertia that no body has: the nearest possible count"
        yield Mend(tuple(told), f"{text}, other by {most:.2g} kg m^2 at most")


def is_impossible(link: ElementTree.Element) -> bool:
    """Return whether a link that weighs something has a negative moment that is no rounding."""
    moments, mass = moments_of(link), mass_of(link)
    return moments is not None and mass > LIGHT and bool(np.diag(moments).min() < -_TINY * mass)


def moments_of(link: ElementTree.Element) -> Numbers | None:
    """Return a link's tensor of inertia as it is written; None if it has none that is one."""
    element = link.find("inertial/inertia")
    return None if element is None else inertia_of(element)


def mass_of(link: ElementTree.Element) -> float:
    """Return a link's mass in [kg]; nan where it is no number."""
    element = link.find("inertial/mass")
    try:
        return 0.0 if element is None else float(element.get("value", "0"))
    except ValueError:
        return math.nan


def is_turned(link: ElementTree.Element) -> bool:
    """Return whether a link's moments are given in axes that are not the link's."""
    origin = link.find("inertial/origin")
    return origin is not None and any(w.strip("+-0.") for w in origin.get("rpy", "0").split())


def inertia_of(element: ElementTree.Element) -> Numbers | None:
    """Return the tensor of an inertia element, (3, 3) in [kg m^2]; None if it is no tensor."""
    try:
        xx, yy, zz, xy, xz, yz = (float(element.get(name, "0")) for name in _MOMENTS)
    except ValueError:
        return None
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return tensor if np.isfinite(tensor).all() else None


def nearest_possible(tensor: Numbers, mass: float = 0.0, is_turned: bool = False) -> Numbers:
    r"""Return a tensor of inertia that a body can have; the same object if it is one.

    With the body's second moments :math:`\Sigma = \tfrac12 \mathrm{tr}(I) 1 - I`, which are those
    of a mass distribution if none is negative, negative ones become 0, which raises the smaller
    moments of inertia and keeps the largest.

    Source: P. M. Wensing, S. Kim, J.-J. E. Slotine, *Linear matrix inequalities for physically
    consistent inertial parameter identification*, IEEE RA-L 3 (2018), section III.
    """
    is_diagonal = not np.any(tensor - np.diag(np.diag(tensor)))
    if is_diagonal and not is_turned:  # as written, without a solver's rounding
        values, vectors = np.diag(tensor), np.eye(3)
        slack = 0.0
    else:
        values, vectors = np.linalg.eigh(tensor)
        slack = _SLACK
    second = values.sum() / 2.0 - values
    largest = float(np.abs(values).max())
    if values.min() > _LEAST_MOMENT and second.min() >= slack * largest:
        return tensor
    second = np.maximum(
        second, max(10.0 * _SLACK * largest, _GYRATION**2 * mass / 2.0, _LEAST_MOMENT)
    )
    return np.asarray((vectors * (second.sum() - second)) @ vectors.T)
