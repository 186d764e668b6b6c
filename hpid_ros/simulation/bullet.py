"""A robot in PyBullet as a world asks for it: connection, ground, robot, boxes, starting pose.

Bullet prints from C, past Python's ``sys.stdout``. A line of it in the middle of a program's
machine-readable output would corrupt that output, so whatever talks to Bullet where it prints
does so inside :func:`captured`.

Behind a gear of ratio N a rotor of inertia Jr weighs Jr N^2 at the joint; in a small arm's wrist
that is far more than the links. Bullet has no such term ("armature"), so every rotor is
simulated: a link of inertia Jr on the joint's parent, turning about the joint's axis, held to
N times the joint's speed by a gear constraint. This also yields what an armature leaves out, the
gyroscopic torque of the rotors and the reaction of their acceleration on the parent, both of
relative size 1/N. The links are added when a world loads its URDF; the URDF itself stays as the
user wrote it.
"""

from __future__ import annotations

import copy
import ctypes
import logging
import math
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from xml.etree import ElementTree

from hpid_ros.base.errors import RobotDescriptionError, RunError
from hpid_ros.base.units import Vector
from hpid_ros.robot.description import PAYLOAD_EDGE, RobotDescription, end_of, find_mesh
from hpid_ros.robot.joint_description import JointDescription
from hpid_ros.simulation.physics import (
    BRICK_SETTLING_TIME,
    GROUND_FRICTION,
    NEGLIGIBLE_INERTIA,
    NEGLIGIBLE_MASS,
    Pose,
    Twist,
    require_staying,
)
from hpid_ros.simulation.settings import Brick, Support, WorldSettings

if TYPE_CHECKING:
    from hpid_ros.simulation.merging import LinkPlacement

_logger = logging.getLogger(__name__)
_STANDARD_STREAMS = (1, 2)


@contextmanager
def captured() -> Iterator[list[str]]:
    """Divert what C code prints to stdout and stderr into a list of lines, and to the log.

    The process's file descriptors are diverted, so the block is meant to be short: loading a
    model, not stepping it.
    """
    lines: list[str] = []
    with tempfile.TemporaryFile() as sink:
        _flush()
        saved = [os.dup(stream) for stream in _STANDARD_STREAMS]
        try:
            for stream in _STANDARD_STREAMS:
                os.dup2(sink.fileno(), stream)
            yield lines
        finally:
            _flush()
            for stream, copy in zip(_STANDARD_STREAMS, saved, strict=True):
                os.dup2(copy, stream)
                os.close(copy)
            sink.seek(0)
            text = sink.read().decode("utf-8", "replace")
            lines.extend(line for line in text.splitlines() if line.strip())
    for line in lines:
        _logger.debug("bullet: %s", line)


def _flush() -> None:
    """Empty the buffers of Python's and of C's streams."""
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            stream.flush()
    ctypes.CDLL(None).fflush(None)


with captured():
    import pybullet  # prints its build time


class Client:
    """PyBullet's functions for one simulation of its own."""

    def __init__(self, gui: bool = False) -> None:
        with captured():
            self.number: int = pybullet.connect(pybullet.GUI if gui else pybullet.DIRECT)

    def __getattr__(self, name: str) -> Any:
        function = partial(getattr(pybullet, name), physicsClientId=self.number)
        setattr(self, name, function)
        return function

    def close(self) -> None:
        """Free the simulation; a second call does nothing."""
        number = self.number
        vars(self).clear()  # PyBullet gives the number to the next one
        self.number = -1
        if number >= 0:
            with captured():
                pybullet.disconnect(physicsClientId=number)


ROTOR_SUFFIX = "__rotor"
# The rotor's mass belongs to the housing and is part of the parent's; this one only has to be
# positive for Bullet.
ROTOR_MASS = 1e-6  # [kg]


def add_rotors(robot: ElementTree.Element, joints: Iterable[JointDescription]) -> None:
    """Add a rotor link and its joint to a URDF for every joint that has rotor inertia.

    The inertia is the same about every axis: then a turning rotor's inertia stays constant as
    seen from its parent, as that of a real, axially symmetric rotor does. The rotor has no
    collision shape.
    """
    elements = {element.get("name"): element for element in robot.findall("joint")}
    for joint in geared(joints):
        name, element = rotor_name(joint), elements[joint.name]
        link = ElementTree.SubElement(robot, "link", name=name)
        _add_inertial(link, ROTOR_MASS, joint.rotor_inertia)
        rotor = ElementTree.SubElement(robot, "joint", name=name, type="continuous")
        ElementTree.SubElement(rotor, "parent", link=end_of(element, "parent"))
        ElementTree.SubElement(rotor, "child", link=name)
        for tag in ("origin", "axis"):
            found = element.find(tag)
            if found is not None:
                rotor.append(copy.deepcopy(found))


