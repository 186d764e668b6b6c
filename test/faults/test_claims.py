"""Two controllers of one joint: one is active, the other is refused and says who holds it."""

import itertools
import os
import signal
import subprocess
import time
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from harness.graph import Told, change, ros_arguments, state
from harness.studies import wait_until

from hpid_bench.experiment.processes import NodeGroup, closed_environment, own_domain
from hpid_ros.base.names import claim_topic
from hpid_ros.nodes.core.middleware import LATCHED
from hpid_ros.nodes.parts.claims import LEASE, Claim, ClaimState, to_message

pytestmark = pytest.mark.alone

MS = 1_000_000
GAINS = {"law": "pid", "gains__p": 10.0, "certify": False, "state_watchdog": False}

# --- live controllers ---------------------------------------------------------------------


def log_of(process):
    return process.log.read_text(errors="replace")


def ended(harness, process, within=60.0):
    harness.wait(lambda: process.process.poll() is not None, within, f"{process.name} to end")
    return process.process.returncode


def start(harness, name, **parameters):
    values = {"joint": "elbow", **GAINS, **parameters}
    return harness.processes.start(name, "joint_controller", ros_arguments(**values))


def test_a_second_controller_of_a_joint_is_refused_and_names_the_first(harness, faults):
    first = harness.start_controller("first", **GAINS)
    harness.ask(0, 0.5)
    second = start(harness, "second", gains__p=99.0)
    assert ended(harness, second) == 1
    faults.count("second controllers refused")
    said = log_of(second).strip().splitlines()
    assert said == [
        f"/second: joint elbow is commanded by /first (process {first.pid} of this host); one "
        f"controller at a time may be active, unless each has the parameter claim: none"
    ]
    assert harness.ask(MS, 0.4) == pytest.approx(1.0)
    assert [each.effort for each in harness.commands] == [(0.0,), (pytest.approx(1.0),)]

    # Frozen it holds the joint all the same: it may go on at any time.
    os.kill(first.pid, signal.SIGSTOP)
    frozen = start(harness, "while_frozen")
    assert ended(harness, frozen) == 1
    assert f"/first (process {first.pid} of this host)" in log_of(frozen)
    # Killed it does not, from the same instant on.
    os.kill(first.pid, signal.SIGKILL)
    first.process.wait()
    third = start(harness, "third")
    harness.wait(lambda: "listening" in events(third), what="the third to be active")
    faults.count("joints taken over from a killed controller")
    assert harness.ask_newcomer(2 * MS, 0.3) == pytest.approx(0.0)


def events(process):
    """Return the names of all events of a process so far."""
    seen = process.__dict__.setdefault("seen", [])
    seen += [event["event"] for event in process.read_events()]
    return seen


def test_of_controllers_that_start_at_the_same_moment_one_is_active(harness, faults):
    for turn in range(3):
        group = [start(harness, f"twin_{turn}_{k}") for k in range(2)]
        winner = only_winner(harness, group)
        for loser in group:
            if loser is not winner:
                assert loser.process.returncode == 1
                assert f"/{winner.name} (process {winner.pid} of this host)" in log_of(loser)
        faults.count("simultaneous starts with one active in the end")
        harness.processes.stop([winner.name])


def only_winner(harness, group):
    """Wait until all of a group but one have ended, and that one is active; return it."""

    def decided():
        left = [process for process in group if process.process.poll() is None]
        return len(left) == 1 and "listening" in events(left[0])

    harness.wait(decided, what="one to be active")
    (winner,) = (process for process in group if process.process.poll() is None)
    return winner


