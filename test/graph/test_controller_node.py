"""One controller in a process of its own; the test plays the robot."""

import itertools
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from harness.fork_server import run_node
from harness.goals import needs_control_msgs
from harness.graph import NAME, Told, ros_arguments
from harness.loops import loop_settings, pure_loop
from rcl_interfaces.srv import DescribeParameters
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from hpid_ros.base.resources import share_folder
from hpid_ros.control import LOOP_PARAMETERS, JointLoop, LoopSettings
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.messages.joint_trajectory import encode_joint_trajectory
from hpid_ros.motion import minimum_jerk
from hpid_ros.nodes.core.middleware import LATCHED, RARE
from hpid_ros.robot.compensation import compensators
from hpid_ros.robot.description import RobotDescription

MS = 1_000_000
GAINS = {"gains__p": 10.0, "gains__i": 4.0, "gains__d": 2.0}


def states(count, start=0):
    return [(k * MS, 0.3 * math.sin(0.01 * k), 3.0 * math.cos(0.01 * k)) for k in range(count)][
        start:
    ]


def test_an_observers_estimate_is_published_and_a_lack_of_inertia_is_told(harness):
    estimates, told = [], Told(harness)
    name = "/elbow_controller/estimate"
    harness.node.create_subscription(JointState, name, estimates.append, RARE)
    values = {"law": "pid", "velocity_source": "observer", "velocity_filter_time_constant": 0.01}
    controller = harness.start_controller(introspection_rate=-1.0, **values, **GAINS)
    twin = pure_loop(**values, **GAINS)
    for state in states(20):
        assert harness.ask(*state) == twin.step(*state)
    assert not estimates
    changes = {"law": "hpid", "mu": -0.2}, {"law": "pid"}
    for change in changes:
        assert harness.set_parameters("elbow_controller", **change) == (True, "")
    harness.wait(
        lambda: controller.log.read_text().count("norm's floor for mu = -0.2") == 1,
        what="the warning of the floor",
    )
    harness.wait(
        lambda: "needs the parameter inertia" in told.newest().get("message", ""),
        what="the warning",
    )
    assert harness.set_parameters("elbow_controller", inertia=0.5) == (True, "")
    twin.retune(twin.settings.with_parameters({"inertia": 0.5}))
    for state in states(60, start=20):
        assert harness.ask(*state) == twin.step(*state)
    last = 59 * MS
    harness.wait(lambda: estimates and estimates[-1].header.stamp.nanosec == last, what="it")
    seen = estimates[-1]
    assert list(seen.name) == ["elbow"]
    assert (seen.position[0], seen.velocity[0], seen.effort[0]) == twin.estimation.observer_state(
        twin.law.model_gain
    )


VALUES = {"law": "hpid", "mu": -0.3, "norm__effort_scale": 3.0, "norm__floor": 0.1}
VALUES |= {"gains__p": 100.0, "gains__i": 400.0, "gains__d": 14.0, "inertia": 0.5}
CHANGES = [  # that they make no jump is the loop's: test_safety.py
    {"norm__effort_scale": 6.0, "mu": -0.1},
    {"gains__p": 120.0, "gains__d": 16.0},
    {"velocity_source": "observer"},
    {"observer__bandwidth": 90.0, "observer__feed_disturbance": True},
    {"inertia": 0.7},
    {"law": "pid"},
    {"law": "hpid", "mu": 0.3, "gains__p": 100.0, "gains__d": 14.0},
    {"velocity_source": "filtered", "feedforward__inertia": 0.5},
    {"feedforward__viscous_friction": 0.8, "feedforward__coulomb_friction": 1.5},
    {"velocity_source": "homogeneous_differentiator"},
    {"velocity_source": "measured"},
]


