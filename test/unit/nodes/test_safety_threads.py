"""Two threads beside the loop: what the decoder hands over, and what the supervisor commands."""

import math
import threading
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message
from std_msgs.msg import Float64
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from hpid_ros.base.errors import MessageError
from hpid_ros.control.loop_state import LoopMode
from hpid_ros.control.reference import Setpoint
from hpid_ros.messages.joint_trajectory import decode_trajectory
from hpid_ros.nodes.core import executor
from hpid_ros.nodes.core.executor import Supervisor
from hpid_ros.nodes.joint_controller import JointController
from hpid_ros.nodes.parts import references as controller_references
from hpid_ros.nodes.parts.joint_topics import Commands, Sink
from hpid_ros.nodes.parts.references import (
    ControllerReferences,
    ReferenceDecoder,
    TrajectorySubscriptions,
)
from hpid_ros.nodes.parts.settings_and_health import ControllerHealth

MS = 1_000_000


def trajectory(position, joint="elbow"):
    message = JointTrajectory(joint_names=[joint])
    message.points.append(JointTrajectoryPoint(positions=[position]))
    return bytes(serialize_message(message))


def setpoint(position):
    return bytes(serialize_message(Float64(data=position)))


def recorded_commands():
    """Return commands, and the list of what they publish."""
    sent = []
    return Commands(Sink(None, None, lambda *command: sent.append(command))), sent


def test_nothing_follows_the_last_zero_of_another_thread():
    commands, sent = recorded_commands()
    commands.fall_back(1.5, lambda: True)
    commands.cut()
    assert sent == []  # the joint was never driven: another controller may have it
    commands, sent = recorded_commands()
    commands.send(MS, 5.0, commands.cuts)
    commands.fall_back(1.5, lambda: False)
    commands.fall_back(1.5, lambda: True)
    commands.cut()
    commands.send(2 * MS, 6.0, commands.cuts)
    commands.restore()
    commands.send(3 * MS, 7.0, commands.cuts)
    commands.cut()
    commands.send(4 * MS, 8.0, commands.cuts)
    commands.fall_back(1.5, lambda: True)
    assert commands.leave()
    assert not commands.leave()
    commands.cut()
    assert sent == [(MS, 5.0), (MS + 1, 1.5), (MS + 1, 0.0), (3 * MS, 7.0), (3 * MS + 1, 0.0)]


def test_an_effort_that_was_computed_before_the_process_was_stopped_is_not_sent_after_it():
    commands, sent = recorded_commands()
    commands.send(MS, 5.0, commands.cuts)
    before = commands.cuts
    commands.cut()
    meanwhile = commands.cuts  # of a state that is answered until the process stands still
    commands.restore()
    commands.send(2 * MS, 6.0, before)
    commands.send(2 * MS, 6.0, meanwhile)
    commands.send(3 * MS, 7.0, commands.cuts)
    assert sent == [(MS, 5.0), (MS + 1, 0.0), (3 * MS, 7.0)]


def test_a_last_zero_that_could_not_be_sent_is_tried_again():
    sent, faults = [], [RuntimeError("the middleware"), None, None]

    def send(*command):
        if command[1] == 0.0 and (fault := faults.pop(0)):
            raise fault
        sent.append(command)

    commands = Commands(Sink(None, None, send))
    commands.send(MS, 5.0, commands.cuts)
    with pytest.raises(RuntimeError):
        commands.leave()
    assert commands.leave()
    commands.send(2 * MS, 6.0, commands.cuts)
    with commands._lock:
        commands.cut()  # a command is under way, for too long
    assert len(sent) == 3
    commands.cut()
    commands.cut()
    assert sent[1:] == [(MS, 0.0), (2 * MS, 6.0), (2 * MS + 1, 0.0)]


def test_a_joint_that_was_left_is_not_commanded_by_another_thread():
    commands, sent = recorded_commands()
    commands.send(MS, 5.0, commands.cuts)
    assert commands.leave()
    commands.fall_back(1.5, lambda: True)
    commands.cut()
    assert sent == [(MS, 5.0), (MS, 0.0)]


