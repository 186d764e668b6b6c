"""Relay tests and excitations through real nodes: recorded, telling, at rest however they end."""

import io
import json
import threading
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from builtin_interfaces.msg import Duration
from harness.turntable import (
    COULOMB,
    INERTIA,
    VISCOUS,
    positions,
    start_turntable,
    wait_for_rest,
)
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import parameter_dict_from_yaml_file
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from hpid_bench.cli.commands.motions import agreed
from hpid_bench.cli.main import main
from hpid_bench.cli.options import parameter_file
from hpid_bench.live.motion import (
    bounds_of,
    carry_out,
    carry_out_relay,
    chosen_controllers,
    relay_findings,
)
from hpid_bench.live.running_controllers import running_graph
from hpid_ros.base.errors import SettingError
from hpid_ros.messages.run import read_run
from hpid_ros.motion.excitation import Design, RelayWish, Wish, plan, planned_relay
from hpid_ros.nodes.core.middleware import RARE

MS = 1_000_000
RELAY = [1.0, 0.01, 0.5, 20.0, 30.0]


def allows_relays(harness):
    request = GetParameters.Request(names=["allow_relay"])
    (value,) = harness.call(GetParameters, "turn_controller/get_parameters", request).values
    return value.bool_value


def test_a_relay_test_finds_the_inertia_and_proposes_gains(harness, tmp_path, capsys):
    start_turntable(harness, tmp_path, "lockstep")
    bag, file = tmp_path / "relay: #1", tmp_path / "tuned.yaml"  # of which YAML is made
    command = ["autotune", "--live", "--bag", str(bag), "-o", str(file)]
    assert main([*command, "--yes"]) == 0
    said = capsys.readouterr().out
    assert "nothing was set; this does: ros2 param load /turn_controller" in said
    wait_for_rest(harness)
    (settings,) = parameter_file(file).loops.values()
    assert settings.inertia == pytest.approx(INERTIA, rel=0.05)
    assert settings.law == "hpid"
    effort = read_run(bag, "relay", joints=["turn"]).joints[0].effort
    amplitude = 0.2 * 10.0
    assert np.max(np.abs(effort)) < 1.5 * amplitude
    assert 1.8 * amplitude < np.max(np.abs(np.diff(effort))) < 2.1 * amplitude
    graph = running_graph()
    assert graph.controllers["turn"].settings.gains.p == 21.6  # nobody has set anything
    assert not allows_relays(harness)
    # As ros2 param load does: what the file has for all nodes, to this one.
    wanted = list(parameter_dict_from_yaml_file(str(file)).values())
    request = SetParameters.Request(parameters=wanted)
    results = harness.call(SetParameters, "turn_controller/set_parameters", request).results
    assert [each.reason for each in results if not each.successful] == []
    assert running_graph().controllers["turn"].settings == settings


@pytest.mark.faults
def test_a_relay_that_is_interrupted_gives_the_joint_back(harness, tmp_path):
    start_turntable(harness, tmp_path, pace=0.5)
    graph = running_graph()
    (controller,) = graph.controllers.values()
    bounds, gains = bounds_of(controller, INERTIA), controller.settings.gains
    wish = RelayWish(effort=0.5, amplitude=0.3, cycles=50)
    planned = planned_relay(bounds, gains.d / gains.p, 0.004, wish)

    harness.commands.clear()
    has_switched = threading.Event()

    def watch():
        def is_seen():
            efforts = [each.effort[0] for each in harness.commands]
            return np.sum(np.diff(efforts) > wish.effort) > 6

        harness.wait(is_seen, what="some cycles")
        has_switched.set()

    def told(event, seconds):
        """Interrupt in the midst; a parent that waited here would be silent, which ends it."""
        if event == "at" and has_switched.is_set():
            raise KeyboardInterrupt

    watcher = threading.Thread(target=watch)
    watcher.start()
    ending = carry_out_relay(planned, controller, graph, tmp_path / "bag", told)
    watcher.join()
    assert ending.is_interrupted
    wait_for_rest(harness)
    assert not allows_relays(harness)
    found = relay_findings(tmp_path / "bag", controller, planned)
    assert found.cycle.inertia == pytest.approx(INERTIA, rel=0.2)


