"""The model's terms against Pinocchio's own forward dynamics, and the iteration they make."""

import math

import numpy as np
import pinocchio
import pytest
from harness.examples import examples
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import RobotDescriptionError, SettingError
from hpid_ros.base.resources import share_folder
from hpid_ros.control import JointLoop, LoopSettings
from hpid_ros.robot.compensation import (
    Compensator,
    DecouplingShare,
    GravityShare,
    RobotDynamics,
    RobotState,
    RobotStates,
)
from hpid_ros.robot.coupling import coupling, relaxation
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.differential_drive import DifferentialDrive
from hpid_ros.robot.dynamics import Dynamics, JointSpace, build_model, velocity_index

ROBOT = RobotDescription.load(share_folder() / "urdf" / "mobile_manipulator.urdf")
DRIVE = DifferentialDrive.of(ROBOT, "wheel_left_joint", "wheel_right_joint")
SECOND = 1_000_000_000

seeds = st.integers(0, 2**32 - 1)


def draw(space, seed):
    """Return positions, velocities and efforts of all joints, and wanted accelerations."""
    chance = np.random.default_rng(seed)
    count = len(space.joints)
    return (
        chance.uniform(-3.0, 3.0, count),
        chance.uniform(-3.0, 3.0, count),
        chance.uniform(-30.0, 30.0, count),
        chance.uniform(-20.0, 20.0, count),
    )


def decoupled_effort(space, joint, positions, velocities, efforts, wanted):
    """Return the effort that gives one joint an acceleration, the others' efforts given."""
    share = DecouplingShare(RobotDynamics(space), joint)
    gain, effort = share.term(RobotState(positions, velocities, efforts))
    return gain * wanted + effort


def full(model, space, positions, velocities, efforts):
    """Return configuration, velocities and torques of Pinocchio's whole model."""
    moved, rates, torques = np.zeros((3, model.nv))
    for name, position, rate, effort in zip(
        space.joints, positions, velocities, efforts, strict=True
    ):
        row = velocity_index(model, name)
        moved[row], rates[row] = position, rate
        torques[row] = effort - ROBOT.joints[name].damping * rate
    return pinocchio.integrate(model, pinocchio.neutral(model), moved), rates, torques


@pytest.mark.parametrize("payload", [0.0, 2.0])
@given(seed=seeds)
@examples(0.4)
def test_fixed_base_decoupled_joint_accelerates_as_wanted_by_pinocchios_aba(payload, seed):
    space = JointSpace(ROBOT, payload_mass=payload)
    positions, velocities, efforts, wanted = draw(space, seed)
    model = build_model(ROBOT, payload_mass=payload)
    for index, joint in enumerate(space.joints):
        given_efforts = efforts.copy()
        given_efforts[index] = decoupled_effort(
            space, joint, positions, velocities, efforts, wanted[index]
        )
        state = full(model, space, positions, velocities, given_efforts)
        acceleration = pinocchio.aba(model, model.createData(), *state)
        row = velocity_index(model, joint)
        assert acceleration[row] == pytest.approx(wanted[index], rel=1e-9, abs=1e-9)


def rolling_acceleration(model, space, rates_of_joints, positions, efforts):
    """Return the joints' accelerations with wheels that roll, by Lagrange multipliers.

    The base flies freely in the model; it is held level, and each wheel's lowest point is held
    to the ground without slip: nothing of this uses the projection that is tested.
    """
    configuration, rates, torques = full(model, space, positions, rates_of_joints, efforts)
    twist = DRIVE.twist(
        *(rates_of_joints[space.joints.index(name)] for name in (DRIVE.left, DRIVE.right))
    )
    rates[0], rates[5] = twist.linear, twist.angular
    data = model.createData()
    pinocchio.computeJointJacobians(model, data, configuration)
    pinocchio.computeJointJacobiansTimeVariation(model, data, configuration, rates)
    aligned = pinocchio.LOCAL_WORLD_ALIGNED
    rows, drift = [], []
    base = model.getFrameId(ROBOT.root)
    level = [2, 3, 4]  # up, roll, pitch
    for name, which in ((base, level), *((model.getFrameId(each), None) for each in DRIVE.joints)):
        jacobian = pinocchio.getFrameJacobian(model, data, name, aligned)
        change = pinocchio.getFrameJacobianTimeVariation(model, data, name, aligned)
        if which is None:  # the contact lies below the centre: lever (0, 0, -r)
            lever = pinocchio.skew(np.array([0.0, 0.0, -DRIVE.radius]))
            jacobian = (jacobian[:3] - lever @ jacobian[3:])[:2]
            change = (change[:3] - lever @ change[3:])[:2]
        else:
            jacobian, change = jacobian[which], change[which]
        rows.append(jacobian)
        drift.append(change @ rates)
    held, drift = np.vstack(rows), np.concatenate(drift)
    assert np.abs(held @ rates).max() < 1e-12  # the velocities keep the constraints
    mass = pinocchio.crba(model, data, configuration)
    bias = pinocchio.nonLinearEffects(model, data, configuration, rates)
    count = len(held)
    system = np.block([[mass, held.T], [held, np.zeros((count, count))]])
    answer = np.linalg.lstsq(system, np.concatenate([torques - bias, -drift]), rcond=1e-13)[0]
    return [answer[velocity_index(model, name)] for name in space.joints]


