"""The simulated robot: efforts in, measured positions out, one control period at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from hpid_ros.base.errors import SettingError
from hpid_ros.robot.description import RobotDescription
from hpid_ros.simulation.poses import ROOT, Pose, Twist, link_pose, root_twist
from hpid_ros.simulation.settings import WorldSettings
from hpid_ros.simulation.world.bullet import Connection, pybullet
from hpid_ros.simulation.world.drivetrain import Drivetrain, EffortActuator, Sensors
from hpid_ros.simulation.world.gripper import build_gripper
from hpid_ros.simulation.world.model import bullet_urdf
from hpid_ros.simulation.world.pushes import DisturbanceSchedule
from hpid_ros.simulation.world.scene import build_scene


class World(Connection):
    """A robot in PyBullet, driven by joint torques.

    There is no control inside. The same sequence of calls gives the same numbers to the last
    bit, in any process. Joints that are not driven move freely against their friction.

    At time 0 the robot rests: its lowest point is put on the ground, it sinks into its elastic
    tyres for 0.25 s with every joint locked, then all speeds are set to zero and the joints to
    their initial positions.

    Attributes:
        settings: Settings of the world.
        description: The robot.
        gripper: Its gripper and the bricks around it; None where there are no bricks.
    """

    def __init__(self, settings: WorldSettings) -> None:
        """Build the world.

        Raises:
            RobotDescriptionError: The URDF cannot be read, or lacks a driven joint or
                a link that carries the payload or is to be pushed.
            SettingError: An initial position is impossible, or a drive does not fit its joint.
        """
        self.settings = settings
        self.description = RobotDescription.load(settings.robot_description)
        self._joints = self.description.select(settings.joints)
        settings.start(self.description)
        self._actuators = [EffortActuator(joint.name, joint.effort) for joint in self._joints]
        self._encoders = settings.encoders
        for link in settings.links:
            self.description.link(link)
        self._states: Sequence[tuple[float, float]] | None = None
        super().__init__(settings.gui)
        try:
            self._build()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> World:
        return self

    def reset(self, seed: int | None = None) -> None:
        """Go back to time 0; what follows is what would follow in a fresh world.

        Args:
            seed: What is drawn by chance is drawn anew from it; if None, from the seed as it is.
        """
        if seed is not None:
            self.settings = replace(self.settings, seed=seed)
        self._encoders = self.settings.encoders
        if self.gripper is not None:
            # Of bricks that were moved Bullet keeps contacts that are not in the saved state.
            pybullet.removeState(self._at_start, physicsClientId=self._client)
            pybullet.resetSimulation(physicsClientId=self._client)
            self._build()
            return
        if self._scene.payload is not None:
            self._scene.load_payload(self._client, self.settings.payload_mass)
        pybullet.restoreState(self._at_start, physicsClientId=self._client)
        self._begin()

    @property
    def time_ns(self) -> int:
        """Simulated time, a whole number of control periods, in [ns]."""
        return self._periods * self.settings.control_period_ns

    def read(self) -> tuple[float, ...]:
        """Return the encoders' positions of the driven joints, in [rad]."""
        if self._sensors is not None:
            return self._sensors.positions
        return tuple(
            [
                encoder.read(state[0])
                for encoder, state in zip(self._encoders, self._joint_states(), strict=True)
            ]
        )

    def read_velocities(self) -> tuple[float, ...] | None:
        """Return the measured velocities of the driven joints, in [rad/s]; None if unmeasured."""
        return None if self._sensors is None else self._sensors.velocities

    def true_positions(self) -> tuple[float, ...]:
        """Return the exact positions of the driven joints, in [rad]."""
        return tuple([state[0] for state in self._joint_states()])

    def true_velocities(self) -> tuple[float, ...]:
        """Return the exact velocities of the driven joints, in [rad/s]."""
        return tuple([state[1] for state in self._joint_states()])

    def applied_efforts(self) -> tuple[float, ...]:
        """Return what the motors gave in the last control period, in [N m]; 0 at time 0.

        It is at the joint, their mean over the period; friction and gear loss are not taken off.
        """
        return self._applied

    def step(self, efforts: Sequence[float]) -> None:
        """Advance by one control period; the efforts stand in every physics step of it.

        Args:
            efforts: Commanded effort of each driven joint, in [N m]; held to the URDF's limits.

        Raises:
            SettingError: There is not one finite effort for each driven joint.
        """
        if len(efforts) != len(self._actuators):
            raise SettingError(f"{len(efforts)} efforts for {len(self._actuators)} driven joints")
        torques = [
            actuator.torque(effort)
            for actuator, effort in zip(self._actuators, efforts, strict=True)
        ]
        self._schedule.advance(self.time_ns)
        if self.gripper is not None:
            self.gripper.actuate(self.time_ns)
        if self._drivetrain is None:
            for _ in range(self.settings.physics_steps):
                self._advance(torques)
            self._applied = tuple(torques)
        else:
            self._applied = self._drivetrain.step(self._periods, torques, self._advance)
        self._periods += 1
        self._states = None
        if self.gripper is not None:
            self.gripper.update(self.time_ns)
        if self._sensors is not None:
            self._sensors.sample(self.true_positions())

    def link_pose(self, name: str) -> Pose:
        """Return the pose of a link's frame.

        Raises:
            RobotDescriptionError: The robot has no such link.
        """
        return link_pose(self._client, self._scene.body, self._link(name))

    def base_pose(self) -> Pose:
        """Return the pose of the robot's root link."""
        return link_pose(self._client, self._scene.body, ROOT)

    def base_velocity(self) -> Twist:
        """Return the velocity of the robot's root link, in that link's frame."""
        return root_twist(self._client, self._scene.body)

    def apply_wrench(
        self, link: str, force: Sequence[float], torque: Sequence[float], duration_ns: int
    ) -> None:
        """Push a link from the next step on.

        Args:
            link: Name of the link.
            force: Force on the origin of the link's frame, in the world frame, in [N].
            torque: Torque, in the world frame, in [N m].
            duration_ns: How long, in [ns]; rounded to whole physics steps, at least one.

        Raises:
            RobotDescriptionError: The robot has no such link.
            SettingError: A component is not finite, or the duration is not positive.
        """
        if duration_ns <= 0:
            raise SettingError(f"duration {duration_ns} ns of a wrench must be positive")
        self._schedule.push(link, force, torque, duration_ns)

    def set_payload(self, mass: float) -> None:
        """Change the payload, a solid cube at the payload link; until the next reset.

        Args:
            mass: Mass, in [kg].

        Raises:
            RobotDescriptionError: The robot has no payload link.
            SettingError: The mass is negative or not finite.
        """
        self._schedule.load(mass)

    def _build(self) -> None:
        """Build the scene in an empty simulation, and keep its state for every reset."""
        settings = self.settings
        urdf = bullet_urdf(
            self.description,
            is_touched=not settings.fixed_base or bool(settings.workplace),
            is_shown=settings.gui,
        )
        self._scene = build_scene(self._client, urdf, self.description, self.settings)
        self._drivetrain = (
            None
            if self.settings.has_ideal_drives
            else Drivetrain(self._client, self._scene, self.settings, self._joints)
        )
        self._schedule = DisturbanceSchedule(self._client, self._scene, self.description, settings)
        self.gripper = build_gripper(self._client, self._scene, self.settings)
        self._at_start: int = pybullet.saveState(physicsClientId=self._client)
        self._begin()

    def _begin(self) -> None:
        """Start counting at time 0."""
        self._periods = 0
        self._applied = (0.0,) * len(self._actuators)
        self._states = None
        self._schedule.begin()
        if self._drivetrain is not None:
            self._drivetrain.reset()
        is_bare = self.settings.has_bare_encoders
        self._sensors: Sensors | None = (
            None if is_bare else Sensors(self.settings, self.true_positions())
        )

    def _link(self, name: str) -> int:
        """Return Bullet's index of a link that exists."""
        return self._scene.links[self.description.link(name)]

    def _joint_states(self) -> Sequence[tuple[float, float]]:
        """Return Bullet's states of the driven joints, asked for once a period."""
        states = self._states
        if states is None:
            states = self._states = pybullet.getJointStates(
                self._scene.body, self._scene.driven, physicsClientId=self._client
            )
        return states

    def _advance(self, torques: Sequence[float]) -> None:
        """Take one physics step with these torques at the driven joints, in [N m]."""
        self._schedule.apply()
        # Bullet forgets applied torques after every step.
        pybullet.setJointMotorControlArray(
            self._scene.body,
            self._scene.driven,
            pybullet.TORQUE_CONTROL,
            forces=torques,
            physicsClientId=self._client,
        )
        pybullet.stepSimulation(physicsClientId=self._client)
        if self.gripper is not None:
            self.gripper.sample_contacts()