def test_a_relay_is_taken_only_while_it_is_allowed_and_where_it_can_be(harness):
    controller = harness.start_controller(
        law="pid", gains__p=10.0, gains__d=1.0, u_clamp_max=20.0, u_clamp_min=-20.0
    )
    publisher = harness.node.create_publisher(Float64MultiArray, "elbow_controller/relay", RARE)
    harness.wait(publisher.get_subscription_count, what="the subscription")
    stamps = iter(range(MS, 1000 * MS, MS))

    def efforts(count):
        return [harness.ask(next(stamps), 0.5) for _ in range(count)]

    def publish(numbers, line):
        publisher.publish(Float64MultiArray(data=numbers))
        harness.wait(lambda: line in controller.log.read_text(), what=line)

    def refuse(numbers, line):
        def is_said():  # once a second at most
            publisher.publish(Float64MultiArray(data=numbers))
            return line in controller.log.read_text()

        harness.wait(is_said, what=line)

    assert efforts(1) == [0.0]
    publish(RELAY, "relays are not allowed: allow_relay is false")
    assert efforts(30) == [0.0] * 30
    assert harness.set_parameters("elbow_controller", allow_relay=True)[0]
    for numbers, line in (
        ([1.0, 0.1], "a relay is asked for with 5 numbers"),
        ([float("nan"), 0.1, 0.2, 5.0, 5.0], "the amplitude of a relay must be finite"),
        ([50.0, 0.1, 0.2, 5.0, 5.0], "not within the effort limits"),
        ([0.0] * 100, "may have 64 numbers, not 100"),
    ):
        refuse(numbers, line)
        assert efforts(10) == [0.0] * 10
    publish(RELAY, "a relay of 1 N m drives the joint")
    assert abs(efforts(400)[-1]) == 1.0
    assert harness.set_parameters("elbow_controller", allow_relay=False)[0]
    back = efforts(450)
    assert back[-1] == 0.0
    assert max(abs(one - other) for one, other in pairwise(back)) < 0.1  # no jump


# --- excitations

SHORT = Design(duration=6.0, band=(0.3, 3.0), fade=0.5)


@pytest.mark.alone  # in lock-step its timeouts are shorter on the clock of the wall
def test_an_excitation_is_shown_carried_out_recorded_and_tells_what_the_joint_is(
    harness, tmp_path, capsys
):
    start_turntable(harness, tmp_path, "lockstep")
    bag, options = tmp_path / "run #2", ["--duration", "5", "--frequencies", "0.4", "3"]
    picture = tmp_path / "plan.png"
    assert main(["excite", *options, "--dry-run", "--plot", str(picture)]) == 0
    shown = capsys.readouterr().out
    assert "turn" in shown
    assert "its inertia is taken from its gains" in shown
    assert picture.stat().st_size > 10_000
    assert not bag.exists()
    assert np.ptp(positions(harness)) < 1e-3
    assert main(["excite", *options, "-o", str(bag), "--yes"]) == 0
    assert f"hpid identify {bag}" in capsys.readouterr().out
    assert wait_for_rest(harness) == pytest.approx(0.0, abs=0.02)
    assert main(["excite", *options, "-o", str(bag), "--yes"]) == 2  # nothing is written over
    assert main(["identify", str(bag), "--json", str(tmp_path / "found.json")]) == 0
    found = read_estimates(tmp_path / "found.json")
    assert found["inertia"] == pytest.approx(INERTIA, rel=0.03)
    assert found["viscous"] == pytest.approx(VISCOUS, rel=0.1)
    assert found["coulomb"] == pytest.approx(COULOMB, rel=0.1)


def read_estimates(file):
    (joint,) = json.loads(file.read_text())["joints"].values()
    return {name: each["value"] for name, each in joint["estimates"].items()}


@pytest.mark.faults
def test_whatever_ends_an_excitation_the_joint_comes_to_rest_and_is_held(harness, tmp_path):
    start_turntable(harness, tmp_path, "lockstep")
    graph = running_graph()
    controllers = chosen_controllers(graph, [])
    (bounds,) = [bounds_of(each, INERTIA) for each in controllers]
    stood = []
    publisher = harness.node.create_publisher(JointTrajectory, "joint_trajectory", RARE)
    harness.wait(publisher.get_subscription_count, what="the controller")
    listeners = publisher.get_subscription_count()

    def take_over(event, seconds):
        """Have the joint follow something else, as a node does that the exciter has found."""
        is_found = publisher.get_subscription_count() > listeners
        if event == "at" and seconds > 1.0 and is_found:
            points = [JointTrajectoryPoint(positions=[0.0], time_from_start=Duration(sec=2))]
            publisher.publish(JointTrajectory(joint_names=["turn"], points=points))

    def stand_still(event, seconds):
        """Do nothing, as a command that Ctrl-Z has stopped, until the joint rests for good."""
        while event == "at" and seconds > 1.0 and not stood:
            if np.ptp(positions(harness, 2.0)) < 2e-3:
                stood.append(seconds)

    for effort, tell, reason in (
        (10.0, interrupt, "it was interrupted"),
        (10.0, stand_still, "the command that watches it was stopped"),
        (10.0, take_over, "another node has sent a trajectory for turn"),
        (0.01, lambda *_: None, "from its reference, its tolerance is"),  # less than friction
    ):
        design = SHORT._replace(duration=20.0) if tell in (stand_still, take_over) else SHORT
        made = plan([replace(bounds, position=positions(harness)[-1])], Wish(), design)
        harness.set_parameters("turn_controller", u_clamp_max=effort, u_clamp_min=-effort)
        bag = tmp_path / reason
        ending = carry_out(made, controllers, graph, bag, tell)
        harness.set_parameters("turn_controller", u_clamp_max=10.0, u_clamp_min=-10.0)
        wait_for_rest(harness)
        assert reason in ending.reason
        assert ending.is_interrupted == (tell is interrupt)
        assert (bag / "metadata.yaml").exists()


def interrupt(event, seconds):
    """Interrupt a motion under way."""
    if event == "at" and seconds > 1.0:
        raise KeyboardInterrupt


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
