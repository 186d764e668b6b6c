"""A robot as a configuration file says it, with corrections of its URDF."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields

from hpid_ros.base.errors import RobotDescriptionError, SettingError
from hpid_ros.documents.records import Record, quantity
from hpid_ros.robot.amendments import Inertial, JointAmendment, amended
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.differential_drive import DifferentialDrive


@dataclass(frozen=True)
class Wheels(Record):
    """The two driven wheels of a base."""

    left_wheel: str = quantity("Joint of the left wheel")
    right_wheel: str = quantity("Joint of the right wheel")
    wheel_radius: float | None = quantity(
        "Of both wheels; as the URDF has it if left out", "m", default=None, above=0.0
    )
    wheel_separation: float | None = quantity(
        "Between their contacts; as the URDF has it if left out", "m", default=None, above=0.0
    )

    @classmethod
    def of(cls, drive: DifferentialDrive) -> Wheels:
        """Return what a file says to give this drive."""
        return cls(drive.left, drive.right, drive.radius, drive.separation)

    def drive(self, description: RobotDescription) -> DifferentialDrive:
        """Return the drive of a robot."""
        return DifferentialDrive.of(
            description,
            self.left_wheel,
            self.right_wheel,
            self.wheel_radius,
            self.wheel_separation,
        )


@dataclass(frozen=True)
class Moments(Record):
    """Moments and products of inertia about the centre of mass, in axes parallel to the link's."""

    ixx: float = quantity("Moment about x", "kg m^2")
    iyy: float = quantity("Moment about y", "kg m^2")
    izz: float = quantity("Moment about z", "kg m^2")
    ixy: float = quantity("Product of x and y", "kg m^2", default=0.0)
    ixz: float = quantity("Product of x and z", "kg m^2", default=0.0)
    iyz: float = quantity("Product of y and z", "kg m^2", default=0.0)


@dataclass(frozen=True)
class LinkAmendment(Record):
    """Mass and inertia of one link; they replace what the URDF says of them as a whole."""

    mass: float = quantity("Its mass; 0 makes it a mere frame", "kg", least=0.0)
    center_of_mass: tuple[float, float, float] = quantity(
        "In the link's frame", "m", default=(0.0, 0.0, 0.0)
    )
    inertia: Moments | None = quantity("Needed where there is a mass", default=None)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.mass and self.inertia is None:
            raise SettingError("inertia is missing")
        if self.inertia is not None and not self.mass:
            raise SettingError("inertia must be left out where mass is 0")

    def inertial(self) -> Inertial | None:
        """Return mass and inertia; None for a mere frame."""
        if self.inertia is None:
            return None
        xx, yy, zz, xy, xz, yz = (getattr(self.inertia, each.name) for each in fields(Moments))
        return Inertial(self.mass, self.center_of_mass, (xx, yy, zz, xy, xz, yz))


@dataclass(frozen=True)
class RobotSection(Record):
    """The robot of an experiment, and how it stands at the start."""

    description: str = quantity(
        "Its URDF: a path, also in the share folder, or package:// and a path"
    )
    driven: tuple[str, ...] = quantity(
        "Its driven joints; those of the reference, else all that move, if left out", default=()
    )
    payload: float = quantity("Mass in its hand", "kg", default=0.0, least=0.0)
    fixed_base: bool = quantity("Whether its root is held, without a ground", default=False)
    initial_positions: Mapping[str, float] = quantity(
        "Positions at the start, by joint; others are at 0", "rad", factory=dict
    )
    base: Wheels | None = quantity("The wheels of its base", default=None)
    joints: Mapping[str, JointAmendment] = quantity(
        "What is known better than the URDF says it, by joint", factory=dict
    )
    links: Mapping[str, LinkAmendment] = quantity(
        "What is known better than the URDF says it, by link", factory=dict
    )
    held: Mapping[str, float] = quantity(
        "Joints that do not move, and where they stand", "rad", factory=dict
    )

    def load(self, load: Callable[[str], RobotDescription]) -> RobotDescription:
        """Return the robot with what is known better of it."""
        plain = load(self.description)
        if not (self.joints or self.links or self.held):
            return plain
        bodies = {}
        for name, link in self.links.items():
            try:
                bodies[name] = link.inertial()
            except RobotDescriptionError as error:
                raise RobotDescriptionError(f"robot.links.{name}: {error}") from None
        try:
            return amended(plain, self.joints, bodies, self.held)
        except RobotDescriptionError as error:
            raise RobotDescriptionError(f"robot: {error}") from None