class Subscribed:
    """Subscriptions next to publishers, the messages they have taken, and a clock."""

    def __init__(self, monkeypatch, *publishers):
        self.now, self.taken, self.publishers = 0.0, [], list(publishers)
        self.node, self._timers = MagicMock(), []
        self.node.get_publishers_info_by_topic.side_effect = lambda _: list(self.publishers)
        monkeypatch.setattr(controller_references.time, "monotonic", lambda: self.now)
        monkeypatch.setattr(controller_references.threading, "Timer", self._timer)
        self.subscriptions = TrajectorySubscriptions(
            self.node, "elbow", lambda raw, is_latched, is_readable: self.taken.append(raw)
        )

    def _timer(self, within, hand_over, arguments):
        self._timers.append((self.now + within, *arguments))
        return MagicMock()

    @property
    def callbacks(self):
        """Of all that was ever subscribed: the volatile one, the latched one."""
        return [call.args[2] for call in self.node.create_subscription.call_args_list]

    def volatile(self, *messages):
        for each in messages:
            self.callbacks[0](each)

    def latched(self, *messages):
        for each in messages:
            self.callbacks[1](each)

    def wait(self, seconds):
        """Let time pass, and call what is due."""
        self.now += seconds
        while due := [each for each in self._timers if each[0] <= self.now]:
            self._timers = [each for each in self._timers if each not in due]
            for _, call in due:
                call()


def told(time, *joints):
    """Return the bytes of a trajectory that is told from others by a time."""
    message = JointTrajectory(joint_names=list(joints or ["elbow"]))
    message.header.stamp.sec = time
    return serialize_message(message)


FIRST, SECOND, THIRD = (told(time) for time in (1, 2, 3))


def publisher(name, durability=DurabilityPolicy.TRANSIENT_LOCAL):
    return SimpleNamespace(
        endpoint_gid=name, qos_profile=QoSProfile(depth=1, durability=durability)
    )


def test_only_a_latched_publisher_is_asked_for_what_it_had_published(monkeypatch):
    """A volatile one would be told that nothing is sent, by its own log."""
    given = Subscribed(monkeypatch, publisher(b"a", DurabilityPolicy.VOLATILE))
    given.subscriptions.look()
    assert len(given.callbacks) == 1
    given.publishers.append(publisher(b"b"))
    given.subscriptions.look()
    assert len(given.callbacks) == 2
    given.publishers[1:] = [publisher(b"c")]  # a second one of them would get what is old again
    given.subscriptions.look()
    assert len(given.callbacks) == 2
    given.subscriptions.close()
    assert given.node.destroy_subscription.call_count == 2


def test_what_a_latched_publisher_sends_to_both_subscriptions_is_taken_once(monkeypatch):
    given = Subscribed(monkeypatch, publisher(b"a"))
    given.latched(FIRST)
    given.volatile(FIRST, SECOND)
    given.latched(SECOND, SECOND)
    given.volatile(SECOND, SECOND)  # once more, and then by somebody who does not latch
    given.wait(1.0)
    assert given.taken == [FIRST, SECOND, SECOND, SECOND]


@pytest.mark.parametrize("is_first", [False, True])
def test_the_message_that_was_published_last_is_taken_last_whichever_comes_first(
    monkeypatch, is_first
):
    """The latched subscription keeps one: it is ahead where both have come before it is read."""
    given = Subscribed(monkeypatch, publisher(b"a"))
    if is_first:
        given.latched(SECOND)
    given.volatile(FIRST)
    if not is_first:
        given.latched(SECOND)
    given.volatile(SECOND)
    given.wait(1.0)
    assert given.taken == [FIRST, SECOND]


def test_what_had_been_published_before_is_taken_unless_something_newer_comes(monkeypatch):
    given = Subscribed(monkeypatch, publisher(b"a"))
    given.latched(FIRST)
    given.volatile(told(9, "wrist"), b"unreadable")  # what concerns others does not replace it
    assert given.taken == [b"unreadable"]
    given.wait(0.06)
    assert given.taken == [b"unreadable", FIRST]
    given.latched(SECOND)
    given.volatile(THIRD)
    given.latched(FIRST)
    given.subscriptions.discard()  # a setpoint has come
    given.wait(1.0)
    assert given.taken == [b"unreadable", FIRST, THIRD]
    given.latched(SECOND)
    given.subscriptions.close()
    given.wait(1.0)
    assert given.taken == [b"unreadable", FIRST, THIRD]


def test_what_was_taken_before_there_was_a_latched_subscription_is_not_taken_again(monkeypatch):
    given = Subscribed(monkeypatch)
    given.volatile(FIRST)
    given.wait(1.5)
    given.volatile(SECOND)
    given.publishers.append(publisher(b"a"))
    given.wait(1.0)  # the graph shows it late
    given.subscriptions.look()
    given.wait(1.5)  # a busy machine
    given.latched(SECOND, FIRST)
    given.wait(1.0)
    assert given.taken == [FIRST, SECOND]
    given.latched(THIRD)
    given.wait(1.0)
    assert given.taken == [FIRST, SECOND, THIRD]


