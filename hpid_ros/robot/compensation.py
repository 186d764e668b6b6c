r"""Model terms of a loop: built, checked, and computed from the states of all joints.

The paper's control action in its corrected form, with :math:`B = M^{-1}`, :math:`A = -B h`:

.. math:: u_j = B_{jj}^{-1} \left[ \ddot q^*_j + v_j - A_j - \sum_{k \ne j} B_{jk} u_k \right]

makes :math:`\ddot q_j = \ddot q^*_j + v_j` whatever the other joints do: the controller's output
:math:`v_j` acts on a unit double integrator. The other joints' efforts :math:`u_k` are measured.

Source: the paper, section "Implementation of hPID on the mobile manipulator"; there the factor
in front of the controller's term is missing.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from hpid_ros.base.errors import SettingError, unknown_name
from hpid_ros.base.units import SECONDS_PER_NANOSECOND, Numbers
from hpid_ros.control.assembly import make_velocity_source
from hpid_ros.control.joint_loop import JointLoop
from hpid_ros.control.model import ModelTerm
from hpid_ros.control.reference import LARGEST_POSITION
from hpid_ros.control.settings import LoopSettings
from hpid_ros.control.velocity import Unwrapper
from hpid_ros.robot.coupling import (
    Settling,
    coupling_of,
    model_source,
    model_space,
    require_joint,
)
from hpid_ros.robot.dynamics import JointSpace

_NO_TIME = -1  # before every stamp of a usable state


class RobotState(NamedTuple):
    """One state of a robot, along the joints of its model."""

    positions: Sequence[float]  # [rad] measured
    velocities: Sequence[float]  # [rad/s] measured, or estimated from the positions
    efforts: Sequence[float]  # [N m] measured, behind the filter; zeros where they are not needed


_WITHOUT_EFFORTS = 1.0  # [s]


class RobotStates:
    """Makes of measured states what a model can use, or holds the last one for a while.

    Velocities come from the source that the loop's own velocity comes from, one for each joint.
    Efforts go through a first-order low-pass by backward Euler. A state that cannot be used
    (a joint is missing, a number is not finite, there are no efforts) is answered with the last
    one that could, for at most ``state_timeout`` by the stamps.
    """

    def __init__(
        self,
        settings: LoopSettings,
        joints: Sequence[str],
        needs_efforts: bool,
        filter_time_constant: float = 0.0,
        endless: Collection[str] = (),
    ) -> None:
        self.held = self.lost = 0
        self.last_fault = ""
        self.joints = tuple(joints)
        self._settings = settings
        self._timeout = settings.timing.state_timeout
        self._velocities = [make_velocity_source(settings.velocity) for _ in self.joints]
        self._own = self.joints.index(settings.joint)
        self._unwrappers = {
            place: Unwrapper(math.tau) for place, name in enumerate(joints) if name in endless
        }
        self._heed_encoder(settings)
        self._needs_efforts = needs_efforts
        self._time_constant = filter_time_constant
        self._no_efforts = (0.0,) * len(self.joints)
        self.reset()

    def reset(self) -> None:
        """Forget the past: the next state is the first one."""
        self._restart(is_gap=False)

    def _restart(self, is_gap: bool) -> None:
        for velocity in self._velocities:
            velocity.reset()
        for unwrapper in self._unwrappers.values():
            unwrapper.interrupt() if is_gap else unwrapper.reset()
        self._stamp_ns = self._beyond_ns = _NO_TIME
        self._state: RobotState | None = None
        self._without_efforts = 0.0

    def retune(self, settings: LoopSettings) -> None:
        """Go by other settings of the loop from the next state on."""
        if settings.velocity.in_use != self._settings.velocity.in_use:
            self._velocities = [make_velocity_source(settings.velocity) for _ in self.joints]
            if self._state is not None:
                for source, *state in zip(self._velocities, *self._state[:2], strict=True):
                    source.start_from(*state)
        if settings.encoder.encoder_wrap != self._settings.encoder.encoder_wrap:
            self._heed_encoder(settings)
        self._settings, self._timeout = settings, settings.timing.state_timeout

    def _heed_encoder(self, settings: LoopSettings) -> None:
        """Add up the turns of the loop's own joint; of the others' encoders nothing is known."""
        turn = settings.encoder.encoder_wrap
        if turn >= 0.0:  # else it is as the robot has it
            turn = turn or math.inf
            self._unwrappers.setdefault(self._own, Unwrapper(turn)).set_turn(turn)

    def observe(
        self,
        stamp_ns: int,
        positions: Sequence[float],
        velocities: Sequence[float] | None,
        efforts: Sequence[float] | None,
    ) -> RobotState | None:
        state = self._state
        if stamp_ns == self._stamp_ns and state is not None:
            return state
        if not self._settings.velocity.is_measured:
            velocities = None  # the remedy for drivers that fill in what is no number
        fault = self._fault(positions, velocities, efforts)
        if fault:
            return self.hold(stamp_ns, fault)
        dt = (stamp_ns - self._stamp_ns) * SECONDS_PER_NANOSECOND
        is_odd = dt > self._timeout or (dt < 0.0 and not self._settings.timing.is_simulated)
        if state is not None and is_odd and self._is_first_beyond(stamp_ns):
            return state  # its stamp may be wrong, and the loop passes over it
        if state is not None and not 0.0 < dt <= self._timeout:
            self._restart(is_gap=dt > 0.0)
        self._beyond_ns = _NO_TIME
        before, self._stamp_ns = self._state, stamp_ns
        if before is None:
            dt = 0.0
        if self._unwrappers:
            positions = list(positions)
            for place, unwrapper in self._unwrappers.items():
                positions[place] = unwrapper.update(positions[place])
        rates: Sequence[float | None] = velocities or (None,) * len(positions)
        found = [
            source.update(position, rate, dt)
            for source, position, rate in zip(self._velocities, positions, rates, strict=True)
        ]
        seen = self._no_efforts if efforts is None or not self._needs_efforts else efforts
        self._without_efforts = 0.0 if any(seen) else self._without_efforts + dt
        if before is not None and self._time_constant:
            share = dt / (self._time_constant + dt)
            seen = [a + share * (b - a) for a, b in zip(before.efforts, seen, strict=True)]
        self._state = RobotState(positions, found, seen)
        return self._state

    def _is_first_beyond(self, stamp_ns: int) -> bool:
        """Tell whether a state is the first one with an odd stamp, as the loop has it."""
        before_ns, self._beyond_ns = self._beyond_ns, stamp_ns
        if before_ns == _NO_TIME or stamp_ns < before_ns:
            return True
        if stamp_ns < self._stamp_ns:  # and so was the one before
            return False
        longest_ns = self._timeout / SECONDS_PER_NANOSECOND
        return stamp_ns - before_ns > longest_ns >= before_ns - self._stamp_ns

    @property
    def lacks_efforts(self) -> bool:
        """Whether those that the model needs have all been exactly 0 for a while.

        Drivers fill in zeros for what they do not measure.
        """
        return self._needs_efforts and self._without_efforts > _WITHOUT_EFFORTS

    def undo(self) -> None:
        """Forget where the loop's own joint was last: it was not there."""
        if self._own in self._unwrappers:
            self._unwrappers[self._own].undo()

    def hold(self, stamp_ns: int, reason: str) -> RobotState | None:
        """Return the last usable state in place of one that is not, if it is recent."""
        self.last_fault = reason
        if self._state is not None:
            self._beyond_ns = stamp_ns
        elapsed = (stamp_ns - self._stamp_ns) * SECONDS_PER_NANOSECOND
        if self._state is not None and 0.0 <= elapsed <= self._timeout:
            self.held += 1
            return self._state
        self.lost += 1
        return None

    def _fault(
        self,
        positions: Sequence[float],
        velocities: Sequence[float] | None,
        efforts: Sequence[float] | None,
    ) -> str:
        """Return what makes a state unusable; empty if nothing."""
        if not _are_possible(positions):
            return f"positions of the model: {self._worst(positions)}"
        if velocities is not None and not _are_possible(velocities):
            return f"velocities of the model: {self._worst(velocities)}"
        if self._needs_efforts:
            if efforts is None:
                return "the states have no efforts, which decoupling needs"
            if not _are_possible(efforts):
                return f"efforts of the model: {self._worst(efforts)}"
        return ""

    def _worst(self, values: Sequence[float]) -> str:
        """Return the first joint whose number is out of bounds, with the number."""
        for joint, value in zip(self.joints, values, strict=True):
            if not -LARGEST_POSITION <= value <= LARGEST_POSITION:
                return f"{joint} {value}"
        return "beyond all bounds"