def test_a_joint_that_was_left_may_be_taken_and_others_are_not_disturbed(harness):
    """Another namespace, another joint, another topic and ``claim: none`` are no second."""
    first = harness.start_controller("elbow_controller", **GAINS)
    told = Told(harness)
    harness.wait(lambda: told.says(claim="held"), what="the claim in the diagnostics")
    others = [
        harness.processes.start(
            name,
            "joint_controller",
            [*ros_arguments(certify=False, **parameters), *remaps],
        )
        for name, parameters, remaps in (
            ("namespaced", {"joint": "elbow"}, ["-r", "__ns:=/left"]),
            ("remapped", {"joint": "elbow"}, ["-r", "joint_commands:=elsewhere"]),
            ("wrist", {"joint": "wrist"}, []),
            ("unclaimed", {"joint": "elbow", "claim": "none"}, []),
        )
    ]
    standby = start(harness, "standby", autostart=False)
    assert change(harness, "configure", "standby")
    assert not change(harness, "activate", "standby")
    assert state(harness, "standby") == "inactive"  # it may be tried again
    assert f"/elbow_controller (process {first.pid} of this host)" in log_of(standby)
    assert change(harness, "deactivate")
    assert change(harness, "activate", "standby")
    harness.wait(lambda: "listening" in events(standby), what="the standby")
    assert state(harness) == "inactive"
    assert not change(harness, "activate")
    harness.wait(
        lambda: "commanded by /standby" in told.newest().get("message", ""),
        what="the diagnostics to name the holder",
    )
    assert [p.process.poll() for p in others] == [None] * len(others), [log_of(p) for p in others]


# --- another host, played by the test on the real topic ------------------------------------


class OtherHost:
    """Tells claims as a controller on another host does."""

    def __init__(self, harness, topic="/joint_commands"):
        self._publisher = harness.node.create_publisher(
            DiagnosticStatus, claim_topic(topic, "elbow"), LATCHED
        )
        self.heard, self._seen = [], -1
        harness.node.create_subscription(
            DiagnosticStatus, claim_topic(topic, "elbow"), self.heard.append, LATCHED
        )
        self.claim = Claim("elbow", topic, "/far", "farhost", 7, 1, "far", ClaimState.HELD)

    def tell(self, claim=None):
        self._publisher.publish(to_message(claim or self.claim))

    def is_quiet(self):
        """Tell whether nothing new has come since the last call."""
        before, self._seen = self._seen, len(self.heard)
        return before == self._seen

    def states(self):
        return [each.message for each in self.heard if each.name != "/far"]


def test_a_joint_that_another_host_holds_is_refused_for_as_long_as_it_says_so(harness, faults):
    far = OtherHost(harness)
    far.tell()
    standby = start(harness, "standby", autostart=False)
    change(harness, "configure", "standby")

    def refused():
        far.tell()
        if change(harness, "activate", "standby"):
            change(harness, "deactivate", "standby")
            return False
        return True

    harness.wait(refused, what="the far claim to be heard")
    assert "/far (process 7 on host farhost)" in log_of(standby)
    silent = time.monotonic()
    far.tell()
    harness.wait(lambda: change(harness, "activate", "standby"), what="the lease to run out")
    lasted = time.monotonic() - silent
    assert lasted > LEASE
    faults.count("ms from another host's last word to active here", 1e3 * lasted)
    assert change(harness, "deactivate", "standby")
    harness.wait(refused, what="the far claim to be heard again")
    far.tell(replace(far.claim, state=ClaimState.RELEASED))
    harness.wait(
        lambda: change(harness, "activate", "standby"), within=LEASE - 0.5, what="the release"
    )