def test_a_trajectory_that_comes_again_later_is_another_one(monkeypatch):
    """A late joiner had the latched one, and somebody sends the same with a volatile publisher."""
    given = Subscribed(monkeypatch, publisher(b"a"))
    given.latched(FIRST)
    given.wait(0.06)
    given.volatile(FIRST)
    assert given.taken == [FIRST]
    given.wait(5.0)
    given.volatile(FIRST)
    given.latched(FIRST)
    given.wait(5.0)
    given.volatile(FIRST)
    assert given.taken == [FIRST] * 3


def test_a_check_that_raises_is_called_again(capsys):
    """Else no later silence of the states would get the fallback effort."""
    is_again, checks = threading.Event(), []

    def check():
        checks.append(None)
        if len(checks) == 1:
            raise RuntimeError("the middleware")
        is_again.set()
        return math.inf

    supervisor = Supervisor()
    supervisor._nodes = [SimpleNamespace(check=check)]
    thread = threading.Thread(target=supervisor._supervise)
    thread.start()
    try:
        assert is_again.wait(10.0)
    finally:
        supervisor._wake(0)
        thread.join()
    assert "RuntimeError: the middleware" in capsys.readouterr().err


def test_a_stop_has_the_time_back_in_which_the_process_stood_still():
    """As with Ctrl-Z during a damping stop: it goes on, and no callback is to blame."""
    supervisor = Supervisor()
    supervisor.request()
    supervisor.is_heeded = True
    supervisor._asked_at -= 10.0
    supervisor._excuse(10.0)
    supervisor._end()
    assert not supervisor.has_cut_effort
    assert supervisor._end() == pytest.approx(executor._LEFT_WITHIN, abs=2.0)


@pytest.mark.parametrize("state", [LoopMode.SILENT, LoopMode.HOLDING])
def test_after_a_timeout_a_joint_is_called_controlled_from_the_first_usable_state(state):
    controller = MagicMock(**{"_has_timed_out.return_value": False})
    controller._loop.state.mode = state
    JointController._report(controller)
    assert controller.get_logger().info.called is (state is LoopMode.HOLDING)


def test_where_nobody_reads_errors_the_process_ends_all_the_same(monkeypatch):
    unread = MagicMock(**{"write.side_effect": BrokenPipeError})
    monkeypatch.setattr("sys.stderr", unread)
    monkeypatch.setattr("os._exit", MagicMock(side_effect=SystemExit))
    with pytest.raises(SystemExit):
        Supervisor()._end_without_executor("", 60.0)
    assert executor._attempt(lambda: 1 / 0, "next") == "next"
    assert executor._refuse("a line") == executor.BAD_INPUT


def test_a_warning_of_the_last_report_is_of_that_alone_also_behind_another_one():
    certification, loop = MagicMock(warning="not certified"), MagicMock()
    loop.counts.missed, loop.estimation.warning, loop.relay, loop.dropped = 0, "", None, ""
    loop.settings.timing.control_period, loop.state.mode = 0.001, LoopMode.HOLDING
    health = ControllerHealth(MagicMock(), loop, certification, SimpleNamespace(recent=dict))
    health.publish = MagicMock()
    loop.counts.missed = 900
    health.report("active", "", "", "")
    assert health.publish.call_args.args[1] == "not certified"
    certification.warning = ""
    health.report("active", "", "", "")
    assert health.publish.call_args.args[1] == LoopMode.HOLDING.value


def test_a_reference_that_was_refused_is_named_until_a_good_one_comes_or_for_a_while():
    loop = MagicMock(relay=None, dropped="")
    loop.estimation.warning, loop.state.mode = "", LoopMode.HOLDING
    loop.counts.missed, loop.settings.timing.control_period = 0, 0.001
    health = ControllerHealth(
        MagicMock(), loop, MagicMock(warning=""), SimpleNamespace(recent=dict)
    )
    health.publish = MagicMock()

    def messages(count):
        for _ in range(count):
            health.report("active", "", "", "")
            yield health.publish.call_args.args[1]

    held, refused = LoopMode.HOLDING.value, "reference refused: no good"
    health.refused_reference("no good")
    assert set(messages(30)) == {refused}
    assert set(messages(2)) == {held}
    loop.dropped = "no good"
    assert set(messages(2)) == {refused}
    health.accepted_reference()
    assert set(messages(2)) == {held}


