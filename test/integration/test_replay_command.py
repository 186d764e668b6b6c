"""``hpid replay``: what was recorded against what the law answers."""

import shutil

import pytest
import yaml
from harness.bags import (
    FLOATS,
    JOINT_STATE,
    MS,
    BagReader,
    convert,
    floats,
    parameter_event,
    serialised,
)
from harness.experiments import write_experiment
from harness.loops import loop_settings
from harness.studies import compared
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from hpid_ros.base.names import ALLOW_RELAY
from hpid_ros.control import JointLoop, LoopSettings
from hpid_ros.control.overrides import RelayRequest
from hpid_ros.control.reference import Setpoint
from hpid_ros.messages.joint_state import JointStateTemplate, decode_joint_state
from hpid_ros.messages.messages import PARAMETER_EVENTS
from hpid_ros.messages.metadata import CONTROLLERS_ENTRY, custom_data
from hpid_ros.messages.writer import BagWriter

FLOAT = "std_msgs/msg/Float64"


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """The bag of a short run in this process, with noise, a push and a load that comes."""
    folder = tmp_path_factory.mktemp("run")
    wrench = {"link": "payload", "from": 0.15, "duration": 0.1, "force": [40.0, 10.0, 0.0]}
    file = write_experiment(
        folder,
        sensors={"noise": 1e-4, "encoder_counts": 65536},
        disturbances={"payload": [{"time": 0.1, "mass": 1.5}], "wrenches": [wrench]},
    )
    return compared(file, folder / "result") / "bags" / "hPID"


def rewritten(bag, target, change, keeps_parameters=True):
    """Write a bag again, with each message as ``change(topic, raw)`` gives it; None drops it."""
    metadata = {CONTROLLERS_ENTRY: custom_data(bag)[CONTROLLERS_ENTRY]} if keeps_parameters else {}
    with BagReader(bag) as reader, BagWriter(target, metadata=metadata) as writer:
        topics = {
            name: writer.add_topic(name, each.msgtype) for name, each in reader.topics.items()
        }
        for message in reader.messages():
            raw = change(message.topic, message.raw)
            if raw is not None:
                writer.write(topics[message.topic], message.log_time_ns, raw)
    return target


def test_every_command_of_a_run_is_the_laws(bag, hpid):
    code, out, _ = hpid("replay", bag)
    assert code == 0
    assert "arm_joint_6: 301 commands, every one the law's" in out
    assert out.splitlines()[-1] == "every one of 2 408 commands is the law's, to the last bit"
    code, out, _ = hpid("replay", bag / "hPID.mcap", "--joint", "arm_joint_2")
    assert code == 0
    assert out.splitlines()[-1] == "every one of 301 commands is the law's, to the last bit"


def test_a_tampered_command_is_named(bag, tmp_path, hpid):
    def change(topic, raw):
        fields = decode_joint_state(raw) if topic == "/joint_commands" else None
        if fields is None or fields.names != ("arm_joint_2",) or fields.stamp_ns != 100_000_000:
            return raw
        template = JointStateTemplate(fields.names, fields.frame_id, effort=True)
        return template.encode(fields.stamp_ns, effort=[1.5])

    code, out, _ = hpid("replay", rewritten(bag, tmp_path / "bag", change))
    assert code == 1
    assert "arm_joint_2: 1 of 301 commands differ" in out
    assert "at 0.100 s: 1.5 N m was sent, the law answers " in out
    assert out.splitlines()[-1] == "2 407 of 2 408 commands are the law's"


def test_what_is_missing_is_said_in_one_line(bag, tmp_path, refused):
    bare = rewritten(bag, tmp_path / "bare", lambda topic, raw: raw, keeps_parameters=False)
    quiet = rewritten(
        bag, tmp_path / "quiet", lambda topic, raw: None if topic == "/joint_commands" else raw
    )
    damaged = shutil.copytree(bag, tmp_path / "damaged")
    (damaged / "metadata.yaml").write_text("{")
    for arguments, words in (
        ([bare], "does not hold its controllers' parameters: give them with --params FILE"),
        ([bag, "--joint", "elbow"], "elbow"),
        ([tmp_path / "nothing"], "no bag"),
        ([quiet], "no command for"),
        ([damaged], "does not hold its controllers' parameters"),
    ):
        assert words in refused("replay", *arguments)


