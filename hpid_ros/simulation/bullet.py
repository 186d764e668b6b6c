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
import os
import sys
import tempfile
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from hpid_ros.base.errors import RobotDescriptionError
from hpid_ros.base.units import Vector
from hpid_ros.robot.description import JointDescription, RobotDescription, find_mesh
from hpid_ros.simulation.physics import (
    GROUND_FRICTION,
    NEGLIGIBLE_INERTIA,
    NEGLIGIBLE_MASS,
    PAYLOAD_EDGE,
    SETTLING_TIME,
    Pose,
    Twist,
    require_staying,
)
from hpid_ros.simulation.settings import Brick, Support, Workplace, WorldSettings

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


def put_boxes(client: Client, boxes: Iterable[Support]) -> tuple[int, ...]:
    bodies = []
    for box in boxes:
        shape = client.createCollisionShape(
            pybullet.GEOM_BOX, halfExtents=[edge / 2.0 for edge in box.size]
        )
        body = client.createMultiBody(
            box.mass if isinstance(box, Brick) else 0.0,
            shape,
            basePosition=box.position,
            baseOrientation=box.orientation,
        )
        client.changeDynamics(
            body, -1, lateralFriction=box.friction, linearDamping=0.0, angularDamping=0.0
        )
        bodies.append(body)
    return tuple(bodies)


def let_hand_pass(client: Client, robot: int, link: int, bricks: Iterable[int]) -> None:
    """Let a hand, all that is rigid with a link, pass bricks: it has no joint for its fingers."""
    infos = [client.getJointInfo(robot, index) for index in range(client.getNumJoints(robot))]
    is_fixed = [info[2] == pybullet.JOINT_FIXED for info in infos]
    while link >= 0 and is_fixed[link]:
        link = infos[link][16]
    hand = {link}
    for index, info in enumerate(infos):  # a parent comes before its children
        if is_fixed[index] and info[16] in hand:
            hand.add(index)
    for index in sorted(hand):
        for brick in bricks:
            client.setCollisionFilterPair(robot, brick, index, -1, enableCollision=0)


def box_pose(client: Client, body: int) -> Pose:
    return Pose(*client.getBasePositionAndOrientation(body))


ROTOR_SUFFIX = "__rotor"
# The rotor's mass belongs to the housing and is part of the parent's; this one only has to be
# positive for Bullet.
ROTOR_MASS = 1e-6  # [kg]
# Never reached: a limit would let the gear slip.
GEAR_FORCE = 1e6  # [N m]


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
        ElementTree.SubElement(rotor, "parent", link=joint.parent)
        ElementTree.SubElement(rotor, "child", link=name)
        for tag in ("origin", "axis"):
            found = element.find(tag)
            if found is not None:
                rotor.append(copy.deepcopy(found))


def couple_rotors(
    client: Client, body: int, indices: Mapping[str, int], joints: Iterable[JointDescription]
) -> None:
    """Gear each rotor to its joint.

    The constraint acts on velocities alone (erp 0): no position of a rotor is ever read, so its
    drift against the joint's, some 1e-6 rad in half a second, means nothing.
    """
    for joint in geared(joints):
        gear = client.createConstraint(
            *(body, indices[joint.name], body, indices[rotor_name(joint)]),
            jointType=pybullet.JOINT_GEAR,
            jointAxis=joint.axis,
            parentFramePosition=(0.0, 0.0, 0.0),
            childFramePosition=(0.0, 0.0, 0.0),
        )
        # Bullet's row reads: joint velocity + gearRatio * rotor velocity = 0.
        client.changeConstraint(
            gear, gearRatio=-1.0 / joint.gear_ratio, maxForce=GEAR_FORCE, erp=0.0
        )


def geared(joints: Iterable[JointDescription]) -> tuple[JointDescription, ...]:
    """Return the joints that have a rotor."""
    return tuple(joint for joint in joints if joint.rotor_inertia > 0.0)


def rotor_name(joint: JointDescription) -> str:
    """Return the name of a joint's rotor, of its link as of its joint."""
    return joint.name + ROTOR_SUFFIX


def bullet_urdf(description: RobotDescription, *, is_shown: bool = False) -> str:
    """Return the URDF text that Bullet gets.

    Rotors are added; links without an inertial element become weightless frames (Bullet would
    make 1 kg and 1 kg m^2 of each); mesh paths become absolute, since the text is loaded from
    a temporary file; and what nobody will see is left out, which loads many times faster.
    """
    robot = ElementTree.fromstring(description.xml)
    for link in robot.findall("link"):
        if link.find("inertial") is None:
            _add_inertial(link, NEGLIGIBLE_MASS, NEGLIGIBLE_INERTIA)
        _place_meshes(link, "collision", description.folder)
        if is_shown:
            _place_meshes(link, "visual", description.folder)
        else:
            for shape in link.findall("visual"):
                link.remove(shape)
    add_rotors(robot, description.joints.values())
    return ElementTree.tostring(robot, encoding="unicode")


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


