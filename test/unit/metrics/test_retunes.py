"""Changes of parameters while a bag was recorded are found and put on the states' clock."""

import pytest
from harness.bags import JOINT_STATE, MS, parameter_event

from hpid_ros.cli.commands import DONE
from hpid_ros.cli.main import main
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.messages.messages import PARAMETER_EVENTS, read_retunes
from hpid_ros.messages.writer import BagWriter

WALL_NS = 1_700_000_000_000_000_000  # the recorder's clock, far from the states'


@pytest.fixture
def bag(tmp_path):
    state = JointStateTemplate(["elbow"], position=True)
    command = JointStateTemplate(["elbow"], effort=True)
    with BagWriter(tmp_path / "run") as writer:
        states = writer.add_topic("/joint_states", JOINT_STATE)
        commands = writer.add_topic("/joint_commands", JOINT_STATE)
        events = writer.add_topic("/parameter_events", PARAMETER_EVENTS)
        writer.write(
            events, WALL_NS, parameter_event("/elbow_controller", mu=0.1)
        )  # before any state
        for k in range(200):
            now = WALL_NS + 1 + k * MS
            writer.write(states, now, state.encode(k * MS, position=[0.01 * k]))
            writer.write(commands, now + 1, command.encode(k * MS, effort=[1.0 / (1 + k)]))
            if k == 50:
                raw = parameter_event("/elbow_controller", mu=-0.2, gains__p=60.0)
                writer.write(events, now + 2, raw)
            if k == 120:
                writer.write(events, now + 2, parameter_event("/elbow_controller", law="pid"))
                writer.write(events, now + 3, parameter_event("/camera", exposure=3.0))
    return tmp_path / "run"


def test_retunes_stand_at_the_state_before_them_and_foreign_ones_are_left_out(bag):
    found = [(each.stamp_ns, each.node, each.change) for each in read_retunes(bag)]
    assert found == [
        (50 * MS, "/elbow_controller", "mu = -0.2, gains.p = 60"),
        (120 * MS, "/elbow_controller", "law = pid"),
    ]


def test_the_report_of_a_bag_with_retunes_lists_them(bag, tmp_path):
    page = tmp_path / "report.html"
    assert main(["metrics", str(bag), "--report", str(page)]) == DONE
    text = page.read_text(encoding="utf-8")
    assert "Retuned while running" in text
    assert '"marks":[{"run":0,"x":0.05},{"run":0,"x":0.12}]' in text


def test_a_bag_without_parameter_events_has_no_retunes(tmp_path):
    state = JointStateTemplate(["elbow"], position=True)
    with BagWriter(tmp_path / "run") as writer:
        topic = writer.add_topic("/joint_states", JOINT_STATE)
        writer.write(topic, WALL_NS, state.encode(0, position=[0.0]))
    assert read_retunes(tmp_path / "run") == ()