def test_a_holder_yields_to_an_older_one_and_not_to_a_younger_or_a_wish(harness, faults):
    """As after a network was in two halves: with one zero, at once, even if its stop is slow."""
    controller = harness.start_controller(stop="damping", stop_duration=4.0, **GAINS)
    harness.ask(0, 0.5)
    assert harness.ask(MS, 0.4) == pytest.approx(1.0)
    far = OtherHost(harness)
    harness.wait(lambda: far.states(), what="the claim to be heard")
    wish = replace(far.claim, state=ClaimState.WISHED)
    younger = replace(far.claim, since_ns=time.time_ns() + 10**15)
    count = len(far.states())
    for claim in (wish, younger):
        far.tell(claim)
    garbled = DiagnosticStatus(name="/nonsense", message="held")
    far._publisher.publish(garbled)
    harness.wait(lambda: len(far.states()) > count + 2, what="three beats")
    assert state(harness) == "active"
    assert harness.ask(2 * MS, 0.3) == pytest.approx(2.0)
    count = len(harness.commands)
    far.tell()
    told = time.monotonic()
    harness.wait(lambda: len(harness.commands) > count, what="its last command")
    faults.count("ms from an older claim heard to zero effort", 1e3 * (time.monotonic() - told))
    harness.wait(lambda: "released" in far.states(), what="the controller to yield")
    faults.count("holders that yielded to another host")
    assert [each.effort for each in harness.commands[count:]] == [(0.0,)]
    assert state(harness) == "inactive"
    assert controller.process.poll() is None
    assert "/far (process 7 on host farhost)" in log_of(controller)
    harness.publish(3 * MS, 0.0)
    far.heard.clear()
    assert state(harness) == "inactive"
    assert len(harness.commands) == count + 1


def test_who_was_frozen_for_a_lease_comes_back_as_a_newcomer(harness, faults):
    """The joint may be another's by then, and that one goes on undisturbed."""
    controller = harness.start_controller(**GAINS)
    far = OtherHost(harness)
    harness.wait(lambda: far.states(), what="the claim to be heard")
    os.kill(controller.pid, signal.SIGSTOP)
    time.sleep(LEASE + 0.3)  # not a wait for something: this is how long it is frozen
    younger = replace(far.claim, since_ns=time.time_ns())
    harness.wait(far.is_quiet, what="what it told before")
    count = len(far.states())
    far.tell(younger)
    os.kill(controller.pid, signal.SIGCONT)
    thawed = time.monotonic()
    beats = itertools.count()

    def has_yielded():
        if next(beats) % 10 == 0:  # some 4 Hz, as a controller does
            far.tell(younger)
        return "released" in far.states()

    harness.wait(has_yielded, within=5.0, what="it to yield")
    faults.count("ms from a thaw to having yielded", 1e3 * (time.monotonic() - thawed))
    assert "held" not in far.states()[count:]
    assert state(harness) == "inactive"


# --- two hosts, network namespaces, joined by a cable that is a pair of devices -------------

_HOLD = ("unshare", "--net", "--mount", "--ipc", "--", "sh", "-c")
_DEVICES = ("cable", "plug")
_SETUP = "mount -t tmpfs none /dev/shm && ip link set lo up && echo up && cat"


class HostsError(Exception):
    """This system permits no such hosts."""


@contextmanager
def two_hosts():
    """Yield for each host the command in front of what runs there, or raise HostsError."""
    holders = []
    try:
        for _ in range(2):
            try:
                holder = subprocess.Popen(
                    [*_HOLD, _SETUP],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.DEVNULL,
                )
            except FileNotFoundError as error:
                raise HostsError(str(error)) from error
            holders.append(holder)
            if not holder.stdout.readline():
                raise HostsError("no network namespaces")
        first, second = (holder.pid for holder in holders)
        first_device, second_device = _DEVICES
        inside = [_inside(first), _inside(second)]
        _run(
            *inside[0], *f"ip link add {first_device} type veth peer name {second_device}".split()
        )
        _run(*inside[0], "ip", "link", "set", second_device, "netns", str(second))
        for prefix, device, address in zip(inside, _DEVICES, (1, 2), strict=True):
            _run(*prefix, "ip", "address", "add", f"10.99.0.{address}/24", "dev", device)
            _run(*prefix, "ip", "link", "set", device, "up", "multicast", "on")
            _run(*prefix, "ip", "route", "add", "224.0.0.0/4", "dev", device)
        yield inside
    finally:
        for holder in holders:
            holder.communicate()


def pull(prefixes):
    """Let nothing through any more; the devices do not notice, as behind a switch."""
    for prefix, device in zip(prefixes, _DEVICES, strict=True):
        _run(*prefix, "tc", "qdisc", "replace", "dev", device, "root", "blackhole")