def test_a_node_that_is_retuned_in_motion_does_what_its_loop_does(harness):
    motion = minimum_jerk([0.0, 1.0, 2.0], {"elbow": [0.0, 0.4, -0.4]})
    publisher = harness.node.create_publisher(JointTrajectory, "joint_trajectory", LATCHED)
    publisher.publish(encode_joint_trajectory(motion))
    harness.start_controller(**VALUES, wait_for_reference=True)
    values, loop = dict(VALUES), pure_loop(**VALUES)
    loop.follow(motion.column("elbow"))
    stamps = iter(range(2000))
    for change in [{}, *CHANGES]:
        if change:
            values |= change
            assert harness.set_parameters("elbow_controller", **change) == (True, "")
            loop.retune(loop_settings(**values))
        for at in (next(stamps) for _ in range(60)):
            state = at * MS, 0.2 * math.sin(3e-3 * at), 0.6 * math.cos(3e-3 * at)
            assert harness.ask(*state) == loop.step(*state)


HOOK = {"model.payload": 1.0, "model.payload_link": "hook"}
REFUSED_SETS = [
    ({"gains__p": 20.0, "mu": 0.5}, "0.4999"),
    ({"gains__p": 20.0, "gains__d": math.nan}, "gains.d"),
    ({"gains__p": 20.0, "gains__i": 1000.0}, "p d = 40 must exceed i x inertia = 500"),
    ({"gains__p": 20.0, "law": "PID"}, "hpid, pid"),
    ({"gains__p": 20.0, "joint": "wrist"}, "read-only"),
    ({"gains__p": 20.0, "gains__d": "4O.0"}, "gains.d must be a double"),
    ({"gains__p": 20.0, "gain__d": 40.0}, "unknown parameter 'gain.d'"),
    ({"u_clamp_min": 1.0, "u_clamp_max": -1.0}, "u_clamp_min"),
]


def test_a_refused_set_says_why_and_leaves_no_trace(harness):
    harness.start_controller(law="pid", inertia=0.5, **GAINS)
    twin, samples = pure_loop(law="pid", **GAINS), iter(states(100))
    for changes, reason in REFUSED_SETS:
        for atomically in (True, False) if "joint" not in changes else (True,):
            is_successful, why = harness.set_parameters(NAME, atomically, **changes)
            assert (is_successful, reason in why, "\n" in why) == (False, True, False), why
            for state in itertools.islice(samples, 5):
                assert harness.ask(*state) == twin.step(*state)


def test_a_joint_that_had_no_usable_state_is_left_without_an_effort(harness):
    node = harness.start_controller(law="pid", fallback_effort=5.0, **GAINS)
    assert harness.ask_newcomer(MS, 0.1, velocity=math.nan) == 5.0
    node.process.terminate()
    harness.wait(lambda: node.process.poll() is not None, what="the end")
    harness.wait(lambda: harness.commands[-1].effort == (0.0,), what="a zero")


def test_the_robots_stops_and_limits_hold_whatever_the_clamps_say(harness):
    """Those of the description, as if they were parameters."""
    joint = "arm_joint_6"
    settings = {"joint": joint, "law": "pid", "gains__p": 0.1, "gains__d": 0.1}
    settings |= {"soft_stop__k_position": 10.0, "soft_stop__k_velocity": 3.0}
    urdf = "urdf/mobile_manipulator.urdf"
    harness.start_controller(robot_description=urdf, **settings)
    robot = RobotDescription.load(urdf).joints[joint]
    limits = {"position_max": robot.upper, "position_min": robot.lower}
    limits |= {"velocity_max": robot.velocity, "u_clamp_max": robot.effort}
    limits |= {"u_clamp_min": -robot.effort}
    cases = (2.88, 1.0, "position_max"), (-2.88, -1.0, "position_min"), (0.0, 4.5, "velocity_max")
    for turn, (position, velocity, limit) in enumerate(cases):
        within = pure_loop(**settings, **limits)
        beyond = pure_loop(**settings, **{k: v for k, v in limits.items() if k != limit})
        for k in range(3):
            # A clock that goes back starts the loop again.
            sample = ((10 * (9 - turn) + k) * MS, position + k * 1e-3 * velocity, velocity)
            effort = harness.ask(*sample, joint=joint)
            assert effort == within.step(*sample)
            assert abs(effort) > abs(beyond.step(*sample)) + 0.5  # it brakes
    for stamp_ns, clamp, limit in ((MS, 2.5, 2.5), (2 * MS, 99.0, robot.effort)):
        assert harness.set_parameters(NAME, u_clamp_max=clamp)[0]
        assert harness.ask(stamp_ns, 0.0, -9.0, joint=joint) == limit