def place_joints(
    client: Client, body: int, joints: Mapping[str, int], start: Mapping[str, float]
) -> None:
    """Put every joint at its starting position, at rest, and its rotor at rest."""
    for name, position in start.items():
        client.resetJointState(body, joints[name], position, 0.0)
        rotor = joints.get(name + ROTOR_SUFFIX)
        if rotor is not None:
            client.resetJointState(body, rotor, 0.0, 0.0)


def release_joints(
    client: Client, body: int, joints: Mapping[str, int], description: RobotDescription
) -> None:
    """Free every joint of Bullet's default motor and leave it with its own friction.

    Coulomb friction is a motor whose target speed is 0 and whose force is the friction's: an
    implicit constraint of the solver, so a joint sticks truly and cannot chatter about zero.
    """
    moving = description.joints.values()
    friction = {joint.name: joint.friction for joint in moving}
    friction.update({rotor_name(joint): 0.0 for joint in geared(moving)})
    indices = [joints[name] for name in friction]
    brake_joints(client, body, indices, list(friction.values()))
    for joint in moving:
        client.changeDynamics(body, joints[joint.name], jointDamping=joint.damping)


def brake_joints(
    client: Client, body: int, indices: Sequence[int], forces: Sequence[float]
) -> None:
    """Hold joints where they are, each with at most its force, in [N m]."""
    client.setJointMotorControlArray(
        body,
        indices,
        pybullet.VELOCITY_CONTROL,
        targetVelocities=[0.0] * len(indices),
        forces=forces,
    )


LOCK_FORCE = 1e6  # [N m]
NEARBY = 1e3  # [m], how far the robot may be from the ground before it is put down


def put_on_ground(client: Client, body: int) -> None:
    """Make the ground, and set the robot down so that its lowest point touches it."""
    plane = client.createCollisionShape(pybullet.GEOM_PLANE)
    ground = client.createMultiBody(0.0, plane)
    client.changeDynamics(ground, -1, lateralFriction=GROUND_FRICTION)
    near = client.getClosestPoints(body, ground, NEARBY)
    if not near:
        return  # a robot without collision shapes falls, wherever it starts
    gap = min(point[8] for point in near)
    position, orientation = client.getBasePositionAndOrientation(body)
    lowered = (position[0], position[1], position[2] - gap)
    client.resetBasePositionAndOrientation(body, lowered, orientation)