@given(seed=seeds)
@examples(0.25)
def test_rolling_base_decoupled_joint_accelerates_as_wanted_by_constrained_dynamics(seed):
    space = JointSpace(ROBOT, DRIVE, payload_mass=1.0)
    model = build_model(ROBOT, pinocchio.JointModelFreeFlyer(), payload_mass=1.0)
    positions, velocities, efforts, wanted = draw(space, seed)
    for index, joint in enumerate(space.joints):
        given_efforts = efforts.copy()
        given_efforts[index] = decoupled_effort(
            space, joint, positions, velocities, efforts, wanted[index]
        )
        found = rolling_acceleration(model, space, velocities, positions, given_efforts)
        assert found[index] == pytest.approx(wanted[index], rel=1e-9, abs=1e-8)


def test_gravity_is_that_of_pinocchio_and_a_rolling_base_feels_none():
    space = JointSpace(ROBOT, DRIVE, payload_mass=0.7)
    positions, velocities, efforts, _ = draw(space, 5)
    expected = Dynamics(ROBOT, payload_mass=0.7).gravity_torques(
        space.joints, dict(zip(space.joints, positions, strict=True))
    )
    for joint in space.joints:
        gain, effort = GravityShare(space, joint).term(RobotState(positions, velocities, efforts))
        assert gain == 1.0
        assert effort == pytest.approx(expected[joint], abs=1e-12)
    assert expected[DRIVE.left] == pytest.approx(0.0, abs=1e-12)


def test_a_scaled_model_has_scaled_gravity_and_the_same_rotors():
    whole, half = JointSpace(ROBOT), JointSpace(ROBOT, mass_scale=0.5)
    pose, rest = (0.4,) * 8, (0.0,) * 8
    assert half.gravity(pose) == pytest.approx(0.5 * whole.gravity(pose))
    rotors = np.diag([ROBOT.joints[name].reflected_inertia for name in whole.joints])
    bodies = [space.equations(pose, rest).mass - rotors for space in (whole, half)]
    assert bodies[1] == pytest.approx(0.5 * bodies[0])


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"locked": ["elbow"]}, RobotDescriptionError, "elbow"),
        ({"payload_mass": -1.0}, SettingError, "payload_mass"),
        ({"mass_scale": 0.0}, SettingError, "mass_scale"),
        ({"payload_mass": 1.0, "payload_link": "hook"}, RobotDescriptionError, "hook"),
    ],
)
def test_a_model_that_cannot_be_is_refused(options, error, words):
    with pytest.raises(error, match=words):
        JointSpace(ROBOT, **options)


def test_a_joint_that_moves_no_mass_is_refused():
    xml = ROBOT.xml.replace('<mass value="', '<mass value="1e-30" was="')
    xml = xml.replace("drake:rotor_inertia value=", "drake:rotor_inertia value='0' was=")
    for axis in "xyz":
        xml = xml.replace(f'i{axis}{axis}="', f'i{axis}{axis}="0" was{axis}="')
    with pytest.raises(RobotDescriptionError, match="moves no mass"):
        JointSpace(RobotDescription.load(xml))


# The iteration that the nodes make together


@pytest.mark.parametrize("drive", [None, DRIVE])
def test_the_nodes_iteration_settles_as_fast_as_its_radius_says(drive):
    """Efforts that are one sample old, behind the filter: the error shrinks by the radius."""
    space = JointSpace(ROBOT, drive)
    found = coupling(space, samples=60)
    assert found.radius() < 1.0
    positions, velocities, _, wanted = draw(space, 8)
    equations = space.equations(positions, velocities)
    fixed_point = equations.mass @ wanted + equations.bias
    mobility = np.linalg.inv(equations.mass)
    own = np.diag(1.0 / np.diagonal(mobility))
    values = np.linalg.eigvals(own @ mobility).real
    shares = [DecouplingShare(RobotDynamics(space), joint) for joint in space.joints]
    for alpha in (1.0, relaxation(found.filter_time_constant(0.001), 0.001)):
        radius = np.abs(1.0 - alpha * values).max()
        seen, size = np.zeros(8), np.inf
        for _ in range(60):
            terms = [share.term(RobotState(positions, velocities, seen)) for share in shares]
            efforts = np.array([g * v + e for (g, e), v in zip(terms, wanted, strict=True)])
            seen = seen + alpha * (efforts - seen)
            # In this norm the iteration's matrix is symmetric: every step shrinks by the radius.
            before, size = size, np.linalg.norm((seen - fixed_point) / np.sqrt(np.diag(own)))
            assert size <= radius * before + 1e-9
        assert size < 1e-6


