r"""A differential-drive base: kinematics of its wheels, and odometry.

Between two readings both wheels are taken to turn at constant rates, so that the base moves on a
circular arc of length s that turns by theta; its chord is exact for every theta, also for 0,

.. math:: \Delta x = s \frac{\sin(\theta/2)}{\theta/2} \cos(\vartheta + \theta/2), \quad
    \Delta y = s \frac{\sin(\theta/2)}{\theta/2} \sin(\vartheta + \theta/2).

Source: R. Siegwart and I. Nourbakhsh, *Introduction to Autonomous Mobile Robots*, section 5.2.4;
``ros2_controllers``, ``diff_drive_controller/src/odometry.cpp``, which changes to another formula
below a turn of 1e-6 rad, since its difference of sines loses its digits there; this one does not.

Roll, pitch and yaw of the URDF are rotations about the fixed x, y and z axes in this order
(http://wiki.ros.org/urdf/XML).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from hpid_ros.base.errors import RobotDescriptionError, SettingError
from hpid_ros.base.units import Numbers, Vector
from hpid_ros.robot.description import RobotDescription, end_of

_ALIGNED = 0.01  # [rad], also for those who write 1.57 for a quarter of a turn

RotationRows = tuple[Vector, Vector, Vector]
_NO_TURN: RotationRows = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class Wheel(NamedTuple):
    """A wheel as its robot's root link sees it, with every joint at 0."""

    centre: Vector  # [m] origin of its joint
    radius: float | None  # [m] of its link's collision shape


def read_wheel(description: RobotDescription, joint: str) -> Wheel:
    robot = ElementTree.fromstring(description.xml)
    parents = {end_of(each, "child"): each for each in robot.findall("joint")}
    wheel = description.joints[joint]
    centre: Vector = (0.0, 0.0, 0.0)
    axis: Vector = wheel.axis
    link = wheel.child
    while link in parents:
        element = parents[link]
        shift, rows = _origin(element)
        x, y, z = _turned(rows, centre)
        centre = (x + shift[0], y + shift[1], z + shift[2])
        axis = _turned(rows, axis)
        link = end_of(element, "parent")
    if math.atan2(math.hypot(axis[0], axis[2]), axis[1]) > _ALIGNED:
        raise RobotDescriptionError(
            f"wheel {joint!r} must turn about the +y axis of {description.root!r}, not about "
            f"({', '.join(f'{value:.6g}' for value in axis)})"
        )
    return Wheel(centre, _radius(robot, wheel.child))


def _radius(robot: ElementTree.Element, name: str) -> float | None:
    """Return the radius of a link's only collision shape."""
    shapes = robot.findall(f"link[@name='{name}']/collision/geometry/*")
    if len(shapes) != 1 or shapes[0].tag not in ("sphere", "cylinder"):
        return None
    (radius,) = _numbers(shapes[0], "radius", "nan", f"link {name!r}", 1)
    return radius


def _origin(joint: ElementTree.Element) -> tuple[Vector, RotationRows]:
    """Return a joint's shift in [m] and its turn as the rows of a matrix.

    Without SciPy, whose import a bridge would have to wait for at its start.
    """
    origin = joint.find("origin")
    if origin is None:
        return (0.0, 0.0, 0.0), _NO_TURN
    where = f"joint {joint.get('name', '')!r}"
    x, y, z = _numbers(origin, "xyz", "0 0 0", where, 3)
    roll, pitch, yaw = _numbers(origin, "rpy", "0 0 0", where, 3)
    (cr, cp, cy), (sr, sp, sy) = (
        tuple(each(angle) for angle in (roll, pitch, yaw)) for each in (math.cos, math.sin)
    )
    return (x, y, z), (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )


def _turned(rows: RotationRows, vector: Vector) -> Vector:
    x, y, z = (sum(a * b for a, b in zip(row, vector, strict=True)) for row in rows)
    return x, y, z


def _numbers(
    element: ElementTree.Element, attribute: str, default: str, where: str, count: int
) -> list[float]:
    text = element.get(attribute, default)
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        raise RobotDescriptionError(f"{where}: {attribute}={text!r} must be {count} numbers")
    return values