def settle(client: Client, body: int, joints: Collection[int], physics_period: float) -> None:
    """Let the robot sink into its tyres with every joint locked, then take away all speed."""
    brake_joints(client, body, list(joints), [LOCK_FORCE] * len(joints))
    for _ in range(max(1, round(SETTLING_TIME / physics_period))):
        client.stepSimulation()
    client.resetBaseVelocity(body, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def settle_bricks(client: Client, bricks: tuple[int, ...], workplace: Workplace) -> None:
    """Take away what speed the bricks have left, and refuse those that fell or were pushed."""
    rest = (0.0, 0.0, 0.0)
    for body, brick in zip(bricks, workplace.bricks, strict=True):
        client.resetBaseVelocity(body, rest, rest)
        require_staying(brick, box_pose(client, body))


# Sequential impulses stop at this squared change of velocity or after this many sweeps. Measured
# on the package's robot, a joint and its rotor then agree to 6e-6 rad/s; Bullet's own 1e-7 and 50
# leave 3e-4. A stiffly held joint creeps by 1e-5 rad/s at most, and 1e-12 costs a tenth more.
SOLVER_RESIDUAL = 1e-10
SOLVER_ITERATIONS = 100
NO_SPEED_LIMIT = 1e6  # [rad/s], Bullet's own is 100: rotors turn faster


@dataclass(frozen=True)
class Scene:
    """A loaded robot, in Bullet's numbers."""

    body: int  # the robot
    driven: tuple[int, ...]  # Bullet's indices of the driven joints, in the settings' order
    links: Mapping[str, int]  # Bullet's index of every link; -1 is the root
    payload: int | None  # index of the payload link; None where the robot has none
    # mass [kg] and moments of inertia [kg m^2] of the bare payload link
    payload_own: tuple[float, tuple[float, float, float]]
    bricks: tuple[int, ...] = ()  # the bricks, in the settings' order

    def load_payload(self, client: Client, mass: float) -> None:
        """Put a solid cube at the payload link's centre of mass."""
        own_mass, own_moments = self.payload_own
        moment = mass * PAYLOAD_EDGE**2 / 6.0
        client.changeDynamics(
            self.body,
            self.payload,
            mass=own_mass + mass,
            localInertiaDiagonal=[own + moment for own in own_moments],
        )


def build_scene(
    client: Client, urdf: str, description: RobotDescription, settings: WorldSettings
) -> Scene:
    """Build everything again in an empty simulation."""
    client.setGravity(0.0, 0.0, -settings.gravity)
    client.setTimeStep(settings.physics_period)
    client.setPhysicsEngineParameter(
        numSolverIterations=SOLVER_ITERATIONS,
        solverResidualThreshold=SOLVER_RESIDUAL,
        deterministicOverlappingPairs=1,
        enableFileCaching=0,
    )
    body = _load(client, urdf, settings.fixed_base)
    joints, links = _indices(client, body)
    payload, own = links.get(settings.payload_link), (0.0, (0.0, 0.0, 0.0))
    if payload is not None:
        info = client.getDynamicsInfo(body, payload)
        own = info[0], info[2]
    driven = tuple(joints[name] for name in settings.joints)
    scene = Scene(body, driven, links, payload, own)
    _prepare_links(client, scene)
    if settings.payload_mass:
        scene.load_payload(client, settings.payload_mass)
    couple_rotors(client, body, joints, description.joints.values())
    start = settings.start(description)
    place_joints(client, body, joints, start)
    if not settings.fixed_base:
        put_on_ground(client, body)
    workplace = settings.workplace
    scene = replace(scene, bricks=put_boxes(client, workplace.bricks))
    put_boxes(client, workplace.supports)
    if scene.bricks:
        let_hand_pass(client, body, links[workplace.gripper.link], scene.bricks)
    if settings.is_touched:
        settle(client, body, joints.values(), settings.physics_period)
        settle_bricks(client, scene.bricks, workplace)
        place_joints(client, body, joints, start)
    release_joints(client, body, joints, description)
    return scene


def _load(client: Client, urdf: str, fixed_base: bool) -> int:
    """Load URDF text through a file that is gone again afterwards."""
    handle, path = tempfile.mkstemp(prefix="hpid_ros_", suffix=".urdf")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(urdf)
        with captured() as lines:
            try:
                return client.loadURDF(
                    path,
                    useFixedBase=fixed_base,
                    # Without this flag Bullet computes inertias of its own from the shapes.
                    flags=pybullet.URDF_USE_INERTIA_FROM_FILE,
                )
            except pybullet.error as error:
                failure = error
        said = "; ".join(lines[-2:]) or str(failure)
        raise RobotDescriptionError(f"PyBullet cannot load the robot description: {said}")
    finally:
        Path(path).unlink(missing_ok=True)


def _indices(client: Client, body: int) -> tuple[dict[str, int], dict[str, int]]:
    """Return Bullet's indices of joints and of links, by name."""
    root = client.getBodyInfo(body)[0].decode()
    joints: dict[str, int] = {}
    links = {root: -1}
    for index in range(client.getNumJoints(body)):
        info = client.getJointInfo(body, index)
        joints[info[1].decode()] = index
        links[info[12].decode()] = index
    return joints, links


def _prepare_links(client: Client, scene: Scene) -> None:
    """Take away the damping and the speed limit that Bullet gives every link."""
    for index in scene.links.values():
        client.changeDynamics(
            scene.body,
            index,
            linearDamping=0.0,
            angularDamping=0.0,
            maxJointVelocity=NO_SPEED_LIMIT,
        )


_ROOT = -1  # Bullet's index of a robot's root link
_UNYIELDING = 1e5  # [N], far beyond any grip: the constraint itself never gives way


class BulletPhysics:
    """:class:`~hpid_ros.simulation.physics.Physics` in a PyBullet of its own."""

    def __init__(self, settings: WorldSettings, description: RobotDescription) -> None:
        self._settings, self._description = settings, description
        self._urdf = bullet_urdf(description, is_shown=settings.gui)
        self._client = Client(settings.gui)
        self._damping: Sequence[float] | None = None
        self._brakes: Sequence[float] | None = None
        try:
            self._build()
        except BaseException:
            self.close()
            raise

    def _build(self) -> None:
        self._held: int | None = None  # the constraint
        self._scene: Scene = build_scene(
            self._client, self._urdf, self._description, self._settings
        )

    def joint_states(self) -> Sequence[tuple[float, float]]:
        states: Sequence[tuple[float, float]] = self._client.getJointStates(
            self._scene.body, self._scene.driven
        )
        return states

    def advance(self, torques: Sequence[float], steps: int = 1) -> None:
        for _ in range(steps):
            # Bullet forgets applied torques after every step.
            self._client.setJointMotorControlArray(
                self._scene.body, self._scene.driven, pybullet.TORQUE_CONTROL, forces=torques
            )
            self._client.stepSimulation()

    def set_damping(self, damping: Sequence[float]) -> None:
        self._damping = damping
        for index, value in zip(self._scene.driven, damping, strict=True):
            self._client.changeDynamics(self._scene.body, index, jointDamping=value)

    def brake(self, forces: Sequence[float]) -> None:
        """Set the Coulomb friction of each driven joint.

        It is an implicit constraint with a largest torque, which sticks truly and cannot chatter
        about zero speed.
        """
        self._brakes = forces
        brake_joints(self._client, self._scene.body, self._scene.driven, forces)

    def push(self, link: str, force: Vector, torque: Vector) -> None:
        client, body, index = self._client, self._scene.body, self._scene.links[link]
        origin, centre = self._pose(index).position, self._centre_of_mass(index)
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
        self._scene.load_payload(self._client, mass)

    def link_pose(self, link: str) -> Pose:
        return self._pose(self._scene.links[link])

    def root_pose(self) -> Pose:
        return self._pose(_ROOT)

    def root_twist(self) -> Twist:
        client = self._client
        origin, orientation = self._pose(_ROOT)
        (vx, vy, vz), angular = client.getBaseVelocity(self._scene.body)
        wx, wy, wz = angular
        x, y, z = (a - b for a, b in zip(origin, self._centre_of_mass(_ROOT), strict=True))
        linear = (vx + wy * z - wz * y, vy + wz * x - wx * z, vz + wx * y - wy * x)
        _, inverse = client.invertTransform((0.0, 0.0, 0.0), orientation)
        return Twist(client.rotateVector(inverse, linear), client.rotateVector(inverse, angular))

    def brick_pose(self, index: int) -> Pose:
        return box_pose(self._client, self._scene.bricks[index])

    def hold(self, index: int) -> None:
        robot, body, client = self._scene.body, self._scene.bricks[index], self._client
        link = self._scene.links[self._settings.workplace.gripper.link]
        # Bullet wants the frame as the link's centre of mass sees it.
        state = client.getLinkState(robot, link)
        inverse = client.invertTransform(state[0], state[1])
        brick = box_pose(client, body)
        position, orientation = client.multiplyTransforms(
            *inverse, brick.position, brick.orientation
        )
        nowhere = (0.0, 0.0, 0.0)
        self._held = client.createConstraint(
            *(robot, link, body, -1, pybullet.JOINT_FIXED, nowhere),
            *(position, nowhere, orientation),
        )
        client.changeConstraint(self._held, maxForce=_UNYIELDING)

    def release(self) -> None:
        if self._held is not None:
            self._client.removeConstraint(self._held)
        self._held = None

    def grip_force(self) -> Vector:
        state = self._client.getConstraintState(self._held)
        return state[0], state[1], state[2]

    def keep(self) -> None:
        self._at_start: int = self._client.saveState()

    def restart(self) -> None:
        if self._scene.bricks:
            # Of bricks that were moved Bullet keeps contacts that are not in the saved state.
            self._client.removeState(self._at_start)
            self._client.resetSimulation()
            self._build()
            if self._damping is not None and self._brakes is not None:
                self.set_damping(self._damping)
                self.brake(self._brakes)
            self.keep()
            return
        if self._scene.payload is not None:
            self.load(self._settings.payload_mass)
        self._client.restoreState(self._at_start)

    def close(self) -> None:
        self._client.close()

    def _pose(self, index: int) -> Pose:
        """Return the pose of a link's URDF frame."""
        client, body = self._client, self._scene.body
        if index != _ROOT:
            state = client.getLinkState(body, index, computeForwardKinematics=True)
            return Pose(state[4], state[5])
        # Of the root Bullet gives the principal frame at the centre of mass.
        centre = client.getBasePositionAndOrientation(body)
        frame = client.invertTransform(*client.getDynamicsInfo(body, _ROOT)[3:5])
        return Pose(*client.multiplyTransforms(*centre, *frame))

    def _centre_of_mass(self, index: int) -> Vector:
        """Return a link's centre of mass in the world, in [m]."""
        body = self._scene.body
        if index == _ROOT:
            centre: Vector = self._client.getBasePositionAndOrientation(body)[0]
        else:
            centre = self._client.getLinkState(body, index)[0]
        return centre