def test_parameters_are_described_and_a_slider_moves_from_end_to_end_without_a_refusal(harness):
    """rqt and Foxglove draw a slider where there is a range, else a field for a number."""
    harness.start_controller(law="hpid", **GAINS)
    request = DescribeParameters.Request(names=list(LOOP_PARAMETERS))
    name = "elbow_controller/describe_parameters"
    found = harness.call(DescribeParameters, name, request).descriptors
    for described in found:
        spec = LOOP_PARAMETERS[described.name]
        assert described.description == spec.description
        if isinstance(spec.default, float):
            allowed = f"from {spec.minimum:g} to {spec.maximum:g}"
            assert described.additional_constraints == allowed
    sliders = {
        each.name: each.floating_point_range[0] for each in found if each.floating_point_range
    }
    assert set(sliders) == {"mu", "observer.degree"}
    stamps = iter(range(10**9, 10**12, 10**9))
    for name, bounds in sliders.items():
        for value in np.linspace(bounds.from_value, bounds.to_value, 5):
            assert harness.set_parameters("elbow_controller", **{name: float(value)}) == (True, "")
            assert abs(harness.ask(next(stamps), 0.1)) < 1e3


ACTION = "follow_joint_trajectory"
# Nothing is known of a degree without the inertia.
UNCERTIFIED = {"joint": "a", "mu": 0.1, "require_certificate": True}
MODELLED = {
    "joint": "arm_joint_3",
    "compensation": "decoupling",
    "gains.p": 300.0,
    "gains.d": 30.0,
    "robot_description": "urdf/mobile_manipulator.urdf",
}