def test_of_a_flood_the_newest_is_decoded_and_what_all_have_got_is_decoded_once(monkeypatch):
    decoded, may_go_on, is_busy = [], threading.Event(), threading.Event()

    def decode(raw):
        decoded.append(raw)
        is_busy.set()
        assert may_go_on.wait(10.0)
        return raw

    monkeypatch.setattr("hpid_ros.nodes.parts.references.decode_trajectory", decode)
    decoder, taken, is_done = ReferenceDecoder(), [], threading.Event()
    decoder.decode("a", b"0", taken.append)
    assert is_busy.wait(10.0)
    for k in range(1, 40):
        decoder.decode("a", b"%d" % k, taken.append)
    decoder.decode("b", b"39", taken.append)
    decoder.decode("c", b"", lambda each: is_done.set())
    may_go_on.set()
    assert is_done.wait(10.0)
    assert decoded == [b"0", b"39", b""]
    assert taken == [b"0", b"39", b"39"]


def decoded(raw):
    try:
        return decode_trajectory(raw)
    except MessageError as error:
        return error


class Listener:
    """What :class:`ControllerReferences` needs of a node."""

    def __init__(self, monkeypatch):
        self.tasks, self.decoding = [], {}
        self.callbacks, self.followed, self.refused = {}, [], []
        self.reason = ""
        monkeypatch.setattr(controller_references, "reference_decoder", lambda: self)
        self.references = ControllerReferences(
            self,
            "elbow",
            lambda motion, is_latched: self.followed.append(motion),
            lambda relay: None,
            self.refused.append,
            lambda: self.reason,
        )
        self.trajectory = self.callbacks["joint_trajectory"]
        self.setpoint = self.callbacks["~/setpoint"]

    def create_subscription(self, kind, topic, callback, *more, **options):
        self.callbacks[topic] = callback
        return SimpleNamespace(topic_name=topic)

    def get_publishers_info_by_topic(self, topic):
        return []

    def resolve_topic_name(self, topic):
        return f"/{topic}"

    def has_parameter(self, name):
        return True

    def destroy_subscription(self, subscription):
        pass

    def decode(self, source, raw, take):
        self.decoding[source] = raw, take

    def hand_over(self, callback, *arguments):
        self.tasks.append(lambda: callback(*arguments))

    def guarded(self, topic, callback):
        return callback

    def finish(self):
        """Decode what has come, and let the executor run."""
        for raw, take in self.decoding.values():
            take(decoded(raw))
        for task in self.tasks:
            task()
        self.decoding, self.tasks = {}, []


def test_what_others_follow_and_what_nobody_can_read_replaces_nothing_that_waits(monkeypatch):
    listener = Listener(monkeypatch)
    for raw in (trajectory(1.0), trajectory(2.0), trajectory(3.0, "another"), b"\x00"):
        listener.trajectory(raw)
    listener.finish()
    (followed,) = listener.followed
    assert followed.knots[0].position == 2.0
    assert len(listener.refused) == 1


def test_the_reference_that_came_last_wins_however_long_one_takes_to_decode(monkeypatch):
    listener = Listener(monkeypatch)
    listener.trajectory(trajectory(1.0))
    listener.setpoint(setpoint(2.0))
    listener.finish()
    assert listener.followed == [Setpoint(2.0)]
    listener.trajectory(trajectory(3.0))
    listener.setpoint(setpoint(float("nan")))  # no reference
    listener.finish()
    assert listener.followed[-1].knots[0].position == 3.0
    assert len(listener.refused) == 1


def test_what_comes_while_none_is_taken_is_refused_and_what_is_left_behind_forgotten(monkeypatch):
    listener = Listener(monkeypatch)
    listener.reason = "the controller is not active"
    listener.trajectory(trajectory(1.0))
    listener.trajectory(trajectory(1.0, "another"))  # no business of this joint
    listener.reason = ""
    listener.finish()  # it is active by now
    assert (listener.followed, listener.refused) == ([], ["the controller is not active"])
    listener.trajectory(trajectory(2.0))
    listener.references.discard()
    listener.finish()
    assert listener.followed == []
    listener.trajectory(b"\x00")
    listener.trajectory(trajectory(float("inf")))
    listener.finish()
    assert listener.followed == []
    assert len(listener.refused) == 3
