"""A robot in MuJoCo as a world asks for it, and the model of robot, ground, bricks and supports.

The model is written from the URDF's text: MuJoCo's own reader drops contact elements,
transmissions and rotors. Every link is a body, also one on a fixed joint, so that its frame and
its wrench are its own. A rotor's inertia behind its gear is the joint's armature.

What may touch is listed in pairs, since of two surfaces MuJoCo takes the larger friction and here
their product counts. Nothing of the robot touches itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple
from xml.etree import ElementTree

import mujoco
import numpy as np

from hpid_ros.base.errors import HpidError, RobotDescriptionError, RunError
from hpid_ros.base.units import Numbers, Vector
from hpid_ros.robot.description import (
    PAYLOAD_EDGE,
    RobotDescription,
    end_of,
    find_mesh,
    numbers_of,
    origin_of,
)
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

GROUND = "__ground"
_LINK_FRICTION = 0.5  # of a link whose URDF names none, as in Bullet
# d of elastic contacts: with one that small R is large, and stiffness and damping are exact.
_IMPEDANCE = 0.05
_IMPEDANCE_RATIO = 1000.0
_FRICTION_SOLIMP = (0.9999, 0.9999, 0.001, 0.5, 2.0)
_HARD_SOLIMP = (0.98, 0.999, 1e-4, 0.5, 2.0)
# Steps in the shortest time constant that the solver follows: what is to stick has that one.
_SHORTEST = 2.0
_LOCK = 1e6  # [N m]
_FAR = 1e3  # [m]
_KEPT = ("body_mass", "body_inertia", "dof_damping", "dof_frictionloss")
_BENIGN = "Linesearch"  # a step of the solver that it repairs itself


class Touch(NamedTuple):
    """The contact of two shapes."""

    pair: int  # its index in the model
    stiffness: float  # [N/m] 0 where the contact is hard
    damping: float  # [N s/m]


@dataclass(frozen=True)
class MujocoModel:
    """A compiled model and what is where in it."""

    model: Any
    positions: Mapping[str, int]  # address of each joint's position, by joint
    velocities: Mapping[str, int]  # address of each joint's velocity, by joint
    links: Mapping[str, int]  # body of each link
    bricks: tuple[int, ...]  # body of each brick, in the settings' order
    welds: tuple[int, ...]  # equality that holds each brick in the hand, in the settings' order
    touches: tuple[Touch, ...]  # the contacts that have a stiffness of their own
    shapes: tuple[int, ...]  # shapes of the robot, to put it on the ground


class _Shape(NamedTuple):
    """A shape of a link and its surface."""

    name: str
    link: str
    friction: float
    stiffness: float
    damping: float


def build_mujoco_model(settings: WorldSettings, description: RobotDescription) -> MujocoModel:
    spec = _spec(settings)
    robot = _Robot(spec, description, settings)
    touches = _Contacts(spec, settings)
    try:
        robot.build()
        if settings.is_touched:
            touches.build(robot)
        model = spec.compile()
    except HpidError:
        raise
    except (ValueError, TypeError, IndexError) as error:  # also of a malformed number
        line = " ".join(str(error).split())
        raise RobotDescriptionError(f"MuJoCo cannot load the robot description: {line}") from None
    return _indexed(model, robot, touches)


def _spec(settings: WorldSettings) -> Any:
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.compiler.autolimits = False
    option = spec.option
    option.timestep = settings.physics_period
    option.gravity = (0.0, 0.0, -settings.gravity)
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = _IMPEDANCE_RATIO
    return spec


class _Robot:
    """Writes the robot's bodies, joints and shapes."""

    def __init__(self, spec: Any, description: RobotDescription, settings: WorldSettings) -> None:
        self._spec, self.description, self.settings = spec, description, settings
        root = ElementTree.fromstring(description.xml)
        self._links = {each.get("name", ""): each for each in root.findall("link")}
        self._below: dict[str, list[ElementTree.Element]] = {}
        for joint in root.findall("joint"):
            self._below.setdefault(end_of(joint, "parent"), []).append(joint)
        self.shapes: list[_Shape] = []
        self.rigid: dict[str, str] = {}
        """The moving link that each link is rigidly connected with, towards the root."""

    def build(self) -> None:
        root = self.description.root
        body = self._spec.worldbody.add_body(name=_link(root))
        is_free = not self.settings.fixed_base
        if is_free:
            body.add_freejoint(name=f"{root}__free")
        self.rigid[root] = root
        self._fill(body, root, is_free)
        pending = [(body, root)]
        while pending:
            parent, name = pending.pop()
            for element in self._below.get(name, ()):
                pending.append(self._add(parent, name, element))

    def _add(self, parent: Any, above: str, element: ElementTree.Element) -> tuple[Any, str]:
        name = end_of(element, "child")
        position, turn = _origin(element)
        body = parent.add_body(name=_link(name), pos=position, quat=turn)
        joint = self.description.joints.get(element.get("name", ""))
        self.rigid[name] = self.rigid[above] if joint is None else name
        if joint is not None:
            _add_joint(body, joint, _SHORTEST * self._spec.option.timestep)
        self._fill(body, name, joint is not None)
        return body, name

    def _fill(self, body: Any, name: str, moves: bool) -> None:
        """Give a body its inertia and its shapes."""
        link = self._links[name]
        inertial = link.find("inertial")
        mass, centre, moments = (0.0, [], []) if inertial is None else _inertial(inertial)
        if mass or any(moments):
            if moves:  # also a frame with an inertia alone
                mass = max(mass, NEGLIGIBLE_MASS)
            body.mass, body.ipos, body.fullinertia = mass, centre, moments
            body.explicitinertial = True
        elif moves:
            body.mass, body.inertia = NEGLIGIBLE_MASS, (NEGLIGIBLE_INERTIA,) * 3
            body.explicitinertial = True
        if self.settings.is_touched:
            contact = link.find("contact")
            friction = _value(contact, "lateral_friction", _LINK_FRICTION)
            elastic = [_value(contact, tag, 0.0) for tag in ("stiffness", "damping")]
            for number, collision in enumerate(link.findall("collision")):
                shape = _Shape(f"{name}__shape{number}", name, friction, *elastic)
                self._add_shape(body, shape, collision)
                self.shapes.append(shape)

    def _add_shape(self, body: Any, shape: _Shape, collision: ElementTree.Element) -> None:
        name, link = shape[:2]
        position, turn = _origin(collision)
        geom = body.add_geom(
            name=name, pos=position, quat=turn, contype=0, conaffinity=0, mass=0.0
        )
        geometry = collision.find("geometry")
        if geometry is None or not len(geometry):
            raise RobotDescriptionError(f"link {link!r} has a collision without geometry")
        form, types = geometry[0], mujoco.mjtGeom
        if form.tag == "box":
            geom.type = types.mjGEOM_BOX
            geom.size = [edge / 2.0 for edge in numbers_of(form, "size")]
        elif form.tag == "sphere":
            geom.type = types.mjGEOM_SPHERE
            geom.size = (*numbers_of(form, "radius"), 0.0, 0.0)
        elif form.tag == "cylinder":
            geom.type = types.mjGEOM_CYLINDER
            geom.size = (*numbers_of(form, "radius"), numbers_of(form, "length")[0] / 2.0, 0.0)
        elif form.tag == "mesh":
            found = find_mesh(form.get("filename", ""), self.description.folder)
            scale = numbers_of(form, "scale", "1 1 1")
            self._spec.add_mesh(name=name, file=str(found), scale=scale)
            geom.type, geom.meshname = types.mjGEOM_MESH, name
        else:
            raise RobotDescriptionError(f"link {link!r} has a collision shape {form.tag!r}")


