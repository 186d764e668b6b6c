"""What a PID began with, and how late its efforts are stamped."""

from dataclasses import replace

import numpy as np
import pytest
from harness.joints import PERIOD, Joint, moved, sines

from hpid_bench.tuning.loop_simulation import DriveFacts, RobotSimulation, simulate
from hpid_bench.tuning.recorded_pid import recorded_answers

JOINT = Joint()
URDF = """<robot name="one"><link name="stand"/><link name="arm"><inertial>
<origin xyz="0 0 -0.49"/><mass value="0.8325"/>
<inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="a" type="revolute"><parent link="stand"/><child link="arm"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="60" velocity="20"/>
<dynamics damping="0.3" friction="0.3"/></joint></robot>"""


@pytest.mark.parametrize("late", [0, 1, 6, 25])
@pytest.mark.parametrize("hold", [0.0, 3.0])
def test_answering_the_states_again_tells_the_load_and_the_lateness(hold, late):
    reference = 1.0 + sines(4.0)
    series, _ = moved(JOINT, JOINT.settings(), reference, hold=hold, late=late)
    found = recorded_answers(JOINT.settings(), series, {})
    assert found.late == pytest.approx(late * PERIOD, abs=1e-9)
    load = JOINT.weight * np.sin(1.0) if hold else 0.0
    # A joint that was held is held by its friction, too.
    assert found.integral == pytest.approx(load, abs=JOINT.coulomb * bool(hold) + 0.05)


def test_efforts_of_another_controller_are_not_late():
    series, _ = moved(JOINT, JOINT.settings(), sines(4.0), late=6)
    other = JOINT.settings(**{"gains.p": 5.0, "gains.i": 0.0, "gains.d": 0.1})
    assert recorded_answers(other, series, {}).late == 0.0


def test_a_simulated_joint_that_was_held_does_not_fall():
    reference = 1.0 + sines(2.0)
    series, _ = moved(JOINT, JOINT.settings(), reference, hold=3.0)
    facts = {"a": DriveFacts(delay=JOINT.delay)}
    loops = {"PID": [JOINT.settings()]}
    robot = RobotSimulation(URDF, fixed_base=True, facts=facts, engine="mujoco")
    (run,) = simulate(robot, loops, [series])
    without = {"a": facts["a"]._replace(integral=0.0)}
    (fallen,) = simulate(replace(robot, facts=without), loops, [series])
    begin = slice(0, 300)

    def largest(each):
        return np.abs(each.joints[0].error[begin]).max()

    assert largest(run) < 1.3 * np.abs(series.error[begin]).max()
    assert largest(fallen) > 2.0 * largest(run)