@pytest.mark.parametrize(
    ("executable", "given", "line"),
    [
        ("joint_controller", {}, "joint"),
        ("joint_controller", {"joint": "a", "gain.p": 1.0}, "did you mean 'gains.p'"),
        ("joint_controller", {"joint": "a", "mu": 1.0}, "joint_controller: Parameter mu"),
        ("joint_controller", {"joint": "a", "gains.p": ".nan"}, "gains.p"),
        ("joint_controller", {"joint": "a", "gains.p": "much"}, "gains.p must be a double"),
        ("joint_controller", {"joint": "a", "command_interface": "can"}, "command_interface"),
        ("joint_controller", {"joint": "a", "compensation": "gravity"}, "description is empty"),
        ("joint_controller", {"joint": "a", "cpu_affinity": "[4096]"}, "4096"),
        *(
            ("joint_controller", {"joint": "a", f"feedforward.{name}": -1.0}, f"takes the {word}")
            for name, word in (("viscous_friction", "damping"), ("coulomb_friction", "friction"))
        ),
        (
            "joint_controller",
            {"joint": "a", "realtime_priority": 100},
            "at least 0 and at most 99, not 100",
        ),
        ("joint_controller", {**MODELLED, "model.locked_joints": "arm_joint_3"}, "lacks it"),
        ("joint_controller", {**MODELLED, "model.left_wheel": "wheel_left_joint"}, "right_wheel"),
        ("joint_controller", {**MODELLED, **HOOK}, "hook"),
        ("joint_controller", {**MODELLED, "joint": "arm_joint_9"}, "did you mean 'arm_joint_"),
        ("joint_controller", UNCERTIFIED, "mu = 0.1 is not certified stable"),
        ("joint_controllers", {}, "each joint once"),
        ("mujoco_bridge", {"mode": "fast"}, "lockstep, realtime"),
        ("mujoco_bridge", {"joints": "[arm_joint_9]"}, "did you mean 'arm_joint_"),
        ("mujoco_bridge", {"robot_description": "none.urdf"}, "none.urdf"),
        ("trajectory_publisher", {}, "reference_file"),
        ("trajectory_publisher", {"reference_file": "none.yaml"}, "none.yaml"),
        ("bag_recorder", {}, "bag and topics"),
        ("bag_recorder", {"bag": "."}, "exists already"),
        ("joint_controller", ["--params-file", "none.yaml"], "none.yaml"),
        ("joint_controller", ["--bogus"], "--bogus"),
        ("joint_controller", ["-p", "joint"], "parameter override"),
        ("joint_controller", {"joint": "a", "introspection_rate": ".nan"}, "not nan"),
        ("joint_controllers", {"joints": f"[{'a' * 191}]"}, "cannot have a node: its name"),
        ("joint_controllers", {"joints": "[a]", "gain.p": 1.0}, "'gains.p'"),
        ("mujoco_bridge", {"duration": ".nan"}, "duration must lie in"),
        ("mujoco_bridge", {"wrench_duration": ".nan"}, "wrench_duration must lie in"),
        ("bag_recorder", {"bag": "new", "topics": "[a b]"}, "'a b'"),
        ("bag_recorder", {"bag": "new", "topics": "[a, a]"}, "each topic once"),
        ("bag_metrics", {}, "bags"),
        ("bag_metrics", {"bags": "[none]"}, "none"),
        ("live.live_tuner", {"rate": 200.0}, "rate"),
        ("live.live_tuner", {"host": "0.0.0.0", "open_browser": False}, "host"),
        *(
            pytest.param(ACTION, {"joints": "[elbow]", **given}, line, marks=needs_control_msgs)
            for given, line in (
                ({"joints": "[]"}, "each joint once"),
                ({"angle_wraparound": "[wrist]"}, "angle_wraparound: unknown joint"),
                ({"multi_turn": "[wrist]"}, "multi_turn: unknown joint"),
                ({"state_topics": "[a, b, a]"}, "each topic once"),
                ({"state_timeout": 100.0}, "state_timeout"),
                ({"robot_description": "none.urdf"}, "none.urdf"),
                ({"constraints__wrist__goal": 1.0}, "unknown parameter"),
            )
        ),
    ],
)
@pytest.mark.usefixtures("module_harness")  # for its domain
def test_a_node_that_cannot_start_says_one_line_and_ends_with_two(
    tmp_path, executable, given, line
):
    arguments = given if isinstance(given, list) else ros_arguments(**given)
    ended = run_node(executable, arguments, cwd=tmp_path)
    assert ended.returncode == 2
    assert line in ended.stderr.strip().splitlines()[-1]
    assert "Traceback" not in ended.stderr
    assert len(ended.stderr.strip().splitlines()) == 1 or isinstance(given, list)
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("library", "module", "parameters", "line"),
    [
        ("control_msgs", f"nodes.{ACTION}", "state_timeout:=0.5", "ros-jazzy-control-msgs"),
        (
            "control_msgs",
            "nodes.joint_command_merger",
            "command_interface:=dynamic_joint_state",
            "needs the package control_msgs",
        ),
        ("nicegui", "live.live_tuner", "port:=0", "pip install 'hpid_ros[live]'"),
    ],
)
@pytest.mark.usefixtures("module_harness")  # for its domain
def test_a_library_that_is_missing_is_one_line_as_well(library, module, parameters, line):
    joints = [] if "live" in module else ["-p", "joints:=[elbow]"]
    arguments = ["x", "--ros-args", *joints, "-p", parameters]
    house = "hpid_bench" if "live" in module else "hpid_ros"
    program = (
        f"import sys; sys.modules[{library!r}] = None; "
        f"from {house}.{module} import main; sys.exit(main({arguments}))"
    )
    ended = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert ended.returncode == 2
    (said,) = ended.stderr.strip().splitlines()
    assert line in said


def test_health_tells_period_compute_time_and_missed_samples(harness):
    health = Told(harness)
    harness.start_controller(law="pid", **GAINS)
    # It may be deaf: to its operator it must not look well.
    harness.wait(lambda: health.says(message="waiting for the first state"), what="a report")
    assert health.newest()["level"] == DiagnosticStatus.WARN
    for k in (0, 1, 2, 5):
        harness.ask(k * MS, 0.0)
    harness.wait(lambda: health.says(samples="4"), what="a report of all samples")
    told = health.newest()
    assert told["level"] == DiagnosticStatus.OK
    assert told["missed samples"] == "2"
    assert told["scheduling"] == "ordinary"
    assert float(told["compute time, median [us]"]) > 0.0
    median, p99 = (float(told[f"period, {x} [us]"]) for x in ("median", "99th percentile"))
    assert 0.0 < median <= p99
    assert float(told["jitter [us]"]) == pytest.approx(p99 - median, rel=1e-3)