_LENGTHS = (1e-6, 1e6)  # [m]
_SAME = 1e-6  # [m]


class BaseTwist(NamedTuple):
    """How a base moves in its own frame."""

    linear: float  # [m/s] forward speed of the axle's centre
    angular: float  # [rad/s] rate of the heading, counter-clockwise seen from above


@dataclass(frozen=True)
class DifferentialDrive:
    """Two wheels on one axle through the base's origin, which roll and do not slip.

    The base's frame is that of REP 103: x forward, y to the left. A positive wheel rate turns
    the wheel about +y and drives it forward.
    """

    left: str  # name of the left wheel's joint
    right: str  # name of the right wheel's joint
    radius: float  # [m] of both wheels
    separation: float  # [m] distance between the points where the wheels touch the ground
    height: float = 0.0  # [m] of the root link above the ground

    def __post_init__(self) -> None:
        for name in ("left", "right"):
            if not isinstance(getattr(self, name), str) or not getattr(self, name):
                raise SettingError(f"the {name} wheel must name a joint, it is empty")
        if self.left == self.right:
            raise SettingError(f"the wheels must be two joints, not {self.left!r} twice")
        low, high = _LENGTHS
        for name in ("radius", "separation"):
            value = getattr(self, name)
            if not low <= value <= high:
                raise SettingError(f"wheel_{name} must lie in [{low:g}, {high:g}] m, not {value}")

    @classmethod
    def of(
        cls,
        description: RobotDescription,
        left: str,
        right: str,
        radius: float | None = None,
        separation: float | None = None,
    ) -> DifferentialDrive:
        """Return the drive of a robot; what is not given is read from its URDF.

        The radius is that of the collision shape of the wheels' links (sphere or cylinder), the
        separation the distance of the wheels' joints along their axis, the height the radius
        less that of the axle in the root's frame.
        """
        if left == right:
            raise SettingError(f"the wheels must be two joints, not {left!r} twice")
        description.select((left, right))
        wheels = read_wheel(description, left), read_wheel(description, right)
        (xl, yl, zl), (xr, yr, zr) = wheels[0].centre, wheels[1].centre
        is_axle = math.hypot(xl - xr, zl - zr) <= _SAME and yl > yr
        if not is_axle or math.hypot(xl, yl + yr) > _SAME:
            raise RobotDescriptionError(
                f"wheels {left!r} and {right!r} must lie left and right of {description.root!r} "
                f"on one axle through it, not at {_shown(wheels[0].centre)} and "
                f"{_shown(wheels[1].centre)} m"
            )
        if radius is None:
            radii = {wheel.radius for wheel in wheels}
            radius = radii.pop()
            if radius is None or radii:
                raise RobotDescriptionError(
                    f"wheels {left!r} and {right!r} must both collide as a sphere or cylinder of "
                    f"one radius, or wheel_radius must be given"
                )
        height = (wheels[0].radius or radius) - zl
        return cls(left, right, radius, yl - yr if separation is None else separation, height)

    @property
    def joints(self) -> tuple[str, str]:
        """The joints of the left and of the right wheel."""
        return self.left, self.right

    def twist(self, left_rate: float, right_rate: float) -> BaseTwist:
        r"""Return how the base moves.

        .. math:: v = r (\dot\varphi_r + \dot\varphi_l) / 2, \quad
            \omega = r (\dot\varphi_r - \dot\varphi_l) / b
        """
        return BaseTwist(
            0.5 * self.radius * (right_rate + left_rate),
            self.radius * (right_rate - left_rate) / self.separation,
        )


def _shown(point: Vector) -> str:
    return "(" + ", ".join(f"{value:.6g}" for value in point) + ")"


WHEEL_ERROR = 1e-4
"""Variance of a wheel's travel for each metre of it, in [m^2/m]: 1 cm after a metre."""


class PlanarPose(NamedTuple):
    """Where a base is in the plane."""

    x: float  # [m]
    y: float  # [m]
    heading: float  # [rad] counter-clockwise from x; not wrapped


