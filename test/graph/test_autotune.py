"""A relay test of a real controller on a simulated joint, and what is proposed after it."""

from itertools import pairwise

import numpy as np
import pytest
from harness.turntable import INERTIA, start_turntable, wait_for_rest
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import parameter_dict_from_yaml_file
from std_msgs.msg import Float64MultiArray

from hpid_ros.cli.main import main
from hpid_ros.cli.options import parameter_file
from hpid_ros.live.graph_client import running_graph
from hpid_ros.live.motion import bounds_of, carry_out_relay, relay_findings
from hpid_ros.messages.run import read_run
from hpid_ros.motion.excitation import RelayWish, planned_relay
from hpid_ros.nodes.core.middleware import RARE

MS = 1_000_000
RELAY = [1.0, 0.01, 0.5, 20.0, 30.0]


def allows_relays(harness):
    request = GetParameters.Request(names=["allow_relay"])
    (value,) = harness.call(GetParameters, "turn_controller/get_parameters", request).values
    return value.bool_value


def test_a_relay_test_finds_the_inertia_and_proposes_gains(harness, tmp_path, capsys):
    start_turntable(harness, tmp_path, "lockstep")
    bag, file = tmp_path / "bag", tmp_path / "tuned.yaml"
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
    start_turntable(harness, tmp_path, "lockstep")
    graph = running_graph()
    (controller,) = graph.controllers.values()
    bounds, gains = bounds_of(controller, INERTIA), controller.settings.gains
    wish = RelayWish(effort=0.5, cycles=30)
    planned = planned_relay(bounds, gains.d / gains.p, 0.001, wish)

    harness.commands.clear()

    def has_switched():
        efforts = [each.effort[0] for each in harness.commands]
        return np.sum(np.diff(efforts) > wish.effort) > 6

    def told(event, seconds):
        if event == "at":
            harness.wait(has_switched, what="some cycles")
            raise KeyboardInterrupt

    ending = carry_out_relay(planned, controller, graph, tmp_path / "bag", told)
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
        ([0.0] * 100, "100 numbers, 64 are allowed"),
    ):
        refuse(numbers, line)
        assert efforts(10) == [0.0] * 10
    publish(RELAY, "a relay of 1 N m drives the joint")
    assert abs(efforts(400)[-1]) == 1.0
    assert harness.set_parameters("elbow_controller", allow_relay=False)[0]
    back = efforts(450)
    assert back[-1] == 0.0
    assert max(abs(one - other) for one, other in pairwise(back)) < 0.1  # no jump