def test_uncoupled_joints_need_no_filter_and_coupling_is_reproducible():
    space = JointSpace(ROBOT, DRIVE)
    assert coupling(space, 30) == coupling(space, 30)
    found = coupling(JointSpace(ROBOT, locked=[*DRIVE.joints, *(
        f"arm_joint_{k}" for k in (1, 3, 4, 5, 6))]), 5)  # fmt: skip
    assert (found.least, found.largest) == pytest.approx((1.0, 1.0))
    assert found.filter_time_constant(0.001) == pytest.approx(0.0)


# States that are not as they should be


def states(joints=("a", "b"), needs_efforts=True, **options):
    loop = LoopSettings.from_parameters({"joint": "a", "gains.p": 1.0, "gains.d": 1.0})
    return RobotStates(loop, joints, needs_efforts, **options)


class Sum:
    """A model whose term tells what it was told."""

    needs_efforts = True

    def term(self, state):
        return 2.0, sum(state.positions) + sum(state.efforts)


def test_the_turns_of_the_joints_own_encoder_are_added_up():
    own = {"joint": "a", "gains.p": 1.0, "gains.d": 1.0, "encoder_wrap": 1.5}
    found = RobotStates(LoopSettings.from_parameters(own), ("b", "a"), needs_efforts=False)
    for k in range(300):
        position = math.remainder(0.02 * k, 1.5)
        state = found.observe(k * 10_000_000, (position, position), (0.0, 2.0), None)
        assert state.positions == pytest.approx((position, 0.02 * k))
    for stamp_ns in (310 * SECOND, 3 * SECOND, 4 * SECOND, 4 * SECOND + 1):
        # A stamp that is wrong, the next state, and a gap: as the loop, it keeps them.
        state = found.observe(stamp_ns, (0.0, position), (0.0, 2.0), None)
        assert state.positions[1] == pytest.approx(0.02 * 299)
    assert state.velocities[1] == 2.0
    found.reset()
    found.observe(300 * 10_000_000, (0.0, 0.0), (0.0, 2.0), None)
    found.retune(LoopSettings.from_parameters({**own, "encoder_wrap": 3.0}))
    for k in range(300):
        position = math.remainder(0.02 * k, 3.0)
        state = found.observe((301 + k) * 10_000_000, (0.0, position), (0.0, 2.0), None)
    assert state.positions[1] == pytest.approx(0.02 * 299)


def test_efforts_that_stay_exactly_zero_are_noticed_where_a_model_needs_them():
    measured, needed = states(), states()
    for k in range(1500):
        measured.observe(k * 1_000_000, (0.0, 0.0), None, (0.0, 0.1 * (k % 900 == 0)))
        needed.observe(k * 1_000_000, (0.0, 0.0), None, (0.0, 0.0))
        assert needed.lacks_efforts == (k > 1001) or k in (1000, 1001)
    assert not measured.lacks_efforts


@pytest.mark.parametrize(
    ("positions", "velocities", "efforts"),
    [
        ((0.0, math.nan), None, (0.0, 0.0)),
        ((0.0, 1e12), None, (0.0, 0.0)),
        ((0.0, 0.0), (math.inf, 0.0), (0.0, 0.0)),
        ((0.0, 0.0), None, (0.0, math.nan)),
        ((math.inf, -math.inf), None, (0.0, 0.0)),
        ((0.0, 0.0), None, None),
    ],
)
def test_an_unusable_state_gets_the_last_term_for_state_timeout_and_then_none(
    positions, velocities, efforts
):
    compensator = Compensator(Sum(), states())
    bad = positions, velocities, efforts
    assert compensator.term(0, *bad) is None
    good = compensator.term(SECOND, (1.0, 2.0), None, (3.0, 4.0))
    assert good == (2.0, 10.0, True)
    assert compensator.term(SECOND + 100_000_000, *bad) == good
    assert compensator.term(SECOND + 100_000_001, *bad) is None
    assert (compensator.states.held, compensator.states.lost) == (1, 2)
    assert compensator.states.last_fault
    assert compensator.term(SECOND + 200_000_000, (1.0, 2.0), None, (3.0, 4.0)) == good