def _add_joint(body: Any, joint: JointDescription, shortest: float) -> None:
    kind = "mjJNT_SLIDE" if joint.is_slide else "mjJNT_HINGE"
    is_limited = math.isfinite(joint.lower) and math.isfinite(joint.upper)
    body.add_joint(
        name=joint.name,
        type=getattr(mujoco.mjtJoint, kind),
        axis=joint.axis,
        limited=is_limited,
        range=(joint.lower, joint.upper) if is_limited else (0.0, 0.0),
        armature=joint.reflected_inertia,
        damping=joint.damping,
        frictionloss=joint.friction,
        solref_friction=(shortest, 1.0),
        solimp_friction=_FRICTION_SOLIMP,
        solref_limit=(2.0 * shortest, 1.0),
        solimp_limit=_HARD_SOLIMP,
    )


class _Contacts:
    """Writes ground, bricks, supports, and which shapes may touch."""

    def __init__(self, spec: Any, settings: WorldSettings) -> None:
        self._spec, self._settings = spec, settings
        self.touches: list[tuple[str, float, float]] = []

    def build(self, robot: _Robot) -> None:
        settings, workplace = self._settings, self._settings.workplace
        still: list[tuple[str, float]] = []
        if not settings.fixed_base:
            self._spec.worldbody.add_geom(
                name=GROUND,
                type=mujoco.mjtGeom.mjGEOM_PLANE,
                size=(0.0, 0.0, 1.0),
                contype=0,
                conaffinity=0,
            )
            still.append((GROUND, GROUND_FRICTION))
        still += [(self._add_box(each), each.friction) for each in workplace.supports]
        bricks = [(self._add_box(each), each.friction) for each in workplace.bricks]
        hand = robot.rigid.get(workplace.gripper.link) if workplace.bricks else None
        for shape in robot.shapes:
            passes = robot.rigid[shape.link] == hand
            for other, friction in (*still, *(() if passes else bricks)):
                self._pair(shape.name, other, shape.friction * friction, shape)
        for index, (name, friction) in enumerate(bricks):
            for other, others in (*still, *bricks[index + 1 :]):
                self._pair(name, other, friction * others)
        for brick in workplace.bricks:
            self._spec.add_equality(
                name=_weld(brick),
                type=mujoco.mjtEq.mjEQ_WELD,
                objtype=mujoco.mjtObj.mjOBJ_BODY,
                name1=_link(workplace.gripper.link),
                name2=_body(brick),
                active=False,
                solref=(_SHORTEST * settings.physics_period, 1.0),
                solimp=_FRICTION_SOLIMP,
            )

    def _add_box(self, box: Support) -> str:
        x, y, z, w = box.orientation
        body = self._spec.worldbody.add_body(name=_body(box), pos=box.position, quat=(w, x, y, z))
        if isinstance(box, Brick):
            body.add_freejoint(name=f"{_body(box)}__free")
        name = f"{_body(box)}__shape"
        body.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[edge / 2.0 for edge in box.size],
            contype=0,
            conaffinity=0,
            mass=box.mass if isinstance(box, Brick) else 0.0,
        )
        return name

    def _pair(self, one: str, other: str, friction: float, shape: _Shape | None = None) -> None:
        name = f"{one}__{other}"
        is_soft = shape is not None and shape.stiffness > 0.0
        shortest = max(_SHORTEST * self._settings.physics_period, 0.002)
        self._spec.add_pair(
            name=name,
            geomname1=one,
            geomname2=other,
            condim=3 if friction > 0.0 else 1,
            friction=(friction, friction, 0.0, 0.0, 0.0),
            solref=(shortest, 1.0),
            solimp=(_IMPEDANCE, _IMPEDANCE, 1e-3, 0.5, 2.0) if is_soft else _HARD_SOLIMP,
        )
        if shape is not None:
            self.touches.append((name, shape.stiffness, shape.damping))