def plug(prefixes):
    """Let everything through again."""
    for prefix, device in zip(prefixes, _DEVICES, strict=True):
        _run(*prefix, "tc", "qdisc", "delete", "dev", device, "root")


def network_environment(environment):
    """Return the environment of nodes that talk through the network alone."""
    return {
        **environment,
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
        "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
    }


def _inside(pid):
    return ("nsenter", f"--target={pid}", "--net", "--mount", f"--wd={Path.cwd()}", "--")


def _run(*command):
    path = f"{os.environ['PATH']}:/usr/sbin:/sbin"  # where tc is, whatever a user's path says
    environment = {**os.environ, "PATH": path}
    run = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    if run.returncode != 0:
        raise HostsError(f"{' '.join(command)}: {run.stderr.strip()}")


@pytest.fixture
def hosts(tmp_path):
    """Return two groups of processes, each on a host of its own."""
    try:
        with own_domain() as domain, two_hosts() as prefixes, ExitStack() as stack:
            environment = network_environment(closed_environment(domain))
            groups = []
            for number, prefix in enumerate(prefixes):
                logs = tmp_path / str(number)
                logs.mkdir()
                group = NodeGroup(environment, logs, prefix=prefix)
                groups.append(stack.enter_context(group))
            yield groups, prefixes
    except HostsError as error:
        pytest.skip(str(error))


def start_on(group, name, **parameters):
    values = {"joint": "elbow", "wait_for_command_subscribers": 0, **GAINS, **parameters}
    return group.start(name, "joint_controller", ros_arguments(**values))


def test_two_hosts_agree_on_one_controller(hosts, faults):
    """At the same moment, one after the other, after kill -9, and when a network heals."""
    (here, there), prefixes = hosts
    for turn in range(2):
        group = [start_on(here, f"here_{turn}"), start_on(there, f"there_{turn}")]
        wait_until(
            lambda group=group: (
                [p.process.poll() for p in group].count(None) == 1
                and any("listening" in events(p) for p in group if p.process.poll() is None)
            ),
            what="one to be active and the other to end",
        )
        winner, loser = sorted(group, key=lambda each: each.process.poll() is not None)
        assert loser.process.returncode == 1
        assert f"commanded by /{winner.name} (process {winner.pid} on host " in log_of(loser)
        faults.count("simultaneous starts on two hosts with one active in the end")
        if turn == 0:
            (here if winner.name.startswith("here") else there).stop([winner.name])
    at_winner, at_other = (here, there) if winner in here.nodes.values() else (there, here)

    late = start_on(at_other, "late")
    # A busy machine may take longer to find the other host than a controller listens for.
    wait_until(lambda: "commanded by " in log_of(late), what="the late one to be refused")
    assert f"commanded by /{winner.name} " in log_of(late)
    if "listening" in events(late):
        at_other.stop(["late"])
    else:
        wait_until(lambda: late.process.poll() == 1, what="the late one to end")

    killed = time.monotonic()
    os.kill(winner.pid, signal.SIGKILL)
    again = start_on(at_winner, "again")
    wait_until(lambda: "listening" in events(again), what="a restart on the same host")
    faults.count("ms from kill -9 to active again, same host", 1e3 * (time.monotonic() - killed))

    pull(prefixes)
    second = start_on(at_other, "second")
    wait_until(lambda: "listening" in events(second), what="the other half to go on alone")
    plug(prefixes)
    healed = time.monotonic()
    wait_until(
        lambda: any("deactivated: " in log_of(each) for each in (again, second)),
        within=40.0,
        what="the halves to agree",
    )
    faults.count("ms from a network healed to one controller", 1e3 * (time.monotonic() - healed))
    assert "commanded by /again (process " in log_of(second)  # the older one goes on
    assert "commanded by" not in log_of(again)
    assert second.process.poll() is None  # it was active, its process goes on
    faults.count("networks healed with two active controllers")