def geared(joints: Iterable[JointDescription]) -> tuple[JointDescription, ...]:
    """Return the joints that have a rotor."""
    return tuple(joint for joint in joints if joint.rotor_inertia > 0.0)


def rotor_name(joint: JointDescription) -> str:
    """Return the name of a joint's rotor, of its link as of its joint."""
    return joint.name + ROTOR_SUFFIX


MOST_MOVING_LINKS = 128
"""Links of a robot in Bullet, rotors counted: of others it gives no states."""


class BulletRobot(NamedTuple):
    """What Bullet gets of a robot."""

    urdf: str
    merged: Mapping[str, LinkPlacement]  # links that are part of others, where there were too many


def bullet_robot(
    description: RobotDescription, kept: Collection[str] = (), *, is_shown: bool = False
) -> BulletRobot:
    """Return the URDF text that Bullet gets.

    Rotors are added; links without an inertial element become weightless frames (Bullet would
    make 1 kg and 1 kg m^2 of each); mesh paths become absolute, since the text is loaded from
    a temporary file; what nobody will see is left out, which loads many times faster; of a robot
    of too many links those on fixed joints become part of others, but for those that are kept.
    """
    robot = ElementTree.fromstring(description.xml)
    for link in robot.findall("link"):
        _place_meshes(link, "collision", description.folder)
        if is_shown:
            _place_meshes(link, "visual", description.folder)
        else:
            for shape in link.findall("visual"):
                link.remove(shape)
    merged = {}
    number = len(description.links) + len(geared(description.joints.values()))
    if number > MOST_MOVING_LINKS:
        from hpid_ros.simulation.merging import merge_fixed  # SciPy is slow to import

        merged = merge_fixed(robot, kept)
        number -= len(merged)
        if number > MOST_MOVING_LINKS:
            raise RobotDescriptionError(
                f"PyBullet takes {MOST_MOVING_LINKS} links that move, rotors counted, and "
                f"{description.name!r} has {number}: hold joints (robot.held), or choose "
                "engine: mujoco"
            )
    for link in robot.findall("link"):
        if link.find("inertial") is None:
            _add_inertial(link, NEGLIGIBLE_MASS, NEGLIGIBLE_INERTIA)
    add_rotors(robot, description.joints.values())
    ElementTree.indent(robot)  # a line of more than some kB is too long for Bullet
    return BulletRobot(ElementTree.tostring(robot, encoding="unicode"), merged)


_TRIAL = """
import sys
import pybullet
pybullet.connect(pybullet.DIRECT)
for urdf in sys.argv[1:]:
    print("reading", flush=True)
    try:
        pybullet.loadURDF(urdf)
    except pybullet.error:  # which is said where the robot is loaded
        pass
"""
_TRIED_WITHIN = 120.0  # [s]

_Mesh = tuple[str, str, int, int]
"""Its element's kind and its file, with the file's time of change in [ns] and size."""

_TRIED: dict[_Mesh, str] = {}  # why a mesh cannot be read; empty if it can


def require_readable_meshes(urdf: str) -> None:
    """Refuse meshes with which PyBullet would crash, or never return.

    Its readers believe what a file says of itself. So a process of its own reads each first, once
    for as long as the file stays as it is.
    """
    robot, meshes = ElementTree.fromstring(urdf), dict[_Mesh, ElementTree.Element]()
    for kind in ("collision", "visual"):
        for mesh in robot.iterfind(f"link/{kind}/geometry/mesh"):
            file = Path(mesh.get("filename", ""))
            if file.is_file():
                state = file.stat()
                meshes[kind, str(file), state.st_mtime_ns, state.st_size] = mesh
    untried = [key for key in meshes if key not in _TRIED]
    with tempfile.TemporaryDirectory(prefix="hpid_ros_") as folder:
        files = [
            _trial_file(Path(folder) / f"{number}.urdf", key[0], meshes[key])
            for number, key in enumerate(untried)
        ]
        while untried:
            read, reason = _tried(files)
            _TRIED.update(dict.fromkeys(untried[:read], ""))
            if reason:
                _TRIED[untried[read]] = reason
                read += 1
            untried, files = untried[read:], files[read:]
    for key in meshes:
        if _TRIED[key]:
            raise RobotDescriptionError(f"PyBullet cannot read the mesh {key[1]}: {_TRIED[key]}")