def soften(model: Any, touches: tuple[Touch, ...]) -> None:
    """Give contacts their stiffness and damping, by the weights of the bodies as they are.

    Source: MuJoCo's documentation, "Computation", constraint model: with a constant impedance d
    the regulariser is ``R = (1 - d) / d * A``, A the inverse weight of both bodies, and the force
    at rest is ``k r / (d R)`` for ``solref = (-k, -b)``; with ``k = K R d`` it is ``K r``.
    """
    for touch in touches:
        shapes = model.pair_geom1[touch.pair], model.pair_geom2[touch.pair]
        weight = sum(model.body_invweight0[model.geom_bodyid[shape], 0] for shape in shapes)
        scale = (1.0 - _IMPEDANCE) / _IMPEDANCE * weight * _IMPEDANCE
        model.pair_solref[touch.pair] = (-touch.stiffness * scale, -touch.damping * scale)


def _indexed(model: Any, robot: _Robot, contacts: _Contacts) -> MujocoModel:
    description, settings = robot.description, robot.settings
    joints, bricks = description.joints, settings.workplace.bricks
    found = MujocoModel(
        model,
        {name: int(model.joint(name).qposadr[0]) for name in joints},
        {name: int(model.joint(name).dofadr[0]) for name in joints},
        {name: model.body(_link(name)).id for name in description.links},
        tuple(model.body(_body(brick)).id for brick in bricks),
        tuple(model.equality(_weld(brick)).id for brick in bricks),
        tuple(Touch(model.pair(name).id, k, b) for name, k, b in contacts.touches if k),
        tuple(model.geom(shape.name).id for shape in robot.shapes),
    )
    soften(model, found.touches)
    if not settings.fixed_base:
        _lower_ground(model, model.geom(GROUND).id, found, settings)
    return found


