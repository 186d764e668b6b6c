"""The PIDs in files of ros2_control's own controllers do here what they do there."""

import math

import pytest
from harness.examples import examples
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import HpidError, SettingError
from hpid_ros.control.limited_law import LawSample, LimitedLaw
from hpid_ros.control.parameter_files import parameters_from

GAINS = {"p": 12.0, "i": 5.0, "d": 3.0}
DT = 0.002


def trajectory(gains, **own):
    return {
        "controller_manager": {
            "ros__parameters": {
                "update_rate": 500,
                "arm": {"type": "joint_trajectory_controller/JointTrajectoryController"},
            }
        },
        "arm": {
            "ros__parameters": {
                "joints": list(gains),
                "command_interfaces": ["effort"],
                "gains": gains,
                **own,
            }
        },
    }


def pid(gains, **own):
    return {
        "controller_manager": {"ros__parameters": {"update_rate": 500}},
        "arm": {
            "ros__parameters": {
                "dof_names": list(gains),
                "command_interface": "effort",
                "reference_and_state_interfaces": ["position", "velocity"],
                "gains": gains,
                **own,
            }
        },
    }


def only(document):
    file = parameters_from(document, "file")
    (loop,) = file.loops.values()
    return loop, "\n".join(file.remarks)


def control_toolbox(gains, errors):
    """Yield what control_toolbox's ``Pid::compute_command`` gives, as its source has it."""
    i_max = gains.get("i_clamp_max", gains.get("i_clamp", math.inf))
    i_min = gains.get("i_clamp_min", -gains.get("i_clamp", math.inf))
    strategy, i = gains.get("antiwindup_strategy", "none"), gains["i"]
    tracking = gains.get("tracking_time_constant") or (math.sqrt(gains["d"] / i) if i else 1.0)
    integral = 0.0
    for error, rate in errors:
        wanted = gains["p"] * error + integral + gains["d"] * rate
        least, most = gains.get("u_clamp_min", -math.inf), gains.get("u_clamp_max", math.inf)
        command = min(max(wanted, least), most)
        if strategy == "back_calculation":
            integral += DT * (i * error + (command - wanted) / tracking if i else 0.0)
        elif strategy != "conditional_integration" or command == wanted or error * wanted <= 0.0:
            integral += DT * i * error
        integral = min(max(integral, i_min), i_max)
        yield command