def _trial_file(path: Path, kind: str, mesh: ElementTree.Element) -> str:
    """Write a robot of one link that has a mesh."""
    robot = ElementTree.Element("robot", name="trial")
    link = ElementTree.SubElement(robot, "link", name="link")
    _add_inertial(link, 1.0, 1.0)
    geometry = ElementTree.SubElement(ElementTree.SubElement(link, kind), "geometry")
    geometry.append(mesh)
    path.write_bytes(ElementTree.tostring(robot))
    return str(path)


def _tried(files: Sequence[str]) -> tuple[int, str]:
    """Return how many files another process has read, and why it has not read the next one."""
    command = [sys.executable, "-c", _TRIAL, *files]
    with tempfile.TemporaryFile() as output:  # what it wrote is there, whatever becomes of it
        try:
            code = subprocess.run(
                command, stdout=output, stderr=output, timeout=_TRIED_WITHIN, check=False
            ).returncode
            reason = f"it crashes ({signal.Signals(-code).name})" if code < 0 else ""
        except subprocess.TimeoutExpired:
            reason = f"it has not been read within {_TRIED_WITHIN:g} s"
        output.seek(0)
        begun = output.read().split(b"\n").count(b"reading")
    return (max(begun - 1, 0), reason) if reason else (len(files), "")


def _place_meshes(link: ElementTree.Element, tag: str, folder: Path | None) -> None:
    """Make the paths of a link's meshes absolute; leave out shapes whose mesh is missing."""
    for shape in link.findall(tag):
        mesh = shape.find("geometry/mesh")
        if mesh is None:
            continue
        found = find_mesh(mesh.get("filename", ""), folder)
        if found is None:
            link.remove(shape)
        else:
            mesh.set("filename", str(found))


def _add_inertial(link: ElementTree.Element, mass: float, moment: float) -> None:
    inertial = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(inertial, "mass", value=repr(mass))
    moments = dict.fromkeys(("ixx", "iyy", "izz"), repr(moment))
    ElementTree.SubElement(inertial, "inertia", moments, ixy="0", ixz="0", iyz="0")


# Sequential impulses stop at this squared change of velocity or after this many sweeps. Measured
# on the package's robot, a joint and its rotor then agree to 6e-6 rad/s; Bullet's own 1e-7 and 50
# leave 3e-4. A stiffly held joint creeps by 1e-5 rad/s at most, and 1e-12 costs a tenth more.
_SOLVER_RESIDUAL = 1e-10
_SOLVER_ITERATIONS = 100
_NO_SPEED_LIMIT = 1e6  # [rad/s], Bullet's own is 100: rotors turn faster
_GEAR_FORCE = 1e6  # [N m], never reached: a limit would let the gear slip
_LOCK_FORCE = 1e6  # [N m]
_NEARBY = 1e3  # [m], how far the robot may be from the ground before it is put down
_UNYIELDING = 1e5  # [N], far beyond any grip: the constraint itself never gives way
_ROOT = -1  # Bullet's index of a robot's root link
_NOTHING = (0.0, 0.0, 0.0)