def _lower_ground(model: Any, ground: int, built: MujocoModel, settings: WorldSettings) -> None:
    """Let elastic tyres roll on their own radius.

    MuJoCo puts a contact midway between two surfaces: a tyre that sinks by s would roll on its
    radius less s / 2. A ground that lies lower by the mean s, and is felt that much earlier, bears
    the robot at the same height and has the contact on the tyre's surface.
    """
    touching = (model.pair_geom1 == ground) | (model.pair_geom2 == ground)
    stiffness = sum(each.stiffness for each in built.touches if touching[each.pair])
    if stiffness:
        robot = list(built.links.values())
        mass = float(model.body_mass[robot].sum()) + settings.payload_mass
        sink = mass * settings.gravity / stiffness
        model.geom_pos[ground, 2] = -sink
        model.geom_sameframe[ground] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE  # heed its position
        model.pair_margin[touching] = sink


def _link(name: str) -> str:
    """Return the name of a link's body: MuJoCo has a ``world`` of its own, as many URDFs have."""
    return "__link_world" if name == "world" else name


def _body(box: Support) -> str:
    return f"__box_{box.name}"


def _weld(brick: Brick) -> str:
    return f"__hold_{brick.name}"


def _origin(element: ElementTree.Element) -> tuple[list[float], Numbers]:
    """Return the place of an element's frame, and its quaternion w, x, y, z."""
    turn = np.empty(4)
    position, angles = origin_of(element)
    mujoco.mju_euler2Quat(turn, angles, "XYZ")  # about fixed axes, x first
    return position, turn


def _inertial(element: ElementTree.Element) -> tuple[float, list[float], list[float]]:
    """Return mass, centre of mass, and moments xx, yy, zz, xy, xz, yz in the link's axes."""
    centre, turn = _origin(element)
    inertia = element.find("inertia")
    xx, yy, zz, xy, xz, yz = (
        0.0 if inertia is None else float(inertia.get(name, "0"))
        for name in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    )
    flat = np.empty(9)
    mujoco.mju_quat2Mat(flat, turn)
    axes = flat.reshape(3, 3)
    matrix = axes @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ axes.T
    moments: list[float] = matrix[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]].tolist()
    return _value(element, "mass", 0.0), centre, moments


def _value(parent: ElementTree.Element | None, tag: str, default: float) -> float:
    found = None if parent is None else parent.find(tag)
    return default if found is None else float(found.get("value", default))


_failures: list[str] = []


