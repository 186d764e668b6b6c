"""Excitations through real nodes: recorded and telling, and at rest however they end."""

import io
import json
import time
from dataclasses import replace

import numpy as np
import pytest
from harness.graph import ros_arguments
from sensor_msgs.msg import JointState

from hpid_ros.base.errors import SettingError
from hpid_ros.cli.commands.live.asking import agreed
from hpid_ros.cli.main import main
from hpid_ros.excitation.bounds import Wish
from hpid_ros.excitation.plan import Design, plan
from hpid_ros.experiment.live.excitation import bounds_of, carry_out, chosen
from hpid_ros.experiment.live.graph import running_graph
from hpid_ros.nodes.ros.middleware import ALL_COMMANDS
from hpid_ros.wire import decode_joint_state

INERTIA, VISCOUS, COULOMB = 0.05, 0.2, 0.1
URDF = f"""<robot name="turntable">
  <link name="world"/>
  <link name="table"><inertial><mass value="1.0"/>
    <inertia ixx="0.05" iyy="0.05" izz="{INERTIA}" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="turn" type="revolute"><parent link="world"/><child link="table"/>
    <axis xyz="0 0 1"/><limit lower="-2" upper="2" effort="10" velocity="4"/>
    <dynamics damping="{VISCOUS}" friction="{COULOMB}"/></joint>
</robot>"""
GAINS = {"gains__p": 21.6, "gains__i": 86.0, "gains__d": 1.8}
SHORT = Design(duration=6.0, band=(0.3, 3.0), fade=0.5)


@pytest.fixture
def turntable(harness, tmp_path):
    """Return the harness beside a robot of one joint in real time, and its controller."""
    urdf = tmp_path / "turntable.urdf"
    urdf.write_text(URDF)
    harness.seen = []
    harness.node.create_subscription(
        JointState,
        "joint_states",
        lambda raw: harness.seen.append(decode_joint_state(raw)),
        ALL_COMMANDS,
        raw=True,
    )
    of_controller = {"joint": "turn", "law": "pid", "robot_description": urdf, **GAINS}
    harness.processes.start(
        "turn_controller",
        "joint_controller",
        ros_arguments(control_period=0.004, state_timeout=1.0, **of_controller),
    )
    of_bridge = {"robot_description": urdf, "fixed_base": True, "control_rate": 250.0}
    harness.processes.start(
        "bridge",
        "mujoco_bridge",
        ros_arguments(mode="realtime", physics_steps=2, wait_for_subscribers=2, **of_bridge),
    )
    harness.wait(lambda: len(harness.seen) > 10 and harness.commands, what="the robot")
    return harness


def positions(harness, duration=0.3):
    """Return where the joint is from now on, for a while."""
    end = time.monotonic() + 0.5
    harness.wait(lambda: time.monotonic() > end, what="what was on its way")
    harness.seen.clear()
    end = time.monotonic() + duration
    harness.wait(lambda: time.monotonic() > end and len(harness.seen) > 20, what="states")
    return np.array([each.position[0] for each in harness.seen])


def test_an_excitation_is_shown_carried_out_recorded_and_tells_what_the_joint_is(
    turntable, tmp_path, capsys
):
    bag, options = tmp_path / "bag", ["--duration", "5", "--frequencies", "0.4", "3"]
    picture = tmp_path / "plan.png"
    assert main(["excite", *options, "--dry-run", "--plot", str(picture)]) == 0
    shown = capsys.readouterr().out
    assert "turn" in shown
    assert "its inertia is taken from its gains" in shown
    assert picture.stat().st_size > 10_000
    assert not bag.exists()
    assert np.ptp(positions(turntable)) < 1e-3
    assert main(["excite", *options, "-o", str(bag), "--yes"]) == 0
    assert f"hpid identify {bag}" in capsys.readouterr().out
    after = positions(turntable)
    assert np.ptp(after) < 2e-3
    assert after[-1] == pytest.approx(0.0, abs=0.02)
    assert main(["excite", *options, "-o", str(bag), "--yes"]) == 2  # nothing is written over
    assert main(["identify", str(bag), "--json", str(tmp_path / "found.json")]) == 0
    found = read_estimates(tmp_path / "found.json")
    assert found["inertia"] == pytest.approx(INERTIA, rel=0.03)
    assert found["viscous"] == pytest.approx(VISCOUS, rel=0.1)
    assert found["coulomb"] == pytest.approx(COULOMB, rel=0.1)


def read_estimates(file):
    (joint,) = json.loads(file.read_text())["joints"].values()
    return {name: each["value"] for name, each in joint["estimates"].items()}


def test_whatever_ends_an_excitation_the_joint_comes_to_rest_and_is_held(turntable, tmp_path):
    graph = running_graph()
    controllers = chosen(graph, [])
    (bounds,) = [bounds_of(each, INERTIA) for each in controllers]

    def interrupt():
        raise KeyboardInterrupt

    def limit_effort():
        turntable.set_parameters("turn_controller", u_clamp_max=0.01, u_clamp_min=-0.01)

    cases = {
        "interrupted": (interrupt, "it was interrupted"),
        "weak": (limit_effort, "from its reference, its tolerance is"),
    }
    for name, (act, reason) in cases.items():
        made = plan([replace(bounds, position=positions(turntable)[-1])], Wish(), SHORT)
        ending = carry_out(
            *(made, controllers, graph, tmp_path / name, "joint_states"), in_the_middle(act)
        )
        turntable.set_parameters("turn_controller", u_clamp_max=10.0, u_clamp_min=-10.0)
        while np.ptp(positions(turntable)) > 2e-3:  # friction is overcome by the integral, slowly
            assert name == "weak"
        assert reason in ending.reason
        assert ending.is_interrupted == (name == "interrupted")
        assert (tmp_path / name / "metadata.yaml").exists()


def in_the_middle(act):
    """Return what does something once, when it is told of a motion under way."""
    done = []

    def told(event, seconds):
        if event == "at" and seconds > 1.0 and not done:
            done.append(act)
            act()

    return told


def test_joints_do_not_move_before_somebody_says_yes(monkeypatch, capsys):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    assert agreed("Move", is_given=True)
    for answer, meant in (("y\n", True), ("Yes\n", True), ("\n", False), ("", False)):
        monkeypatch.setattr("sys.stdin", Terminal(answer))
        assert agreed("Move", is_given=False) is meant
    assert "Move? [y/N]" in capsys.readouterr().out
    monkeypatch.setattr("sys.stdin", io.StringIO("y\n"))
    with pytest.raises(SettingError, match="--yes"):
        agreed("Move", is_given=False)
