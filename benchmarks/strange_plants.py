"""Joints as the package's simulators have none: what a prediction has to hold on nevertheless.

One link on one motor, integrated here: friction that creeps, sticks, differs by direction or
grows with the load, ripple, a flexible or loose transmission, a drive that saturates, is late or
has few steps, coarse or noisy encoders, velocities behind a driver's own filter, efforts that are
stamped late, a recorder started while the joint held its load, a link of another mass than its
URDF says. The controller is the package's loop; all else is written for this purpose alone.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

GRAVITY = 9.81
_SUBSTEPS = 20
_STICTION_SPEED = 0.05  # [rad/s], at which Stribeck friction has fallen to 1/e


@dataclass(frozen=True)
class Plant:
    """A joint that turns about a horizontal axis."""

    kind: str  # in a word or two
    mass: float = 2.0  # of the link, a point, in [kg]
    length: float = 0.35  # its distance from the axis, in [m]
    rotor: float = 0.12  # reflected, in [kg m^2]
    viscous: float = 0.2  # in [N m s/rad]
    coulomb: float = 0.35  # in [N m]
    stiction: float = 0.0  # beside it when creeping, in [N m]
    one_way: float = 0.0  # share by which friction is more forward, and less backward
    load_share: float = 0.0  # of the motor's effort, lost in the gear
    ripple: float = 0.0  # of the motor's torque, in [N m], seven times a turn
    stiffness: float = 0.0  # between rotor and link, in [N m/rad]; 0 is rigid
    play: float = 0.0  # between rotor and link, in [rad]
    limit: float = math.inf  # of what the drive gives whatever is asked for, in [N m]
    effort_step: float = 0.0  # of what the drive gives, in [N m]; 0 is none
    delay: int = 0  # by which it acts late, in control periods
    lag: float = 0.0  # time constant of the drive, in [s]
    counts: int = 2**16  # of the encoder, per turn, on the motor's side; 0 is none
    noise: float = 2e-5  # standard deviation of the measured position, in [rad]
    known_mass: float = 1.0  # what the URDF says, over the truth
    velocity: str = ""  # how the driver filters the velocity that it reports; empty for none
    velocity_time: float = 0.0  # time constant of that filter, or length of its mean, in [s]
    velocity_noise: float = 0.0  # of a sensor of velocity; differences have that of positions
    hold_time: float = 0.0  # for which the joint holds its load before the recorder starts, [s]
    late_stamps: int = 0  # control periods by which efforts are stamped late

    @property
    def inertia(self) -> float:
        """All that the motor moves, in [kg m^2]."""
        return self.rotor + self.mass * self.length**2

    def urdf(self, effort: float) -> str:
        """Return what the owner knows: the link, and a limit of the effort."""
        mass = self.mass * self.known_mass
        tiny = 1e-6
        return f"""<robot name="strange"><link name="stand"/><link name="arm"><inertial>
