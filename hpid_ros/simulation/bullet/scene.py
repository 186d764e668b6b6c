"""Building the physics of one world: the ground, the robot, its joints, its starting pose."""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from hpid_ros.base.errors import RobotDescriptionError, SettingError
from hpid_ros.robot.description import RobotDescription
from hpid_ros.simulation.bullet.boxes import box_pose, let_hand_pass, put_boxes, still
from hpid_ros.simulation.bullet.connection import captured, pybullet
from hpid_ros.simulation.bullet.model import ROTOR_SUFFIX, couple_rotors, geared, rotor_name
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world.physics import PAYLOAD_EDGE, SETTLING_TIME, STAYING
from hpid_ros.simulation.world.workpieces import Workplace


def place_joints(
    client: int, body: int, joints: Mapping[str, int], start: Mapping[str, float]
) -> None:
    """Put every joint at its starting position, at rest, and its rotor at rest."""
    for name, position in start.items():
        pybullet.resetJointState(body, joints[name], position, 0.0, physicsClientId=client)
        rotor = joints.get(name + ROTOR_SUFFIX)
        if rotor is not None:
            pybullet.resetJointState(body, rotor, 0.0, 0.0, physicsClientId=client)


def release_joints(
    client: int, body: int, joints: Mapping[str, int], description: RobotDescription
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
        pybullet.changeDynamics(
            body, joints[joint.name], jointDamping=joint.damping, physicsClientId=client
        )


def brake_joints(client: int, body: int, indices: Sequence[int], forces: Sequence[float]) -> None:
    """Hold joints where they are, each with at most its force, in [N m]."""
    pybullet.setJointMotorControlArray(
        body,
        indices,
        pybullet.VELOCITY_CONTROL,
        targetVelocities=[0.0] * len(indices),
        forces=forces,
        physicsClientId=client,
    )


GROUND_FRICTION = 1.0  # Bullet multiplies the two surfaces' coefficients: the robot's decides
LOCK_FORCE = 1e6  # [N m]
NEARBY = 1e3  # [m], how far the robot may be from the ground before it is put down


def put_on_ground(client: int, body: int) -> None:
    """Make the ground, and set the robot down so that its lowest point touches it."""
    plane = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
    ground = pybullet.createMultiBody(0.0, plane, physicsClientId=client)
    pybullet.changeDynamics(ground, -1, lateralFriction=GROUND_FRICTION, physicsClientId=client)
    near = pybullet.getClosestPoints(body, ground, NEARBY, physicsClientId=client)
    if not near:
        return  # a robot without collision shapes falls, wherever it starts
    gap = min(point[8] for point in near)
    position, orientation = pybullet.getBasePositionAndOrientation(body, physicsClientId=client)
    lowered = (position[0], position[1], position[2] - gap)
    pybullet.resetBasePositionAndOrientation(body, lowered, orientation, physicsClientId=client)


def settle(client: int, body: int, joints: Collection[int], physics_period: float) -> None:
    """Let the robot sink into its tyres with every joint locked, then take away all speed."""
    brake_joints(client, body, list(joints), [LOCK_FORCE] * len(joints))
    for _ in range(max(1, round(SETTLING_TIME / physics_period))):
        pybullet.stepSimulation(physicsClientId=client)
    rest = (0.0, 0.0, 0.0)
    pybullet.resetBaseVelocity(body, rest, rest, physicsClientId=client)


def settle_bricks(client: int, bricks: tuple[int, ...], workplace: Workplace) -> None:
    """Take away what speed the bricks have left, and refuse those that fell or were pushed."""
    still(client, bricks)
    for body, brick in zip(bricks, workplace.bricks, strict=True):
        moved = math.dist(box_pose(client, body).position, brick.position)
        if moved > STAYING:
            raise SettingError(
                f"brick {brick.name!r} does not stay at {list(brick.position)} m: it moves by "
                f"{moved:.3g} m in {SETTLING_TIME:g} s; put it on a support, and into nothing"
            )


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
    driven: tuple[int, ...]  # bullet's indices of the driven joints, in the settings' order
    links: Mapping[str, int]  # bullet's index of every link; -1 is the root
    payload: int | None  # index of the payload link; None where the robot has none
    # [kg] mass and moments in [kg m^2] of the bare payload link
    payload_own: tuple[float, tuple[float, float, float]]
    bricks: tuple[int, ...] = ()  # the bricks, in the settings' order

    def load_payload(self, client: int, mass: float) -> None:
        """Put a solid cube at the payload link's centre of mass."""
        own_mass, own_moments = self.payload_own
        moment = mass * PAYLOAD_EDGE**2 / 6.0
        pybullet.changeDynamics(
            self.body,
            self.payload,
            mass=own_mass + mass,
            localInertiaDiagonal=[own + moment for own in own_moments],
            physicsClientId=client,
        )


def build_scene(
    client: int, urdf: str, description: RobotDescription, settings: WorldSettings
) -> Scene:
    """Build everything anew in an empty simulation."""
    pybullet.setGravity(0.0, 0.0, -settings.gravity, physicsClientId=client)
    pybullet.setTimeStep(settings.physics_period, physicsClientId=client)
    pybullet.setPhysicsEngineParameter(
        numSolverIterations=SOLVER_ITERATIONS,
        solverResidualThreshold=SOLVER_RESIDUAL,
        deterministicOverlappingPairs=1,
        enableFileCaching=0,
        physicsClientId=client,
    )
    body = _load(client, urdf, settings.fixed_base)
    joints, links = _indices(client, body)
    scene = _scene(client, body, joints, links, settings)
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
    if not settings.fixed_base or workplace:
        settle(client, body, joints.values(), settings.physics_period)
        settle_bricks(client, scene.bricks, workplace)
        place_joints(client, body, joints, start)
    release_joints(client, body, joints, description)
    return scene


def _load(client: int, urdf: str, fixed_base: bool) -> int:
    """Load URDF text through a file that is gone again afterwards."""
    handle, path = tempfile.mkstemp(prefix="hpid_ros_", suffix=".urdf")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(urdf)
        with captured() as lines:
            try:
                return pybullet.loadURDF(
                    path,
                    useFixedBase=fixed_base,
                    # Without this flag Bullet computes inertias of its own from the shapes.
                    flags=pybullet.URDF_USE_INERTIA_FROM_FILE,
                    physicsClientId=client,
                )
            except pybullet.error as error:
                failure = error
        said = "; ".join(lines[-2:]) or str(failure)
        raise RobotDescriptionError(f"PyBullet cannot load the robot description: {said}")
    finally:
        Path(path).unlink(missing_ok=True)


def _indices(client: int, body: int) -> tuple[dict[str, int], dict[str, int]]:
    """Return Bullet's indices of joints and of links, by name."""
    root = pybullet.getBodyInfo(body, physicsClientId=client)[0].decode()
    joints: dict[str, int] = {}
    links = {root: -1}
    for index in range(pybullet.getNumJoints(body, physicsClientId=client)):
        info = pybullet.getJointInfo(body, index, physicsClientId=client)
        joints[info[1].decode()] = index
        links[info[12].decode()] = index
    return joints, links


def _scene(
    client: int,
    body: int,
    joints: Mapping[str, int],
    links: Mapping[str, int],
    settings: WorldSettings,
) -> Scene:
    """Note what the world needs to know of a robot just loaded."""
    payload = links.get(settings.payload_link)
    own = (0.0, (0.0, 0.0, 0.0))
    if payload is not None:
        info = pybullet.getDynamicsInfo(body, payload, physicsClientId=client)
        own = (info[0], info[2])
    driven = tuple(joints[name] for name in settings.joints)
    return Scene(body, driven, links, payload, own)


def _prepare_links(client: int, scene: Scene) -> None:
    """Take away the damping and the speed limit that Bullet gives every link."""
    for index in scene.links.values():
        pybullet.changeDynamics(
            scene.body,
            index,
            linearDamping=0.0,
            angularDamping=0.0,
            maxJointVelocity=NO_SPEED_LIMIT,
            physicsClientId=client,
        )