def test_priority_and_affinity_reach_every_thread_or_are_told_as_refused(harness):
    cpu = min(os.sched_getaffinity(0))
    process = harness.processes.start(
        "elbow_controller",
        "joint_controller",
        [
            *ros_arguments(joint="elbow", law="pid", realtime_priority=5, **GAINS),
            "-p",
            f"cpu_affinity:=[{cpu}]",
        ],
    )
    harness.wait(lambda: harness.states.get_subscription_count() > 0, what="the controller")
    threads = [int(path.name) for path in Path(f"/proc/{process.pid}/task").iterdir()]

    def policies():
        each = (os.sched_getscheduler(thread) for thread in threads)
        return {policy & ~os.SCHED_RESET_ON_FORK for policy in each}

    if "refused by the system" in process.log.read_text():
        assert os.SCHED_FIFO not in policies()
    else:  # the thread of the timers, which begins last, is reached by the first of them
        harness.wait(lambda: policies() == {os.SCHED_FIFO}, what="all threads")
    assert all(os.sched_getaffinity(thread) == {cpu} for thread in threads)


@pytest.mark.parametrize(
    ("limit", "given", "line"),
    [
        ("velocity='3'", {}, "no effort limit for elbow: give it one, or set u_clamp_max"),
        ("effort='9' velocity='0'", {}, "no velocity limit for elbow: give it one, or set vel"),
        ("velocity='3'", {"u_clamp_max": 9.0}, "no effort limit"),  # upwards alone
    ],
)
@pytest.mark.usefixtures("module_harness")  # for its domain
def test_a_joint_that_its_description_was_to_limit_is_not_driven_without(
    tmp_path, limit, given, line
):
    (tmp_path / "arm.urdf").write_text(LIFT.replace('effort="40" velocity="0.5"', limit))
    arguments = ros_arguments(joint="elbow", robot_description=tmp_path / "arm.urdf", **given)
    ended = run_node("joint_controller", arguments)
    assert ended.returncode == 2
    assert line in ended.stderr


LIFT = """<robot name="lift"><link name="base"/><link name="car"/>
<joint name="elbow" type="prismatic"><parent link="base"/><child link="car"/>
<limit lower="-1" upper="2" effort="40" velocity="0.5"/></joint></robot>"""


def test_a_joint_that_slides_has_its_units_everywhere(harness, tmp_path):
    (tmp_path / "lift.urdf").write_text(LIFT)
    told = Told(harness)
    process = harness.start_controller(
        law="hpid", mu=-0.1, robot_description=tmp_path / "lift.urdf", gains__p=10.0
    )
    for stamp_ns in (0, MS):
        harness.ask(stamp_ns, 0.25)
    harness.wait(lambda: "error [m]" in told.newest(), what="the health")
    assert {"effort [N]", "integral term [N]"} <= told.newest().keys()
    (line,) = [each for each in process.log.read_text().splitlines() if "active: " in each]
    assert line.endswith(
        "active: joint elbow, hpid with mu = -0.1, within [-40, 40] N, [-1, 2] m, "
        "[-0.5, 0.5] m/s; holding its position: 0.25 m"
    )
    names = ["gains.p", "gains.d", "position_max", "u_clamp_max", "inertia"]
    request = DescribeParameters.Request(names=names)
    asked = harness.call(DescribeParameters, f"{NAME}/describe_parameters", request)
    for each, unit in zip(asked.descriptors, ["N/m", "N s/m", "m", "N", "kg"], strict=True):
        assert f"[{unit}]" in each.description


# --- with a model of the robot

ROBOT = str(share_folder() / "urdf" / "mobile_manipulator.urdf")
JOINTS = tuple(RobotDescription.load(ROBOT).joints)
ELBOW = "arm_joint_3"
MODEL_PARAMETERS = {
    "gains__p": 300.0,
    "gains__i": 0.0,
    "gains__d": 30.0,
    "law": "pid",
    "robot_description": ROBOT,
    "compensation": "decoupling",
    "model__left_wheel": "wheel_left_joint",
    "model__right_wheel": "wheel_right_joint",
    "introspection_rate": -1.0,
    "state_timeout": 0.01,
}