SETTINGS = {
    **{"law": "pid", "gains__p": 40.0, "gains__i": 20.0, "gains__d": 8.0},
    **{"velocity_source": "filtered", "u_clamp_max": 20.0, "u_clamp_min": -20.0},
}
RELAY = [2.0, 0.002, 0.5, 3.0, 5.0]


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """A joint that is told everything there is, recorded as ros2 bag record does into SQLite."""
    folder = tmp_path_factory.mktemp("told")
    loop, node = JointLoop(loop_settings(joint="elbow", **SETTINGS)), "/left/first_controller"

    def retune(loop):
        values = {**loop.settings.to_parameters(), "gains.p": 60.0}
        loop.retune(LoopSettings.from_parameters(values))

    def nothing(loop):
        """The controller refuses it, or it is another's."""

    def change(name, value, act, node=node):
        return "events", parameter_event(node, **{name: value}), act

    told = {
        10: ("relay", floats(*RELAY), nothing),
        20: ("relay", floats(), nothing),
        30: change(ALLOW_RELAY, True, nothing),
        50: ("relay", floats(*RELAY), lambda loop: loop.begin_relay(RelayRequest(*RELAY))),
        900: change(ALLOW_RELAY, False, lambda loop: loop.end_relay("")),
        1200: ("relay", floats(*RELAY), nothing),
        1300: change("gains.p", 60.0, retune),
        1350: ("setpoint", serialised(FLOAT, 0.3), lambda loop: loop.follow(Setpoint(0.3))),
        1400: change("gains.p", 1.0, nothing, "/right/first_controller"),
    }
    state = JointStateTemplate(["elbow"], position=True)
    command = JointStateTemplate(["elbow"], node, effort=True)
    position = velocity = 0.0

    with BagWriter(folder / "mcap") as writer:
        states = writer.add_topic("/left/joint_states", JOINT_STATE)
        commands = writer.add_topic("/left/joint_commands", JOINT_STATE)
        topics = {
            "relay": writer.add_topic(f"{node}/relay", FLOATS),
            "setpoint": writer.add_topic(f"{node}/setpoint", FLOAT),
            "events": writer.add_topic("/parameter_events", PARAMETER_EVENTS),
        }
        for k in range(1500):
            if k in told:
                topic, raw, act = told[k]
                writer.write(topics[topic], k * MS - 1, raw)
                act(loop)
            effort = loop.step(k * MS, position)
            writer.write(states, k * MS, state.encode(k * MS, position=[position]))
            writer.write(commands, k * MS + 1, command.encode(k * MS, effort=[effort]))
            velocity += 1e-3 * (effort - 0.5 * velocity) / 0.2
            position += 1e-3 * velocity
    assert loop.relay.cycles > 1
    convert(folder / "mcap", folder / "bag", StoragePlugin.SQLITE3, CompressionMode.NONE)
    parameters = folder / "controllers.yaml"
    own = {"joint": "elbow", **{k.replace("__", "."): v for k, v in SETTINGS.items()}}
    parameters.write_text(yaml.safe_dump({node: {"ros__parameters": own}}))
    return folder / "bag", ("--params", parameters, "--namespace", "left")


def test_relays_setpoints_and_changes_of_a_namespace_are_replayed(told, hpid):
    bag, options = told
    code, out, _ = hpid("replay", bag, *options)
    assert out.splitlines()[-1] == "every one of 1 500 commands is the law's, to the last bit"
    assert code == 0
    assert "a relay was left out: relays are not allowed: allow_relay is false" in out


def test_a_bag_of_ros2_control_gets_one_line_about_what_it_lacks(told, tmp_path, refused):
    _, options = told
    states = JointStateTemplate(["elbow"], position=True, effort=True)
    with BagWriter(tmp_path / "bag") as writer:
        topics = [
            writer.add_topic("/joint_states", JOINT_STATE),
            writer.add_topic("/effort_controller/commands", FLOATS),
        ]
        for k in range(20):
            writer.write(topics[0], k * MS, states.encode(k * MS, position=[0.1], effort=[1.0]))
            writer.write(topics[1], k * MS + 1, floats(1.0))
    err = refused("replay", tmp_path / "bag", *options[:2])
    assert "no topic of stamped commands" in err
    assert "those on /effort_controller/commands have no stamps" in err
