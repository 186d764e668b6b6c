"""Ten thousand messages and ten thousand sets of parameters at a controller that runs."""

import math
import os
from contextlib import suppress

import numpy as np
from harness.fuzzing import StateFuzzer
from harness.graph import NAME, Told, ros_arguments
from harness.loops import pure_loop
from harness.poison import memory_of
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.qos import qos_profile_parameters

from hpid_ros.base.errors import HpidError
from hpid_ros.control import LoopSettings
from hpid_ros.control.assembly import make_law

MS = 1_000_000
MESSAGES, SETS = int(os.environ.get("HPID_FUZZ_MESSAGES", "10000")), 10_000
AT_ONCE = 8  # sets under way; the test hears ten answers to states at once
LIMITS = {"u_clamp_max": 20.0, "u_clamp_min": -15.0, "position_max": 2.0, "velocity_max": 9.0}
# All of them shall arrive: as a recorder's, not as a controller's subscription.
RELIABLE = {
    "qos_overrides./joint_states.subscription.reliability": "reliable",
    "qos_overrides./joint_states.subscription.depth": 4000,
}


def test_ten_thousand_messages_and_the_node_is_as_it_was(harness, faults):
    gains = {"gains__p": 10.0, "gains__i": 4.0, "gains__d": 2.0}
    process = harness.start_controller(law="hpid", mu=-0.2, **LIMITS, **gains, **RELIABLE).process
    told = Told(harness)
    fuzzer = StateFuzzer("elbow", seed=2)
    # Without those of no byte at all: after one, Fast DDS gives a reliable reader nothing more.
    messages = [raw for raw in fuzzer.messages(MESSAGES + MESSAGES // 10) if raw][:MESSAGES]
    assert len(messages) == MESSAGES
    for k, raw in enumerate(messages, start=1):
        harness.states.publish(raw)
        if k % 2000 == 0:  # no further ahead than the queues are long
            harness.wait(lambda k=k: seen(told) >= k, what=f"{k} messages to be taken")
    harness.wait(lambda: seen(told) == MESSAGES, what="all messages to be counted")
    figures = told.newest()
    kinds = ("rejected samples", "gaps", "clock resets", "repeats", "states of other joints")
    assert all(int(figures[kind]) > 50 for kind in kinds)
    assert figures["last fault"] != "none"
    assert figures["last irregular state"] != "none"
    # The count may be told before the test has taken the answers, one at a time.
    harness.wait(lambda: len(harness.commands) > 0.1 * MESSAGES, what="the answers")
    efforts = np.array([command.effort[0] for command in harness.commands])
    assert np.all((efforts >= -15.0) & (efforts <= 20.0))
    assert process.poll() is None
    faults.count("memory [MiB]: live node, at the end", memory_of(process.pid, "VmRSS"))
    # Back to normal by itself: after a while of states that come from one source again, a clock
    # that goes back starts the loop anew, exactly.
    begin_ns = -(2**31) * 10**9
    for k in range(10):
        harness.ask(begin_ns + 10**9 + 90 * k * MS, 0.0)
    harness.commands.clear()
    twin = pure_loop(law="hpid", mu=-0.2, **LIMITS, **gains)
    for k in range(20):
        numbers = (begin_ns + k * MS, 0.01 * k, 0.1)
        assert harness.ask(*numbers) == twin.step(*numbers)
    faults.count("messages fuzzed: live node", MESSAGES)


def seen(told):
    """Return how many states the controller has told of."""
    kinds = ("samples", "repeats", "rejected samples", "states of other joints")
    return sum(told.count(kind) for kind in kinds)


def message(name, value):
    if isinstance(value, str):
        return Parameter(name=name, value=ParameterValue(type=4, string_value=value))
    return Parameter(name=name, value=ParameterValue(type=3, double_value=value))


def random_sets(count, seed):
    """Yield sets that change the effort at rest, about a third of which are no valid ones."""
    draw = np.random.default_rng(seed)
    for _ in range(count):
        changes = {"gains.p": float(draw.uniform(0.0, 30.0))}
        if draw.random() < 0.5:
            changes |= {
                "law": str(draw.choice(["pid", "hpid"])),
                "mu": float(draw.uniform(-0.4, 0.4)),
            }
        if draw.random() < 0.3:
            changes |= {"u_clamp_max": float(draw.uniform(-3.0, 30.0)), "u_clamp_min": -3.0}
        kind = draw.random()
        if kind < 0.1:
            changes["mu"] = 0.5
        elif kind < 0.2:
            changes["gains.d"] = math.nan
        elif kind < 0.3:
            changes["norm.type"] = "nonsense"
        elif kind < 0.35:
            changes["u_clamp_min"] = 1e5
        yield changes


class Retuned:
    """A controller at full rate whose effort at rest tells which parameters are in force."""

    ERROR = 0.7

    def __init__(self, harness):
        self.present = {"joint": "elbow", "law": "pid", "gains.p": 10.0}
        options = ros_arguments(
            certify=False,
            state_watchdog=False,
            gains__p=10.0,
            joint="elbow",
            law="pid",
            **RELIABLE,
        )
        harness.processes.start(NAME, "joint_controller", options)
        self._harness = harness
        self._stamp_ns = 0
        harness.wait(lambda: harness.states.get_subscription_count() > 0, what="the controller")
        harness.ask(0, self.ERROR)  # it holds here
        self.publish()

    def publish(self):
        """Publish the next state: away from where it holds, at rest."""
        self._stamp_ns += MS
        self._harness.publish(self._stamp_ns, 0.0)

    def effort(self):
        """Return the effort of the parameters that are in force."""
        settings = LoopSettings.from_parameters(self.present)
        return settings.effort.within(make_law(settings).update(self.ERROR, 0.0, MS * 1e-9))

    def take(self, changes):
        """Return whether a set is valid; then it is in force."""
        try:
            LoopSettings.from_parameters({**self.present, **changes})
        except HpidError:
            return False
        self.present.update(changes)
        return True


def test_ten_thousand_sets_under_load_are_in_force_whole_in_their_order_or_not_at_all(
    harness, faults
):
    controller = Retuned(harness)
    client = harness.node.create_client(
        SetParametersAtomically,
        f"{NAME}/set_parameters_atomically",
        qos_profile=qos_profile_parameters,  # of the default's ten answers at once some are lost
    )
    harness.wait(client.service_is_ready, what="the controller to take parameters")
    expected, efforts, asked = [], [controller.effort()], []
    sets = list(random_sets(SETS, seed=3))
    for first in range(0, SETS, AT_ONCE):
        for changes in sets[first : first + AT_ONCE]:
            parameters = [message(*each) for each in changes.items()]
            request = SetParametersAtomically.Request(parameters=parameters)
            asked.append(client.call_async(request))
            expected.append(controller.take(changes))
            efforts += [controller.effort()] if expected[-1] else []
            controller.publish()
        # On a busy machine the middleware may lose an answer, and never the set.
        with suppress(AssertionError):
            harness.wait(asked[-1].done, within=10.0)
    told = [each.result() if each.done() else None for each in asked]
    heard = [(each.result, wanted) for each, wanted in zip(told, expected, strict=True) if each]
    assert len(heard) > 0.999 * SETS
    assert all(result.successful is wanted for result, wanted in heard)
    assert all("\n" not in result.reason for result, _ in heard)
    assert harness.ask(10**12, 0.0) == efforts[-1]
    # Every answer is that of one valid set as a whole, and they come in their order.
    newest = 0
    answers = [command.effort[0] for command in harness.commands[1:]]
    for effort in answers:
        newest = efforts.index(effort, newest)
    assert efforts[newest] == efforts[-1]
    assert len(answers) > 0.99 * SETS
    assert 0.5 * SETS < sum(expected) < 0.9 * SETS
    faults.count("parameter sets: live node, valid", sum(expected))
    faults.count("parameter sets: live node, refused", SETS - sum(expected))
    faults.count("parameter sets: live node, samples between them", len(answers))