@given(
    st.sampled_from(["none", "legacy", "back_calculation", "conditional_integration"]),
    st.fixed_dictionaries(
        {
            "p": st.floats(0.0, 50.0),
            "i": st.sampled_from([0.0, 0.5, 40.0, 400.0]),
            "d": st.floats(0.5, 5.0),
        },
        optional={
            "i_clamp": st.sampled_from([0.0, 0.05, 1.0, math.inf]),
            "i_clamp_max": st.sampled_from([0.02, 2.0]),
            "u_clamp_max": st.sampled_from([0.5, 5.0, math.inf]),
            "u_clamp_min": st.sampled_from([-0.5, -5.0]),
            "tracking_time_constant": st.sampled_from([0.0, 0.1]),
        },
    ),
    st.lists(st.tuples(st.floats(-1.0, 1.0), st.floats(-3.0, 3.0)), min_size=1, max_size=40),
)
@examples(4)
def test_a_loop_gives_what_control_toolbox_gives(strategy, gains, errors):
    gains = {**gains, "antiwindup_strategy": strategy}
    loop, _ = only(trajectory({"j1": gains}))
    assert (loop.law, loop.timing.control_period) == ("pid", DT)
    law = LimitedLaw(loop)
    for (error, rate), expected in zip(errors, control_toolbox(gains, errors), strict=True):
        effort = law.update(LawSample(error, rate, DT, 0.0, 0.0, 0.0, 0.0, None))
        assert effort == pytest.approx(expected, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize(
    ("gains", "parameters", "said"),
    [
        (
            {**GAINS, "i_clamp": 2.0},
            {"gains.p": 12.0, "i_clamp_max": 2.0, "i_clamp_min": -2.0},
            "",
        ),
        (
            {**GAINS, "i_clamp": 2, "i_clamp_max": 3.0},
            {"i_clamp_max": 3.0, "i_clamp_min": -2.0},
            "",
        ),
        ({**GAINS, "i_clamp": 0.0}, {"gains.i": 0.0}, "j1: i_clamp 0 holds the integral at 0"),
        (GAINS, {"gains.i": 5.0}, "j1: no i_clamp is given: no limit, as from Jazzy on"),
        (GAINS, {"antiwindup_strategy": "none"}, "antiwindup_strategy legacy"),
        ({"p": 1, "d": 2}, {"gains.p": 1.0, "gains.i": 0.0, "gains.d": 2.0}, ""),
        ({**GAINS, "error_deadband": 0.01}, {}, "error_deadband 0.01 has no counterpart"),
        (
            {**GAINS, "ff_velocity_scale": 0.5},
            {"feedforward.viscous_friction": 0.5},
            "ff_velocity_scale 0.5 is feedforward.viscous_friction",
        ),
        ({**GAINS, "ff_velocity_scale": -0.5}, {}, "ff_velocity_scale -0.5 is negative"),
        ({**GAINS, "normalize_error": True}, {"angle_wraparound": True}, "at each sample"),
        ({**GAINS, "u_clamp_max": 4.0, "u_clamp_min": -math.inf}, {"u_clamp_max": 4.0}, ""),
        ({**GAINS, "q": 1.0}, {}, "gains.JOINT.q is not known"),
    ],
)
def test_each_gain_is_taken_or_told(gains, parameters, said):
    loop, remarks = only(trajectory({"j1": gains}))
    found = loop.to_parameters()
    assert {name: found[name] for name in parameters} == parameters
    assert said in remarks
    assert remarks or not said


def test_a_pid_controller_of_positions_is_taken_too():
    loop, remarks = only(pid({"j1": {**GAINS, "i_clamp_max": 1.0, "i_clamp_min": -1.0}}))
    assert (loop.joint, loop.gains.p, loop.integral.i_clamp_max) == ("j1", 12.0, 1.0)
    assert loop.velocity.is_measured
    one = {"reference_and_state_interfaces": ["position"]}
    loop, remarks = only(pid({"j1": {**GAINS, "feedforward_gain": 3.0}}, **one))
    assert (loop.velocity.velocity_source, loop.velocity.velocity_filter_time_constant) == (
        "filtered",
        0.0,
    )
    assert "d acts on differences of the error" in remarks
    assert "enable_feedforward is not true" in remarks
    fed = {"enable_feedforward": True}
    loop, remarks = only(pid({"j1": {**GAINS, "feedforward_gain": 3.0}}, **fed))
    assert loop.feedforward.viscous_friction == 3.0
    loop, remarks = only(pid({"j1": {**GAINS, "feedforward_gain": 3.0}}, **fed, **one))
    assert "multiplies the position: it has no counterpart" in remarks


@pytest.mark.parametrize(
    ("document", "reason"),
    [
        (trajectory({"j1": GAINS}, command_interfaces=["velocity"]), "commands velocity, not eff"),
        (trajectory({"j1": GAINS}, command_interfaces=["position"]), "uses no PID"),
        (trajectory({}, joints=["j1"]), "j1: no gains"),
        (pid({"j1": GAINS}, command_interface="velocity"), "commands velocity, not effort"),
        (pid({"j1": GAINS}, reference_and_state_interfaces=["velocity"]), "not position"),
        (trajectory({"$(var prefix)j1": GAINS}), "substitution of launch"),
        (trajectory({"j1": {**GAINS, "p": "12"}}), "p must be a number, not '12'"),
        (trajectory({"j1": {**GAINS, "p": -1.0}}), "gains.p"),
        (trajectory({"j1": GAINS}, joints="j1"), "joints must be a list of names, not 'j1'"),
    ],
)
def test_what_is_no_pid_for_efforts_is_one_line(document, reason):
    with pytest.raises(HpidError, match=r"^file") as error:
        parameters_from(document, "file")
    assert reason in str(error.value)
    assert "\n" not in str(error.value)


def test_controllers_are_found_by_type_in_namespaces_and_without_their_manager():
    document = {"left": trajectory({"j1": GAINS, "j2": {**GAINS, "p": 9.0}})}
    file = parameters_from(document, "file")
    assert [each.joint for each in file.loops.values()] == ["j1", "j2"]
    typed = pid({"j1": GAINS}, type="pid_controller/PidController")
    assert only({"arm": typed["arm"]})[0].gains.p == 12.0
    alone = {"arm": trajectory({"j1": GAINS})["arm"]}
    loop, remarks = only(alone)
    assert loop.timing.control_period == 0.01
    assert "no update_rate is given: 100 Hz" in remarks
    slow, _ = only(trajectory({"j1": GAINS}, update_rate=5))
    assert (slow.timing.control_period, slow.timing.state_timeout) == (0.2, pytest.approx(0.6))
    scaled = trajectory({"j1": GAINS})
    manager = scaled["controller_manager"]["ros__parameters"]
    manager["arm"]["type"] = "ur_controllers/ScaledJointTrajectoryController"
    assert only(scaled)[0].joint == "j1"
    manager["arm"]["type"] = "admittance_controller/AdmittanceController"
    with pytest.raises(SettingError, match="no joint controller"):
        parameters_from(scaled, "file")


def test_a_joint_that_another_controller_of_theirs_has_is_no_controller_of_ours():
    """As the twist_controller of ros2_kortex."""
    document = trajectory({"j1": GAINS})
    document["twist"] = {
        "ros__parameters": {"joint": "tcp", "interface_names": ["twist.linear.x"]}
    }
    manager = document["controller_manager"]["ros__parameters"]
    manager["twist"] = {"type": "picknik_twist_controller/PicknikTwistController"}
    assert only(document)[0].joint == "j1"


def test_a_file_of_ros_1_is_named():
    document = {"arm": {"type": "effort_controllers/JointTrajectoryController", "gains": {}}}
    with pytest.raises(
        SettingError, match="arm has no mapping ros__parameters, as controllers of"
    ):
        parameters_from(document, "file")


def test_two_controllers_of_a_joint_must_agree():
    document = trajectory({"j1": GAINS})
    document["other"] = document["arm"]
    assert len(parameters_from(document, "file").loops) == 1
    document |= {"other": trajectory({"j1": {**GAINS, "p": 1.0}})["arm"]}
    with pytest.raises(SettingError, match="'j1' has gains in /arm and others in /other"):
        parameters_from(document, "file")


def test_a_file_with_a_joint_controller_is_read_as_before():
    document = trajectory({"j1": GAINS}) | {"own": {"ros__parameters": {"joint": "j2"}}}
    assert [each.joint for each in parameters_from(document, "file").loops.values()] == ["j2"]