<origin xyz="0 0 {-self.length}"/><mass value="{mass}"/>
<inertia ixx="{tiny}" iyy="{tiny}" izz="{tiny}" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="arm" type="revolute"><parent link="stand"/><child link="arm"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="{effort}" velocity="20"/></joint></robot>"""


class VelocityReport:
    """The velocity that a driver reports, from the positions that it measures."""

    def __init__(self, plant: Plant, period: float) -> None:
        self._kind, self._period = plant.velocity, period
        poles = {"two poles": 2}.get(plant.velocity, 1)
        self._share = 1.0 - math.exp(-period * poles / max(plant.velocity_time, 1e-9))
        self._stages = [0.0] * poles
        self._window = deque[float](maxlen=max(2, round(plant.velocity_time / period) + 1))

    def update(self, position: float) -> float:
        """Return the velocity after one more position."""
        if not self._window:
            self._window.append(position)
        self._window.append(position)
        if self._kind == "mean":
            steps = [b - a for a, b in pairwise(self._window)]
            return sum(steps) / len(steps) / self._period
        value = (self._window[-1] - self._window[-2]) / self._period
        for k, stage in enumerate(self._stages):
            value = self._stages[k] = stage + self._share * (value - stage)
        return value


class Motion:
    """A plant that moves."""

    def __init__(self, plant: Plant, period: float, start: float, seed: int) -> None:
        self._plant, self._dt = plant, period / _SUBSTEPS
        self._rotor = self._link = start
        self._rotor_speed = self._link_speed = 0.0
        self._chance = np.random.default_rng(seed)
        self._under_way = deque([0.0] * plant.delay)
        self._torque = 0.0
        self._report = VelocityReport(plant, period)

    def read(self) -> tuple[float, float | None]:
        """Return position and velocity as the driver reports them, in [rad] and [rad/s]."""
        plant = self._plant
        at = self._rotor + plant.noise * float(self._chance.standard_normal())
        if plant.counts:
            count = math.tau / plant.counts
            at = round(at / count) * count
        if not plant.velocity:
            return at, None
        if plant.velocity_noise:  # a sensor of its own, behind the same filter
            velocity = self._report.update(self._rotor)
            return at, velocity + plant.velocity_noise * float(self._chance.standard_normal())
        return at, self._report.update(at)

    def step(self, effort: float) -> None:
        """Move on by one control period under an effort, in [N m]."""
        plant = self._plant
        self._under_way.append(effort)
        asked = self._under_way.popleft()
        if plant.effort_step:
            asked = round(asked / plant.effort_step) * plant.effort_step
        asked = min(max(asked, -plant.limit), plant.limit)
        for _ in range(_SUBSTEPS):
            if plant.lag:
                self._torque += (asked - self._torque) * self._dt / plant.lag
            else:
                self._torque = asked
            if plant.stiffness:
                self._move_both()
            else:
                self._move_rigid()

    def _friction(self, speed: float) -> float:
        plant = self._plant
        level = plant.coulomb + plant.load_share * abs(self._torque)
        level += plant.stiction * math.exp(-((speed / _STICTION_SPEED) ** 2))
        return level * (1.0 + math.copysign(plant.one_way, speed))

    def _weight(self, at: float) -> float:
        plant = self._plant
        return -plant.mass * GRAVITY * plant.length * math.sin(at)

    def _slowed(self, speed: float, torque: float, inertia: float) -> float:
        """Return the next speed; what is slower than friction can stop in a step, sticks."""
        free = speed + self._dt * (torque - self._plant.viscous * speed) / inertia
        loss = self._dt * self._friction(free) / inertia
        return math.copysign(max(abs(free) - loss, 0.0), free)

    def _drive(self) -> float:
        return self._torque + self._plant.ripple * math.sin(7.0 * self._rotor)

    def _move_rigid(self) -> None:
        torque = self._drive() + self._weight(self._rotor)
        self._rotor_speed = self._slowed(self._rotor_speed, torque, self._plant.inertia)
        self._rotor += self._dt * self._rotor_speed

    def _move_both(self) -> None:
        plant = self._plant
        twist, slip = self._rotor - self._link, self._rotor_speed - self._link_speed
        half = 0.5 * plant.play
        is_touching = abs(twist) >= half
        stretch = twist - math.copysign(half, twist) if is_touching else 0.0
        own = plant.mass * plant.length**2
        damping = 0.05 * math.sqrt(plant.stiffness * own) if is_touching else 0.0
        passed = plant.stiffness * stretch + damping * slip
        self._rotor_speed = self._slowed(self._rotor_speed, self._drive() - passed, plant.rotor)
        self._link_speed += self._dt * (passed + self._weight(self._link)) / own
        self._rotor += self._dt * self._rotor_speed
        self._link += self._dt * self._link_speed


_PLAIN = Plant("Coulomb friction")

PLANTS = (
    _PLAIN,
    replace(_PLAIN, kind="weak drive", limit=5.0),
    replace(_PLAIN, kind="stiction", stiction=0.4),
    replace(_PLAIN, kind="one-way friction", one_way=0.4),
    replace(_PLAIN, kind="lossy gear", load_share=0.15),
    replace(_PLAIN, kind="ripple", ripple=0.3),
    replace(_PLAIN, kind="flexible", stiffness=1500.0),
    replace(_PLAIN, kind="play", stiffness=6000.0, play=2e-3),
    replace(_PLAIN, kind="late", delay=4),
    replace(_PLAIN, kind="lagging drive", lag=4e-3),
    replace(_PLAIN, kind="few effort steps", effort_step=0.1),
    replace(_PLAIN, kind="coarse encoder", counts=2**12, noise=0.0),
    replace(_PLAIN, kind="fine encoder", counts=2**20, noise=1e-6),
    replace(_PLAIN, kind="noisy encoder", counts=0, noise=2e-4),
    replace(_PLAIN, kind="heavier than said", known_mass=0.85),
    replace(_PLAIN, kind="hardly any friction", coulomb=0.02, viscous=0.02),
    replace(_PLAIN, kind="filtered velocity", velocity="one pole", velocity_time=5e-3),
    replace(_PLAIN, kind="slow velocity", velocity="one pole", velocity_time=15e-3),
    replace(_PLAIN, kind="two-pole velocity", velocity="two poles", velocity_time=8e-3),
    replace(_PLAIN, kind="mean velocity", velocity="mean", velocity_time=8e-3),
    replace(
        _PLAIN,
        kind="velocity sensor",
        velocity="one pole",
        velocity_time=3e-3,
        velocity_noise=0.01,
    ),
    replace(_PLAIN, kind="very coarse encoder", counts=2**10, noise=0.0),
    replace(_PLAIN, kind="loaded at the start", hold_time=4.0),
    replace(_PLAIN, kind="efforts stamped late", late_stamps=6),
)


def drawn(seed: int) -> Plant:
    """Return a plant of one of the kinds, its numbers drawn, with a second strangeness or none."""
    chance = np.random.default_rng([seed, 7])
    plant = PLANTS[seed % len(PLANTS)]
    scale = float(np.exp(chance.uniform(math.log(0.5), math.log(2.0))))
    changes: dict[str, float | int] = {
        "mass": plant.mass * scale,
        "rotor": plant.rotor * scale * float(chance.uniform(0.5, 1.5)),
        "viscous": plant.viscous * scale * float(chance.uniform(0.3, 2.0)),
        "coulomb": plant.coulomb * scale * float(chance.uniform(0.3, 1.5)),
        "stiction": plant.stiction * scale,
        "ripple": plant.ripple * scale,
        "limit": plant.limit * scale,
        "stiffness": plant.stiffness * scale,
        "effort_step": plant.effort_step * scale,
        "velocity_time": plant.velocity_time * scale,
    }
    if plant.counts == _PLAIN.counts:
        changes["counts"] = 2 ** int(chance.integers(14, 21))
        changes["noise"] = float(np.exp(chance.uniform(math.log(2e-6), math.log(1e-4))))
    if not plant.delay:
        changes["delay"] = int(chance.integers(0, 3))
    return replace(plant, **changes)  # type: ignore[arg-type]