def ask_whole(harness, stamp_ns, names=JOINTS, positions=None, efforts=None):
    """Publish one state of the whole robot and return the effort that answers it."""
    count = len(names)
    template = JointStateTemplate(names, position=True, velocity=True, effort=efforts is not None)
    raw = template.encode(
        stamp_ns,
        position=positions or [0.3] * count,
        velocity=[0.0] * count,
        effort=efforts or (),
    )
    return harness.answer(stamp_ns, lambda: harness.states.publish(raw))


def in_this_process():
    """Return the loop and the model that the node should be."""
    values = {
        key.replace("__", "."): value
        for key, value in MODEL_PARAMETERS.items()
        if key not in ("robot_description", "introspection_rate")
    }
    settings = LoopSettings.from_parameters({"joint": ELBOW, **values})
    (model,) = compensators([settings], ROBOT)
    return JointLoop(settings), model


def test_a_node_with_a_model_answers_whole_states_and_survives_those_that_are_not(harness):
    terms, told = [], Told(harness)
    harness.node.create_subscription(JointState, f"{NAME}/terms", terms.append, RARE)
    harness.start_controller(joint=ELBOW, state_watchdog=False, **MODEL_PARAMETERS)
    loop, model = in_this_process()
    order = model.states.joints
    efforts = [0.5 * k for k in range(len(JOINTS))]
    seen = [efforts[JOINTS.index(name)] for name in order]

    def expected(stamp_ns):
        term = model.term(stamp_ns, [0.3] * 8, [0.0] * 8, seen)
        return loop.step(stamp_ns, 0.3, 0.0, term)

    for k in range(1, 4):
        answer = ask_whole(harness, k * MS, efforts=efforts)
        assert answer == expected(k * MS)
    assert answer != 0.0
    backwards = ask_whole(harness, 4 * MS, names=JOINTS[::-1], efforts=efforts[::-1])
    assert backwards == expected(4 * MS)
    # A joint is missing, no efforts, efforts that are none: the last term stands ...
    others = [name for name in JOINTS if name != "arm_joint_1"]
    bad = [*efforts[:-1], float("nan")]
    for stamp_ns, state in (
        (5 * MS, {"names": others, "efforts": efforts[1:]}),
        (6 * MS, {}),
        (7 * MS, {"efforts": bad}),
    ):
        held = ask_whole(harness, stamp_ns, **state)
        assert held == loop.step(stamp_ns, 0.3, 0.0, model.hold(stamp_ns, ""))
    # ... and not for longer than state_timeout.
    assert ask_whole(harness, 15 * MS) == 0.0
    assert ask_whole(harness, 16 * MS, efforts=efforts) != 0.0
    harness.wait(lambda: terms, what="terms")
    assert list(terms[0].name) == ["p", "i", "d", "model", "feedforward"]
    assert sum(terms[0].effort) == pytest.approx(answer, abs=1e-9)

    harness.wait(lambda: told.count("states without a model term") == 1, what="a report")
    assert told.says(compensation="decoupling", model_terms_held="3")
    assert "no efforts" in told.newest()["last fault of the model"]

    # Compensation is fixed, and gains are not.
    accepted, reason = harness.set_parameters(NAME, compensation="none")
    assert not accepted
    assert "read-only" in reason
    assert harness.set_parameters(NAME, model__payload=1.0)[0] is False
    assert harness.set_parameters(NAME, gains__p=200.0)[0]
    accepted, reason = harness.set_parameters(NAME, control_period=0.004)
    assert not accepted
    assert "control_period cannot change to 0.004 s with compensation decoupling" in reason
    # On a unit double integrator these gains are unstable, whatever the joint's inertia.
    accepted, reason = harness.set_parameters(NAME, gains__i=1e5)
    assert not accepted
    assert "unstable" in reason or "Hurwitz" in reason or "p d" in reason
