"""Does certifying beside a loop cost it samples? States at 1 kHz, new gains twice a second.

    python benchmarks/certificate_beside_loop.py [--seconds 20]

One controller in a process of its own, in the closed mode. Every half second it gets new gains;
with ``certify`` on each of them starts a certificate in a process of least priority. Printed, for
certify off and on in turn: states sent, states without an answer, and the answers' latency.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from hpid_ros.experiment.processes import NodeGroup, closed_environment, own_domain

PERIOD = 0.001  # [s]
RETUNE_EVERY = 500  # states


class Measurement(NamedTuple):
    """What one controller did.

    Attributes:
        states: States that were sent.
        unanswered: Those of them that it did not answer.
        latencies: Of the answers, in [us].
        sets: Sets of gains that it accepted.
    """

    states: int
    unanswered: int
    latencies: list[float]
    sets: int


def measure(certify: bool, seconds: float, folder: Path) -> Measurement:
    """Send states to one controller and retune it.

    Args:
        certify: Whether it certifies its gains.
        seconds: How long, in [s].
        folder: Existing folder for its log.
    """
    import rclpy
    from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
    from rcl_interfaces.srv import SetParametersAtomically
    from rclpy.executors import SingleThreadedExecutor
    from sensor_msgs.msg import JointState

    from hpid_ros.messages.joint_state import EffortReader, JointStateTemplate
    from hpid_ros.nodes.core.middleware import ALL_COMMANDS, OFFERED

    with own_domain() as domain, NodeGroup(closed_environment(domain), folder) as group:
        context = rclpy.Context()
        rclpy.init(args=[], context=context, domain_id=domain)
        node = rclpy.create_node("robot", context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        sent: dict[int, float] = {}
        latencies: list[float] = []
        reader = EffortReader()

        def on_command(raw: bytes) -> None:
            begun = sent.pop(reader.read(raw)[0], None)
            if begun is not None:
                latencies.append((time.perf_counter() - begun) * 1e6)

        states = node.create_publisher(JointState, "joint_states", OFFERED)
        node.create_subscription(JointState, "joint_commands", on_command, ALL_COMMANDS, raw=True)
        client = node.create_client(SetParametersAtomically, "c/set_parameters_atomically")
        gains = ["gains.p:=39.6", "gains.i:=132.0", "gains.d:=3.96", "inertia:=0.132"]
        options = ["joint:=j", "mu:=-0.1", f"certify:={str(certify).lower()}", *gains]
        group.start("c", "joint_controller", [a for o in options for a in ("-p", o)])
        while not (states.get_subscription_count() and client.service_is_ready()):
            executor.spin_once(timeout_sec=0.02)
        template = JointStateTemplate(["j"], position=True)
        begin, count, answers = time.perf_counter(), round(seconds / PERIOD), []
        for k in range(count):
            due = begin + k * PERIOD
            while time.perf_counter() < due:
                executor.spin_once(timeout_sec=0.0)
            stamp_ns = k * 1_000_000
            sent[stamp_ns] = time.perf_counter()
            states.publish(template.encode(stamp_ns, position=[0.0]))
            if k % RETUNE_EVERY == RETUNE_EVERY // 2:
                value = ParameterValue(
                    type=ParameterType.PARAMETER_DOUBLE, double_value=39.6 + k * 1e-3
                )
                request = SetParametersAtomically.Request(
                    parameters=[Parameter(name="gains.p", value=value)]
                )
                answers.append(client.call_async(request))
        end = time.perf_counter() + 0.2
        while time.perf_counter() < end:
            executor.spin_once(timeout_sec=0.0)
        accepted = sum(a.done() and a.result().result.successful for a in answers)
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown(context=context)
        return Measurement(count, len(sent), latencies, accepted)


def main() -> int:
    """Print the measurement."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    os.environ.update(closed_environment(0))
    print("certify  states  unanswered  sets  median us  p99 us  largest us")
    for _ in range(options.rounds):
        for certify in (False, True):
            with tempfile.TemporaryDirectory() as folder:
                done = measure(certify, options.seconds, Path(folder))
            p99 = statistics.quantiles(done.latencies, n=100)[98]
            print(
                f"{'on' if certify else 'off':7}  {done.states:6}  {done.unanswered:10}  "
                f"{done.sets:4}  {statistics.median(done.latencies):9.0f}  {p99:6.0f}  "
                f"{max(done.latencies):10.0f}",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