@pytest.mark.parametrize("lost", [120, 150, 250])
def test_after_an_outage_the_first_term_is_that_of_where_the_robot_is_then(lost):
    """A takeover by the term from before would become a jump with the next state."""
    values = {"joint": "a", "gains.p": 10.0, "gains.i": 5.0, "u_clamp_max": 90.0}
    settings = LoopSettings.from_parameters(
        {**values, "u_clamp_min": -90.0, "compensation": "gravity"}
    )
    loop, compensator = JointLoop(settings), Compensator(Sum(), states())

    def answer(k, other):
        stamp_ns = SECOND + k * 1_000_000
        term = compensator.term(stamp_ns, (0.1, other), (0.0, 0.0), (3.0, 4.0))
        return term, compensator.answer(loop, stamp_ns, 0.1, 0.0, term)

    for k in range(5):
        answer(k, 2.0)
    for k in range(5, 5 + lost):
        answer(k, math.nan)
    first, before = answer(5 + lost, 9.0)
    second, after = answer(6 + lost, 9.0)
    assert first == second
    assert after == pytest.approx(before, abs=1e-6)


def test_bad_states_leave_no_trace_in_the_velocities():
    one, other = states(), states()
    for k in range(20):
        position = 0.01 * k
        for each in (one, other):
            found = each.observe(k * 1_000_000, (position, 0.0), None, (0.0, 0.0))
        one.observe(k * 1_000_000 + 500_000, (math.nan, 1e300), None, (0.0, 0.0))
        one.hold(k * 1_000_000 + 600_000, "no joint b")
    assert one.observe(20_000_000, (0.2, 0.0), None, (0.0, 0.0)) == other.observe(
        20_000_000, (0.2, 0.0), None, (0.0, 0.0)
    )
    assert found.velocities[0] > 8.0


def test_velocities_that_nobody_uses_may_be_no_numbers():
    filtered, loop = states(), {"joint": "a", "velocity_source": "filtered"}
    filtered.retune(LoopSettings.from_parameters(loop))
    for stamp_ns in (0, 1_000_000):
        found = filtered.observe(stamp_ns, (0.1, 0.2), (math.nan, math.nan), (0.0, 0.0))
    assert found.velocities == [0.0, 0.0]
    assert states().observe(0, (0.1, 0.2), (math.nan, 0.0), (0.0, 0.0)) is None


def test_a_repeat_changes_nothing_and_a_clock_that_goes_back_starts_anew():
    observed = states()
    first = observed.observe(SECOND, (0.0, 0.0), None, (1.0, 1.0))
    second = observed.observe(SECOND + 1_000_000, (0.1, 0.0), None, (1.0, 1.0))
    assert observed.observe(SECOND + 1_000_000, (9.0, 9.0), None, None) is second
    assert second.velocities[0] > 0.0
    assert observed.observe(SECOND, (0.0, 0.0), None, (1.0, 1.0)) is second  # it may be wrong
    assert observed.observe(SECOND + 1000, (0.0, 0.0), None, (1.0, 1.0)) == first
    for k in range(2):
        found = observed.observe(SECOND // 2 + k, (0.0, 0.0), None, (1.0, 1.0))
    assert found.velocities == [0.0, 0.0]
    assert observed.hold(0, "went back, and unusable") is None


def test_efforts_go_through_the_low_pass():
    observed = states(filter_time_constant=0.003)
    observed.observe(0, (0.0, 0.0), None, (1.0, 0.0))
    for k in range(1, 4):
        found = observed.observe(k * 1_000_000, (0.0, 0.0), None, (5.0, 0.0))
    assert found.efforts[0] == pytest.approx(5.0 - 4.0 * 0.75**3)


def test_retuning_holds_for_the_model_too():
    values = {"joint": "a", "velocity_source": "filtered", "velocity_filter_time_constant": 0.0}
    observed = states()
    observed.observe(0, (0.0, 0.0), (9.0, 9.0), (0.0, 0.0))
    observed.retune(LoopSettings.from_parameters({**values, "state_timeout": 0.02}))
    observed.observe(1_000_000, (0.0, 0.0), (9.0, 9.0), (0.0, 0.0))
    found = observed.observe(2_000_000, (0.001, 0.0), (9.0, 9.0), (0.0, 0.0))
    assert found.velocities == pytest.approx([1.0, 0.0])
    assert observed.hold(21_000_000, "no joint b") is found
    assert observed.hold(23_000_000, "no joint b") is None


@pytest.mark.parametrize("answer", [(0.0, 1.0), (math.nan, 1.0), (1.0, math.inf), (-1.0, 1.0)])
def test_a_model_that_gives_nonsense_gives_no_term(answer):
    class Broken(Sum):
        def term(self, state):
            return answer

    compensator = Compensator(Broken(), states())
    assert compensator.term(0, (0.0, 0.0), None, (0.0, 0.0)) is None
    assert "the model gave" in compensator.states.last_fault