class BulletPhysics:
    """:class:`~hpid_ros.simulation.physics.Physics` in a PyBullet of its own."""

    def __init__(self, settings: WorldSettings, description: RobotDescription) -> None:
        self._settings, self._description = settings, description
        kept = {*settings.links, settings.payload_link}
        self._urdf, self._merged = bullet_robot(description, kept, is_shown=settings.gui)
        require_readable_meshes(self._urdf)
        self.client = Client(settings.gui)
        self._damping: Sequence[float] | None = None
        self._brakes: Sequence[float] | None = None
        try:
            self._build()
        except BaseException:
            self.close()
            raise

    def _build(self) -> None:
        """Build everything again in an empty simulation."""
        client, settings = self.client, self._settings
        client.setGravity(0.0, 0.0, -settings.gravity)
        client.setTimeStep(settings.physics_period)
        client.setPhysicsEngineParameter(
            numSolverIterations=_SOLVER_ITERATIONS,
            solverResidualThreshold=_SOLVER_RESIDUAL,
            deterministicOverlappingPairs=1,
            enableFileCaching=0,
        )
        self._held: int | None = None  # the constraint
        self.body = self._load_robot()
        self._find_parts()
        if settings.payload_mass:
            self.load(settings.payload_mass)
        self._couple_rotors()
        start = settings.start(self._description)
        self._place_joints(start)
        if not settings.fixed_base:
            self._put_on_ground()
        workplace = settings.workplace
        self._bricks = [self._put_box(each) for each in workplace.bricks]
        for support in workplace.supports:
            self._put_box(support)
        if self._bricks:
            self._let_hand_pass(self._links[workplace.gripper.link])
        if settings.is_touched:
            self._settle()
            self._place_joints(start)
        self._release_joints()

    def _load_robot(self) -> int:
        """Load URDF text through a file that is gone again afterwards."""
        handle, path = tempfile.mkstemp(prefix="hpid_ros_", suffix=".urdf")
        try:
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                file.write(self._urdf)
            with captured() as lines:
                try:
                    body: int = self.client.loadURDF(
                        path,
                        useFixedBase=self._settings.fixed_base,
                        # Without this flag Bullet computes inertias of its own from the shapes.
                        flags=pybullet.URDF_USE_INERTIA_FROM_FILE,
                    )
                    failure = ""
                except pybullet.error as error:
                    failure = str(error)
            bad = [line for line in lines if "setting inertia to zero" in line]
            if not failure and not bad:
                return body
            said = "; ".join(bad[:1] or lines[-2:]) or failure
            raise RobotDescriptionError(f"PyBullet cannot load the robot description: {said}")
        finally:
            Path(path).unlink(missing_ok=True)

    def _find_parts(self) -> None:
        """Note Bullet's numbers of joints and links, whose own damping and speed limit go."""
        client, body = self.client, self.body
        infos = [client.getJointInfo(body, index) for index in range(client.getNumJoints(body))]
        self._joints = {info[1].decode(): index for index, info in enumerate(infos)}
        self._links = {client.getBodyInfo(body)[0].decode(): _ROOT}
        self._links |= {info[12].decode(): index for index, info in enumerate(infos)}
        self.driven = tuple(self._joints[name] for name in self._settings.joints)
        self._payload = self._links.get(self._settings.payload_link)
        if self._payload is not None:
            self._bare = client.getDynamicsInfo(body, self._payload)  # mass first, moments third
        for index in self._links.values():
            client.changeDynamics(
                body,
                index,
                linearDamping=0.0,
                angularDamping=0.0,
                maxJointVelocity=_NO_SPEED_LIMIT,
            )

    def _couple_rotors(self) -> None:
        """Gear each rotor to its joint.

        The constraint acts on velocities alone (erp 0): no position of a rotor is ever read, so
        its drift against the joint's, some 1e-6 rad in half a second, means nothing.
        """
        for joint in geared(self._description.joints.values()):
            rotor = self._joints[rotor_name(joint)]
            gear = self.client.createConstraint(
                self.body,
                self._joints[joint.name],
                self.body,
                rotor,
                jointType=pybullet.JOINT_GEAR,
                jointAxis=joint.axis,
                parentFramePosition=_NOTHING,
                childFramePosition=_NOTHING,
            )
            # Bullet's row reads: joint velocity + gearRatio * rotor velocity = 0.
            self.client.changeConstraint(
                gear, gearRatio=-1.0 / joint.gear_ratio, maxForce=_GEAR_FORCE, erp=0.0
            )

    def _place_joints(self, start: Mapping[str, float]) -> None:
        """Put every joint at its starting position, at rest, and its rotor at rest."""
        for name, position in start.items():
            self.client.resetJointState(self.body, self._joints[name], position, 0.0)
            rotor = self._joints.get(name + ROTOR_SUFFIX)
            if rotor is not None:
                self.client.resetJointState(self.body, rotor, 0.0, 0.0)

    def _put_on_ground(self) -> None:
        """Make the ground, and set the robot down so that its lowest point touches it."""
        client, body = self.client, self.body
        plane = client.createCollisionShape(pybullet.GEOM_PLANE)
        ground = client.createMultiBody(0.0, plane)
        client.changeDynamics(ground, -1, lateralFriction=GROUND_FRICTION)
        near = client.getClosestPoints(body, ground, _NEARBY)
        if not near:
            return  # a robot without collision shapes falls, wherever it starts
        gap = min(point[8] for point in near)
        position, orientation = client.getBasePositionAndOrientation(body)
        lowered = (position[0], position[1], position[2] - gap)
        client.resetBasePositionAndOrientation(body, lowered, orientation)

    def _put_box(self, box: Support) -> int:
        client = self.client
        shape = client.createCollisionShape(
            pybullet.GEOM_BOX, halfExtents=[edge / 2.0 for edge in box.size]
        )
        body: int = client.createMultiBody(
            box.mass if isinstance(box, Brick) else 0.0,
            shape,
            basePosition=box.position,
            baseOrientation=box.orientation,
        )
        client.changeDynamics(
            body, -1, lateralFriction=box.friction, linearDamping=0.0, angularDamping=0.0
        )
        return body

    def _let_hand_pass(self, link: int) -> None:
        """Let all that is rigid with a link pass the bricks: it has no joint for its fingers."""
        client, body = self.client, self.body
        infos = [client.getJointInfo(body, index) for index in range(client.getNumJoints(body))]
        is_fixed = [info[2] == pybullet.JOINT_FIXED for info in infos]
        while link >= 0 and is_fixed[link]:
            link = infos[link][16]
        hand = {link}
        for index, info in enumerate(infos):  # a parent comes before its children
            if is_fixed[index] and info[16] in hand:
                hand.add(index)
        for index in sorted(hand):
            for brick in self._bricks:
                client.setCollisionFilterPair(body, brick, index, -1, enableCollision=0)

    def _settle(self) -> None:
        """Let all sink into its place with every joint locked, then take away all speed.

        Bricks that fell or were pushed are refused.
        """
        client = self.client
        self._brake(list(self._joints.values()), [_LOCK_FORCE] * len(self._joints))
        for _ in range(max(1, round(BRICK_SETTLING_TIME / self._settings.physics_period))):
            client.stepSimulation()
        client.resetBaseVelocity(self.body, _NOTHING, _NOTHING)
        for index, brick in enumerate(self._settings.workplace.bricks):
            client.resetBaseVelocity(self._bricks[index], _NOTHING, _NOTHING)
            require_staying(brick, self.brick_pose(index))

    def _release_joints(self) -> None:
        """Free every joint of Bullet's default motor and leave it with its own friction."""
        moving = self._description.joints.values()
        friction = {joint.name: joint.friction for joint in moving}
        friction.update({rotor_name(joint): 0.0 for joint in geared(moving)})
        self._brake([self._joints[name] for name in friction], list(friction.values()))
        for joint in moving:
            self.client.changeDynamics(
                self.body, self._joints[joint.name], jointDamping=joint.damping
            )

    def _brake(self, indices: Sequence[int], forces: Sequence[float]) -> None:
        """Hold joints where they are, each with at most its force, in [N m].

        A motor whose target speed is 0 and whose force is the Coulomb friction's is an implicit
        constraint of the solver, so a joint sticks truly and cannot chatter about zero.
        """
        self.client.setJointMotorControlArray(
            self.body,
            indices,
            pybullet.VELOCITY_CONTROL,
            targetVelocities=[0.0] * len(indices),
            forces=forces,
        )

    def joint_states(self) -> Sequence[tuple[float, float]]:
        states: Sequence[tuple[float, float]] = self.client.getJointStates(self.body, self.driven)
        if not sum(abs(state[1]) for state in states) < _NO_SPEED_LIMIT:
            joint, (position, speed, *_) = max(
                zip(self._settings.joints, states, strict=True),
                key=lambda each: math.inf if math.isnan(each[1][1]) else abs(each[1][1]),
            )
            raise RunError(
                f"PyBullet: the simulation diverged: joint {joint!r} is at {position:.3g} with a "
                f"speed of {speed:.3g}; it does so where joints in a row have much friction and "
                "links that weigh little (engine: mujoco runs those), or a law is unstable"
            )
        return states

    def advance(self, torques: Sequence[float], steps: int = 1) -> None:
        for _ in range(steps):
            # Bullet forgets applied torques after every step.
            self.client.setJointMotorControlArray(
                self.body, self.driven, pybullet.TORQUE_CONTROL, forces=torques
            )
            self.client.stepSimulation()

    def set_damping(self, damping: Sequence[float]) -> None:
        self._damping = damping
        for index, value in zip(self.driven, damping, strict=True):
            self.client.changeDynamics(self.body, index, jointDamping=value)

    def brake(self, forces: Sequence[float]) -> None:
        self._brakes = forces
        self._brake(self.driven, forces)

    def push(self, link: str, force: Vector, torque: Vector) -> None:
        client, body = self.client, self.body
        index = self._links[self._merged[link].link if link in self._merged else link]
        origin, centre = self.link_pose(link).position, self._centre_of_mass(index)
        x, y, z = (a - b for a, b in zip(origin, centre, strict=True))
        fx, fy, fz = force
        tx, ty, tz = torque
        client.applyExternalForce(body, index, force, centre, pybullet.WORLD_FRAME)
        client.applyExternalTorque(
            body,
            index,
            (tx + y * fz - z * fy, ty + z * fx - x * fz, tz + x * fy - y * fx),
            pybullet.WORLD_FRAME,
        )

    def load(self, mass: float) -> None:
        moment = mass * PAYLOAD_EDGE**2 / 6.0
        self.client.changeDynamics(
            self.body,
            self._payload,
            mass=self._bare[0] + mass,
            localInertiaDiagonal=[own + moment for own in self._bare[2]],
        )

    def link_pose(self, link: str) -> Pose:
        if link not in self._merged:
            return self._pose(self._links[link])
        into, position, orientation = self._merged[link]
        whole = self._pose(self._links[into])
        return Pose(*self.client.multiplyTransforms(*whole, position, orientation))

    def root_pose(self) -> Pose:
        return self._pose(_ROOT)

    def root_twist(self) -> Twist:
        client = self.client
        origin, orientation = self._pose(_ROOT)
        (vx, vy, vz), angular = client.getBaseVelocity(self.body)
        wx, wy, wz = angular
        x, y, z = (a - b for a, b in zip(origin, self._centre_of_mass(_ROOT), strict=True))
        linear = (vx + wy * z - wz * y, vy + wz * x - wx * z, vz + wx * y - wy * x)
        _, inverse = client.invertTransform(_NOTHING, orientation)
        return Twist(client.rotateVector(inverse, linear), client.rotateVector(inverse, angular))

    def brick_pose(self, index: int) -> Pose:
        return Pose(*self.client.getBasePositionAndOrientation(self._bricks[index]))

    def hold(self, index: int) -> None:
        robot, body, client = self.body, self._bricks[index], self.client
        link = self._links[self._settings.workplace.gripper.link]
        # Bullet wants the frame as the link's centre of mass sees it.
        state = client.getLinkState(robot, link)
        inverse = client.invertTransform(state[0], state[1])
        brick = self.brick_pose(index)
        position, orientation = client.multiplyTransforms(
            *inverse, brick.position, brick.orientation
        )
        self._held = client.createConstraint(
            robot, link, body, -1, pybullet.JOINT_FIXED, _NOTHING, position, _NOTHING, orientation
        )
        client.changeConstraint(self._held, maxForce=_UNYIELDING)

    def release(self) -> None:
        if self._held is not None:
            self.client.removeConstraint(self._held)
        self._held = None

    def grip_force(self) -> Vector:
        state = self.client.getConstraintState(self._held)
        return state[0], state[1], state[2]

    def keep(self) -> None:
        self._at_start: int = self.client.saveState()

    def restart(self) -> None:
        if self._bricks:
            # Of bricks that were moved Bullet keeps contacts that are not in the saved state.
            self.client.removeState(self._at_start)
            self.client.resetSimulation()
            self._build()
            if self._damping is not None and self._brakes is not None:
                self.set_damping(self._damping)
                self.brake(self._brakes)
            self.keep()
            return
        if self._payload is not None:
            self.load(self._settings.payload_mass)
        self.client.restoreState(self._at_start)

    def close(self) -> None:
        self.client.close()

    def _pose(self, index: int) -> Pose:
        """Return the pose of a link's URDF frame."""
        client, body = self.client, self.body
        if index != _ROOT:
            state = client.getLinkState(body, index, computeForwardKinematics=True)
            return Pose(state[4], state[5])
        # Of the root Bullet gives the principal frame at the centre of mass.
        centre = client.getBasePositionAndOrientation(body)
        frame = client.invertTransform(*client.getDynamicsInfo(body, _ROOT)[3:5])
        return Pose(*client.multiplyTransforms(*centre, *frame))

    def _centre_of_mass(self, index: int) -> Vector:
        """Return a link's centre of mass in the world, in [m]."""
        body = self.body
        if index == _ROOT:
            centre: Vector = self.client.getBasePositionAndOrientation(body)[0]
        else:
            centre = self.client.getLinkState(body, index)[0]
        return centre