def _note(text: str) -> None:
    """Take a warning of MuJoCo, which would write it into a file of the working folder."""
    if not text.startswith(_BENIGN):
        _failures.append(" ".join(text.split()))


mujoco.set_mju_user_warning(_note)


class MujocoPhysics:
    """:class:`~hpid_ros.simulation.physics.Physics` in MuJoCo."""

    def __init__(self, settings: WorldSettings, description: RobotDescription) -> None:
        self._settings, self._description = settings, description
        self._built = build_mujoco_model(settings, description)
        self.model: Any = self._built.model
        self.data: Any = mujoco.MjData(self.model)
        self._positions = np.array([self._built.positions[name] for name in settings.joints])
        self._velocities = np.array([self._built.velocities[name] for name in settings.joints])
        body = self._payload = self._built.links.get(settings.payload_link)
        if body is not None:
            self._bare = float(self.model.body_mass[body]), self.model.body_inertia[body].copy()
        self._root = self._built.links[description.root]
        self._held: int | None = None
        self._is_pushed = False
        self._viewer: Any = None
        self._place()
        if settings.gui:
            from mujoco import viewer

            self._viewer = viewer.launch_passive(self.model, self.data)

    def joint_states(self) -> Sequence[tuple[float, float]]:
        positions, velocities = self.data.qpos[self._positions], self.data.qvel[self._velocities]
        return list(zip(positions.tolist(), velocities.tolist(), strict=True))

    def advance(self, torques: Sequence[float], steps: int = 1) -> None:
        data = self.data
        data.qfrc_applied[self._velocities] = torques
        mujoco.mj_step(self.model, data, steps)
        if _failures:
            line = _failures[0]
            _failures.clear()
            raise RunError(f"MuJoCo: {line}")
        self._is_current = False
        if self._is_pushed:
            data.xfrc_applied[:] = 0.0
            self._is_pushed = False
        if self._viewer is not None:
            self._viewer.sync()

    def set_damping(self, damping: Sequence[float]) -> None:
        self.model.dof_damping[self._velocities] = damping

    def brake(self, forces: Sequence[float]) -> None:
        self.model.dof_frictionloss[self._velocities] = forces

    def push(self, link: str, force: Vector, torque: Vector) -> None:
        self._follow()
        body = self._built.links[link]
        arm = self.data.xpos[body] - self.data.xipos[body]
        self.data.xfrc_applied[body, :3] += force
        self.data.xfrc_applied[body, 3:] += np.asarray(torque) + np.cross(arm, force)
        self._is_pushed = True

    def load(self, mass: float) -> None:
        body, (own_mass, own_moments) = self._payload, self._bare
        self.model.body_mass[body] = own_mass + mass
        self.model.body_inertia[body] = own_moments + mass * PAYLOAD_EDGE**2 / 6.0
        self._renew()

    def link_pose(self, link: str) -> Pose:
        return self._pose(self._built.links[link])

    def root_pose(self) -> Pose:
        return self._pose(self._root)

    def root_twist(self) -> Twist:
        if self._settings.fixed_base:
            return Twist((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        self._follow()
        at = self.model.body_dofadr[self._root]
        linear, angular = self.data.qvel[at : at + 3], self.data.qvel[at + 3 : at + 6]
        turn = self.data.xmat[self._root].reshape(3, 3)
        return Twist(_vector(turn.T @ linear), _vector(angular))

    def brick_pose(self, index: int) -> Pose:
        return self._pose(self._built.bricks[index])

    def hold(self, index: int) -> None:
        self._follow()
        weld, model, data = self._built.welds[index], self.model, self.data
        hand = self._built.links[self._settings.workplace.gripper.link]
        brick = self._built.bricks[index]
        inverse, turn, place = np.empty(4), np.empty(4), np.empty(3)
        mujoco.mju_negQuat(inverse, data.xquat[hand])
        mujoco.mju_mulQuat(turn, inverse, data.xquat[brick])
        mujoco.mju_rotVecQuat(place, data.xpos[brick] - data.xpos[hand], inverse)
        # Anchor in the brick's frame, the brick's pose in the hand's, scale of the torque.
        model.eq_data[weld, :11] = (0.0, 0.0, 0.0, *place, *turn, 1.0)
        data.eq_active[weld] = 1
        self._held = weld

    def release(self) -> None:
        if self._held is not None:
            self.data.eq_active[self._held] = 0
        self._held = None

    def grip_force(self) -> Vector:
        data = self.data
        is_equality = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        rows = np.flatnonzero(is_equality & (data.efc_id == self._held))
        return _vector(data.efc_force[rows[:3]])

    def keep(self) -> None:
        data = self.data
        self._start = data.qpos.copy(), data.qvel.copy(), data.qacc_warmstart.copy()
        self._constants = {name: getattr(self.model, name).copy() for name in _KEPT}

    def restart(self) -> None:
        for name, values in self._constants.items():
            getattr(self.model, name)[:] = values
        self._renew()
        self._begin(*self._start)

    def close(self) -> None:
        if self._viewer is not None:
            self._viewer.close()
        self._viewer = self.data = None

    def _begin(self, positions: Numbers, velocities: Numbers, warm: Numbers) -> None:
        data = self.data
        mujoco.mj_resetData(self.model, data)
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = positions, velocities, warm
        self._held, self._is_pushed, self._is_current = None, False, False

    def _renew(self) -> None:
        """Bring the constants of the model up to date with its masses."""
        mujoco.mj_setConst(self.model, mujoco.MjData(self.model))
        soften(self.model, self._built.touches)

    def _follow(self) -> None:
        """Bring the poses up to date with the positions; a step leaves those of its beginning."""
        if not self._is_current:
            mujoco.mj_kinematics(self.model, self.data)
            mujoco.mj_comPos(self.model, self.data)
            self._is_current = True

    def _pose(self, body: int) -> Pose:
        self._follow()
        w, x, y, z = self.data.xquat[body].tolist()
        return Pose(_vector(self.data.xpos[body]), (x, y, z, w))

    def _place(self) -> None:
        """Put everything where it is at time 0."""
        _failures.clear()  # of another world
        settings, built = self._settings, self._built
        start = settings.start(self._description)
        if settings.payload_mass:
            self.load(settings.payload_mass)
        nothing = np.zeros(self.model.nv)
        positions = self.model.qpos0.copy()
        for name, position in start.items():
            positions[built.positions[name]] = position
        self._begin(positions, nothing, nothing)
        if not settings.is_touched:
            return
        if not settings.fixed_base:
            self._put_on_ground()
        self._settle()
        for name, position in start.items():
            self.data.qpos[built.positions[name]] = position
        self._begin(self.data.qpos.copy(), nothing, nothing)
        for brick, body in zip(settings.workplace.bricks, built.bricks, strict=True):
            require_staying(brick, self._pose(body))

    def _put_on_ground(self) -> None:
        """Set the robot down so that its lowest point touches the ground."""
        mujoco.mj_kinematics(self.model, self.data)
        ground = self.model.geom(GROUND).id
        gaps = [
            mujoco.mj_geomDistance(self.model, self.data, shape, ground, _FAR, None)
            for shape in self._built.shapes
        ]
        if gaps:
            at = self.model.jnt_qposadr[self.model.body_jntadr[self._root]]
            self.data.qpos[at + 2] -= min(gaps)
            self._is_current = False

    def _settle(self) -> None:
        """Let the robot sink into its tyres with every joint locked."""
        model, joints = self.model, list(self._built.velocities.values())
        free = model.dof_frictionloss[joints].copy()
        model.dof_frictionloss[joints] = _LOCK
        for _ in range(max(1, round(BRICK_SETTLING_TIME / self._settings.physics_period))):
            mujoco.mj_step(model, self.data)
        model.dof_frictionloss[joints] = free
        self._is_current = False


def _vector(values: Numbers) -> Vector:
    x, y, z = values.tolist()
    return x, y, z
