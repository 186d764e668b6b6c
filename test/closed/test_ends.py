"""Whatever ends a node, its participant goes before its process does.

One that goes without a word stalls the discovery of all others on the graph: in shared memory they
take it for a listener that is stuck, and open anew all that they listened to (docs/faults.md).
"""

import re
import signal
from itertools import count

import pytest
from harness.studies import wait_until

from hpid_bench.experiment.processes import (
    SHARED_MEMORY,
    NodeGroup,
    closed_environment,
    own_domain,
)
from hpid_ros.base.resources import share_folder

WITHIN = 60.0  # [s]
CONTROLLER = ("joint_controller", "joint:=elbow", "wait_for_command_subscribers:=0")
RUNNING = [
    CONTROLLER,
    ("joint_controllers", "joints:=[elbow, wrist]"),
    ("joint_command_merger", "joints:=[elbow, wrist]"),
    ("joint_command_merger", "joints:=[elbow]", "controller:=efforts"),
    ("single_process", "joints:=[arm_joint_1]"),
    ("mujoco_bridge", "mode:=realtime"),
    ("trajectory_publisher", f"reference_file:={share_folder()}/config/experiments/paper.yaml"),
    ("live.live_tuner", "port:=0"),
]
REFUSED = [
    (*CONTROLLER, "mu:=0.9"),
    (*CONTROLLER, "nonsense:=1"),
    ("joint_controllers", "joints:=[]"),
    ("joint_command_merger", "joints:=[elbow, elbow]"),
    ("mujoco_bridge", "nonsense:=1"),
    ("trajectory_publisher",),
    ("bag_recorder",),
    ("bag_metrics",),
    ("live.live_tuner", "nonsense:=1"),
]


class Graph:
    """Nodes of a domain, and the ports in shared memory that they listen to."""

    def __init__(self, domain, nodes):
        first = 7400 + 250 * domain  # the specification's numbers
        self._numbers = range(first, first + 250)
        self._nodes, self._numbered = nodes, count()

    def start(self, executable, *parameters):
        arguments = [word for each in parameters for word in ("-p", each)]
        number = next(self._numbered)
        is_renamed = executable == "joint_controller"
        return self._nodes.start(f"node_{number}", executable, arguments, is_renamed=is_renamed)

    def ports(self):
        locks = [re.fullmatch(r"fastrtps_port(\d+)_[es]l", each.name) for each in files()]
        return {int(each[1]) for each in locks if each and int(each[1]) in self._numbers}


def files():
    return list(SHARED_MEMORY.iterdir())


@pytest.fixture
def graph(tmp_path):
    with own_domain() as domain, NodeGroup(closed_environment(domain), tmp_path) as nodes:
        yield Graph(domain, nodes)


@pytest.mark.parametrize(
    ("node", "ending"),
    [
        *((node, "SIGTERM") for node in RUNNING),
        *((CONTROLLER, ending) for ending in ("SIGINT", "SIGHUP", "SIGQUIT")),
    ],
    ids=str,
)
def test_a_node_that_is_ended_leaves_no_port(graph, node, ending):
    process = graph.start(*node).process
    wait_until(
        lambda: len(graph.ports()) == 3, WITHIN, "its ports, two of its own and the common one"
    )
    process.send_signal(signal.Signals[ending])
    process.wait(WITHIN)
    assert graph.ports() == set()


@pytest.mark.parametrize("node", REFUSED, ids=lambda node: " ".join(node[:1] + node[-1:]))
def test_a_node_that_is_refused_leaves_no_port(graph, node):
    assert graph.start(*node).process.wait(WITHIN) == 2
    assert graph.ports() == set()


def test_a_rival_leaves_no_port(graph):
    first = graph.start(*CONTROLLER)
    wait_until(
        lambda: "listening" in [each["event"] for each in first.read_events()], WITHIN, "the first"
    )
    before = graph.ports()
    assert graph.start(*CONTROLLER).process.wait(WITHIN) == 1
    assert graph.ports() == before


def test_one_that_is_killed_leaves_its_ports(graph):
    """Without this the others would prove nothing."""
    process = graph.start(*CONTROLLER).process
    wait_until(lambda: len(graph.ports()) == 3, WITHIN, "its ports")
    process.kill()
    process.wait(WITHIN)
    assert len(graph.ports()) == 3