def _are_possible(values: Sequence[float]) -> bool:
    """Return whether all numbers are finite and within bounds."""
    # A sum is finite only if nothing in it is nan, with which min and max would be blind.
    is_within = min(values) >= -LARGEST_POSITION and max(values) <= LARGEST_POSITION
    return is_within and math.isfinite(sum(values))


class Compensator:
    """Gives one joint's loop the model's term of each state."""

    def __init__(self, model: GravityShare | DecouplingShare, states: RobotStates) -> None:
        self.states = states
        self._model = model
        self._follows = model.needs_efforts

    def term(
        self,
        stamp_ns: int,
        positions: Sequence[float],
        velocities: Sequence[float] | None,
        efforts: Sequence[float] | None,
    ) -> ModelTerm | None:
        """Return the term of one measured state."""
        return self._of(self.states.observe(stamp_ns, positions, velocities, efforts))

    def hold(self, stamp_ns: int, reason: str) -> ModelTerm | None:
        """Return the term of the last usable state for one that is not, if it is recent."""
        return self._of(self.states.hold(stamp_ns, reason))

    def answer(
        self,
        loop: JointLoop,
        stamp_ns: int,
        position: float,
        velocity: float | None,
        term: ModelTerm | None,
    ) -> float:
        """Return the effort that answers a state, in [N m]: ``fallback_effort`` without a term."""
        if term is None:
            return loop.reject(stamp_ns, f"no model term: {self.states.last_fault}")
        jumps = loop.counts.jumps
        effort = loop.step(stamp_ns, position, velocity, term)
        if loop.counts.jumps > jumps:
            self.states.undo()
        return effort

    def reset(self) -> None:
        """Forget the past: the next state is the first one."""
        self.states.reset()

    def _of(self, state: RobotState | None) -> ModelTerm | None:
        if state is None:
            return None
        try:
            gain, effort = self._model.term(state)
        except ArithmeticError as error:
            self.states.last_fault = str(error)
            return None
        if not (0.0 < gain < math.inf and math.isfinite(effort)):
            self.states.last_fault = f"the model gave an effort of {effort} and a gain of {gain}"
            return None
        return ModelTerm(gain, effort, self._follows)