class PlanarCovariance(NamedTuple):
    """Covariance of a pose: the upper triangle, in [m^2], [m rad] and [rad^2]."""

    xx: float
    xy: float
    xh: float
    yy: float
    yh: float
    hh: float


class Odometry:
    """Adds up arcs, and how uncertain they are; starts at the origin, certain of it."""

    def __init__(self, drive: DifferentialDrive, left: float, right: float) -> None:
        self.drive = drive
        self._left, self._right = left, right
        self.pose = PlanarPose(0.0, 0.0, 0.0)
        self.covariance = PlanarCovariance(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        self.distance = self.turn = 0.0

    def update(self, left: float, right: float) -> PlanarPose:
        """Take the next reading of the wheels and return the pose."""
        drive = self.drive
        of_left = drive.radius * (left - self._left)
        of_right = drive.radius * (right - self._right)
        if of_left == 0.0 == of_right:
            return self.pose
        self._left, self._right = left, right
        distance = 0.5 * (of_left + of_right)
        turn = (of_right - of_left) / drive.separation
        x, y, heading = self.pose
        middle = heading + 0.5 * turn
        c, s = math.cos(middle), math.sin(middle)
        chord = distance * chord_share(turn)
        self.pose = PlanarPose(x + chord * c, y + chord * s, heading + turn)
        self.distance += distance
        self.turn += turn
        self._spread(abs(of_left), abs(of_right), distance, c, s)
        return self.pose

    def twist_between(self, distance: float, turn: float, seconds: float) -> BaseTwist:
        """Return the mean twist since a moment."""
        return BaseTwist((self.distance - distance) / seconds, (self.turn - turn) / seconds)

    def _spread(
        self, of_left: float, of_right: float, distance: float, c: float, s: float
    ) -> None:
        """Carry the covariance along an arc; Siegwart and Nourbakhsh, equation 5.9."""
        b, k = self.drive.separation, WHEEL_ERROR
        both = k * (of_left + of_right)
        dd, hh = 0.25 * both, both / b**2
        dh = 0.5 * k * (of_right - of_left) / b
        was = self.covariance
        # The arc shifts x by -distance s and y by distance c for each radian of the heading.
        fx, fy = -distance * s, distance * c
        gx, gy = 0.5 * fx, 0.5 * fy
        self.covariance = PlanarCovariance(
            was.xx + 2.0 * fx * was.xh + fx * fx * was.hh + dd * c * c + 2.0 * dh * c * gx
            + hh * gx * gx,
            was.xy + fx * was.yh + fy * was.xh + fx * fy * was.hh + dd * c * s
            + dh * (c * gy + s * gx) + hh * gx * gy,
            was.xh + fx * was.hh + dh * c + hh * gx,
            was.yy + 2.0 * fy * was.yh + fy * fy * was.hh + dd * s * s + 2.0 * dh * s * gy
            + hh * gy * gy,
            was.yh + fy * was.hh + dh * s + hh * gy,
            was.hh + hh,
        )  # fmt: skip


def chord_share(turn: float) -> float:
    """Return the chord of an arc over its length."""
    half = 0.5 * turn
    return math.sin(half) / half if half else 1.0


def integrated(drive: DifferentialDrive, left: Numbers, right: Numbers) -> Numbers:
    """Return the poses of a whole recording, from the origin on, by the same arcs."""
    of_left, of_right = drive.radius * np.diff(left), drive.radius * np.diff(right)
    distances, turns = 0.5 * (of_left + of_right), (of_right - of_left) / drive.separation
    headings = np.concatenate(([0.0], np.cumsum(turns)))
    middles = headings[:-1] + 0.5 * turns
    chords = distances * np.sinc(turns / (2.0 * np.pi))
    poses = np.zeros((len(headings), 3))
    poses[1:, 0] = np.cumsum(chords * np.cos(middles))
    poses[1:, 1] = np.cumsum(chords * np.sin(middles))
    poses[:, 2] = headings
    return poses
