"""Compensation in real nodes: equal to the in-process engine, safe when states are not whole."""

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import JointState

from hpid_ros.base.files import share_folder
from hpid_ros.control import JointLoop, LoopSettings
from hpid_ros.experiment.compare import compare
from hpid_ros.experiment.description import load_experiment
from hpid_ros.experiment.in_process import NoProgress
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.messages.run import read_run
from hpid_ros.nodes.core.middleware import RARE
from hpid_ros.robot.compensation import compensators
from hpid_ros.robot.description import RobotDescription

ROBOT = str(share_folder() / "urdf" / "mobile_manipulator.urdf")
JOINTS = tuple(RobotDescription.load(ROBOT).joints)
ELBOW = "arm_joint_3"
MS = 1_000_000
UNIT_GAINS = {"p": 300.0, "i": 1000.0, "d": 30.0}  # three poles at -10 rad/s


def test_graph_and_in_process_engine_agree_to_the_last_bit_with_a_model(experiment_file, tmp_path):
    """Nine processes that each compute the model, and one that shares it between the joints."""
    experiment = load_experiment(
        experiment_file(
            compare={
                "gravity": {"law": "pid", "compensation": "gravity"},
                "decoupled": {
                    "law": "hpid",
                    "mu": -0.1,
                    "compensation": "decoupling",
                    "gains": UNIT_GAINS,
                    "model": {"payload": 0.4},
                },
            }
        )
    )
    results = [
        compare(
            experiment,
            tmp_path / name,
            NoProgress(),
            in_process=name == "in-process",
        )
        for name in ("graph", "in-process")
    ]
    first, second = [(each.folder.path / "result.json").read_bytes() for each in results]
    assert first == second
    for label in ("gravity", "decoupled"):
        graph, in_process = (read_run(each.folder.bag(label), "run").joints for each in results)
        for one, other in zip(graph, in_process, strict=True):
            assert np.array_equal(one.position, other.position)
            assert np.array_equal(one.effort, other.effort)


PARAMETERS = {
    "gains__p": 300.0,
    "gains__i": 0.0,
    "gains__d": 30.0,
    "law": "pid",
    "robot_description": ROBOT,
    "compensation": "decoupling",
    "model__left_wheel": "wheel_left_joint",
    "model__right_wheel": "wheel_right_joint",
    "introspection_rate": -1.0,
    "state_timeout": 0.01,
}


def ask(harness, stamp_ns, names=JOINTS, positions=None, efforts=None):
    """Publish one state of the whole robot and return the effort that answers it."""
    count = len(names)
    template = JointStateTemplate(names, position=True, velocity=True, effort=efforts is not None)
    harness.states.publish(
        template.encode(
            stamp_ns,
            position=positions or [0.3] * count,
            velocity=[0.0] * count,
            effort=efforts or (),
        )
    )
    harness.wait(
        lambda: any(each.stamp_ns == stamp_ns for each in harness.commands),
        what=f"the answer to {stamp_ns}",
    )
    return next(each.effort[0] for each in harness.commands if each.stamp_ns == stamp_ns)


def in_this_process():
    """Return the loop and the model that the node should be."""
    values = {
        key.replace("__", "."): value
        for key, value in PARAMETERS.items()
        if key not in ("robot_description", "introspection_rate")
    }
    settings = LoopSettings.from_parameters({"joint": ELBOW, **values})
    (model,) = compensators([settings], ROBOT)
    return JointLoop(settings), model


def test_a_node_with_a_model_answers_whole_states_and_survives_those_that_are_not(harness):
    terms, reports = [], []
    harness.node.create_subscription(JointState, "/elbow_controller/terms", terms.append, RARE)
    harness.node.create_subscription(
        DiagnosticArray, "/diagnostics", lambda each: reports.extend(each.status), RARE
    )
    harness.start_controller(joint=ELBOW, state_watchdog=False, **PARAMETERS)
    loop, model = in_this_process()
    order = model.states.joints
    efforts = [0.5 * k for k in range(len(JOINTS))]
    seen = [efforts[JOINTS.index(name)] for name in order]

    def expected(stamp_ns):
        term = model.term(stamp_ns, [0.3] * 8, [0.0] * 8, seen)
        return loop.step(stamp_ns, 0.3, 0.0, term)

    for k in range(1, 4):
        answer = ask(harness, k * MS, efforts=efforts)
        assert answer == expected(k * MS)
    assert answer != 0.0
    backwards = ask(harness, 4 * MS, names=JOINTS[::-1], efforts=efforts[::-1])
    assert backwards == expected(4 * MS)
    # A joint is missing, no efforts, efforts that are none: the last term stands ...
    others = [name for name in JOINTS if name != "arm_joint_1"]
    bad = [*efforts[:-1], float("nan")]
    for stamp_ns, state in (
        (5 * MS, {"names": others, "efforts": efforts[1:]}),
        (6 * MS, {}),
        (7 * MS, {"efforts": bad}),
    ):
        held = ask(harness, stamp_ns, **state)
        assert held == loop.step(stamp_ns, 0.3, 0.0, model.hold(stamp_ns, ""))
    # ... and not for longer than state_timeout.
    assert ask(harness, 15 * MS) == 0.0
    assert ask(harness, 16 * MS, efforts=efforts) != 0.0
    harness.wait(lambda: terms, what="terms")
    assert list(terms[0].name) == ["p", "i", "d", "model", "feedforward"]
    assert sum(terms[0].effort) == pytest.approx(answer, abs=1e-9)

    def values():
        return {each.key: each.value for each in reports[-1].values} if reports else {}

    harness.wait(lambda: values().get("states without a model term") == "1", what="a report")
    assert values()["compensation"] == "decoupling"
    assert values()["model terms held"] == "3"
    assert "no efforts" in values()["last fault of the model"]

    # Compensation is fixed, and gains are not.
    accepted, reason = harness.set_parameters("elbow_controller", compensation="none")
    assert not accepted
    assert "read-only" in reason
    assert harness.set_parameters("elbow_controller", model__payload=1.0)[0] is False
    assert harness.set_parameters("elbow_controller", gains__p=200.0)[0]
    # On a unit double integrator these gains are unstable, whatever the joint's inertia.
    accepted, reason = harness.set_parameters("elbow_controller", gains__i=1e5)
    assert not accepted
    assert "unstable" in reason or "Hurwitz" in reason or "p d" in reason