class CompensatedLoops:
    """Answers one state after the other as the controllers' nodes would."""

    def __init__(
        self,
        joints: Sequence[str],
        loops: Sequence[JointLoop],
        compensators: Sequence[Compensator | None],
    ) -> None:
        self._loops = tuple(zip(loops, compensators, strict=True))
        self._places = {
            each.states.joints: [_place(name, joints) for name in each.states.joints]
            for each in compensators
            if each is not None
        }

    def step(
        self,
        stamp_ns: int,
        positions: Sequence[float],
        velocities: Sequence[float] | None,
        efforts: Sequence[float],
    ) -> list[float]:
        """Take one measured state, with the efforts that the motors gave in the period before.

        Returns:
            The efforts that answer it, in [N m].
        """
        seen = {
            names: (
                [positions[place] for place in places],
                None if velocities is None else [velocities[place] for place in places],
                [efforts[place] for place in places],
            )
            for names, places in self._places.items()
        }
        answers = []
        for row, (loop, model) in enumerate(self._loops):
            velocity = None if velocities is None else velocities[row]
            if model is None:
                answers.append(loop.step(stamp_ns, positions[row], velocity))
                continue
            term = model.term(stamp_ns, *seen[model.states.joints])
            answers.append(model.answer(loop, stamp_ns, positions[row], velocity, term))
        return answers


def _place(joint: str, joints: Sequence[str]) -> int:
    if joint not in joints:
        raise SettingError(
            f"the states lack a joint of the model: {unknown_name('joint', joint, joints)}; "
            f"model.locked_joints holds joints that are not driven"
        )
    return joints.index(joint)


class GravityShare:
    """Effort that holds one joint against gravity."""

    needs_efforts = False

    def __init__(self, space: JointSpace, joint: str) -> None:
        self.space = space
        self._row = space.joints.index(joint)

    def term(self, state: RobotState) -> tuple[float, float]:
        """Return gain 1 and the effort in [N m] at one state."""
        return 1.0, float(self.space.gravity(state.positions)[self._row])


class RobotDynamics:
    """Solves the equations of motion once for each state, however many joints ask."""

    def __init__(self, space: JointSpace) -> None:
        from scipy.linalg import lapack  # slow to import, and only needed here

        self.space, self.lapack = space, lapack
        self._state: RobotState | None = None
        self._solved: tuple[Numbers, Numbers, Numbers]

    def at(self, state: RobotState) -> tuple[Numbers, Numbers, Numbers]:
        """Return the Cholesky factor of the mass matrix, bias and efforts [N m] at a state."""
        if state is self._state:
            return self._solved
        mass, bias = self.space.equations(state.positions, state.velocities)
        factor, failed = self.lapack.dpotrf(mass, clean=False)
        if failed:
            raise ArithmeticError("the model's mass matrix is not positive definite")
        self._solved = factor, bias, np.array(state.efforts)
        self._state = state
        return self._solved


class DecouplingShare:
    """What decouples one joint from the others."""

    needs_efforts = True

    def __init__(self, dynamics: RobotDynamics, joint: str) -> None:
        self.dynamics = dynamics
        self.space = dynamics.space
        self._row = self.space.joints.index(joint)
        self._unit = np.zeros(len(self.space.joints))
        self._unit[self._row] = 1.0

    def term(self, state: RobotState) -> tuple[float, float]:
        """Return what one unit of acceleration costs, and what the dynamics do, at one state."""
        factor, bias, efforts = self.dynamics.at(state)
        row = self._row
        column, _ = self.dynamics.lapack.dpotrs(factor, self._unit)  # of B, which is symmetric
        gain = 1.0 / float(column[row])
        load = bias - efforts
        load[row] = bias[row]
        return gain, gain * float(column @ load)


class LoopModel(NamedTuple):
    """One joint's model, ready to run."""

    compensator: Compensator  # gives the term of each state
    text: str  # what it is, in one line for people


def loop_model(settings: LoopSettings, robot: str) -> LoopModel | None:
    """Build the model of one joint's loop."""
    if not settings.model.is_on:
        return None
    dynamics, states = _of_the_robot(settings, robot)
    return LoopModel(_of_the_joint(settings, dynamics, states), _text(settings, robot, dynamics))


def compensators(loops: Sequence[LoopSettings], robot: str) -> list[Compensator | None]:
    """Build the models of the loops of one process; what they have in common they share."""
    shared: dict[tuple[object, ...], tuple[RobotDynamics, RobotStates]] = {}
    found: list[Compensator | None] = []
    for settings in loops:
        if not settings.model.is_on:
            found.append(None)
            continue
        timing = settings.timing
        own = settings.joint if settings.encoder.encoder_wrap > 0.0 else ""
        key = (settings.model, timing.control_period, timing.state_timeout, settings.velocity, own)
        if key not in shared:
            shared[key] = _of_the_robot(settings, robot)
        found.append(_of_the_joint(settings, *shared[key]))
    return found


def _of_the_robot(settings: LoopSettings, robot: str) -> tuple[RobotDynamics, RobotStates]:
    """Return the dynamics, and what completes the states for them."""
    model = settings.model
    space = model_space(model, model_source(model, robot))
    time_constant = 0.0
    if model.is_decoupling:
        found = Settling.of(settings, coupling_of(settings, robot))
        if not found.is_settling:
            raise SettingError(found.text)
        time_constant = found.time_constant
    described = space.description.joints
    endless = [name for name in space.joints if described[name].is_continuous]
    states = RobotStates(settings, space.joints, model.is_decoupling, time_constant, endless)
    return RobotDynamics(space), states


def _of_the_joint(
    settings: LoopSettings, dynamics: RobotDynamics, states: RobotStates
) -> Compensator:
    """Return one joint's share of the robot's dynamics."""
    require_joint(settings.joint, states.joints)
    if settings.model.is_decoupling:
        return Compensator(DecouplingShare(dynamics, settings.joint), states)
    return Compensator(GravityShare(dynamics.space, settings.joint), states)


def _text(settings: LoopSettings, robot: str, dynamics: RobotDynamics) -> str:
    """Say in one line what a model is."""
    model = settings.model
    base = (
        f"rolling on {model.left_wheel} and {model.right_wheel}"
        if model.left_wheel
        else "its root held fixed (no model.left_wheel is named)"
    )
    count = len(dynamics.space.joints)
    text = f"compensation {model.compensation}: model of {count} joints, {base}"
    if not model.is_decoupling:
        return text
    return f"{text}; {Settling.of(settings, coupling_of(settings, robot)).text}"
