"""Joints that slide: m and N wherever a number of theirs is told, and the same numbers."""

import csv
import io
import json
import re
import shutil
from argparse import Namespace
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from harness.bags import JOINT_STATE, MS, command, ramp, serialised, state, trajectory
from harness.studies import compared

from hpid_bench.cli.commands import BAD_INPUT, DONE
from hpid_bench.cli.options import sliding_joints_from
from hpid_bench.report.figures import figures_of
from hpid_bench.tuning.upgrade import Proposals, Upgrade
from hpid_bench.tuning.upgrade_page import _changes
from hpid_ros.control import Gains, LoopSettings
from hpid_ros.messages.metadata import SLIDES_ENTRY, recorded_slides, slides_entry
from hpid_ros.messages.series import RunSeries
from hpid_ros.messages.writer import BagWriter
from hpid_ros.metrics import measure
from hpid_ros.metrics.comparison import Comparison
from hpid_ros.metrics.run_numbers import run_indices
from hpid_ros.metrics.texts import FORMATS

ROBOT = """<robot name="lift">
  <link name="base"/>
  <link name="car"><inertial><mass value="2"/>
    <inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.02"/></inertial></link>
  <link name="arm"><inertial><origin xyz="0.2 0 0"/><mass value="0.5"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial></link>
  <joint name="lift" type="prismatic"><parent link="base"/><child link="car"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="200" velocity="2"/></joint>
  <joint name="turn" type="revolute"><parent link="car"/><child link="arm"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="20" velocity="5"/></joint>
</robot>
"""
EXPERIMENT = """name: lift
robot: {description: lift.urdf, fixed_base: true}
simulation: {engine: mujoco}
control: {rate: 250}
duration: 0.4
reference:
  kind: step
  times: [0.0, 0.1]
  positions: {lift: [0.0, 0.2], turn: [0.0, 0.5]}
controllers:
  common: {norm: {error_scale: 0.1, rate_weight: 0.6}}
  joints:
    lift: {gains: {p: 400.0, i: 400.0, d: 60.0}, inertia: 2.5}
    turn: {gains: {p: 8.0, i: 8.0, d: 1.0}, inertia: 0.03}
compare:
  PID: {law: pid}
  hPID: {law: hpid, mu: -0.1}
"""
NOTE = "lift slides, in m and N; the others are in rad and N m. Totals add unlike units."


@pytest.fixture(scope="module")
def experiment(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lift")
    (folder / "lift.urdf").write_text(ROBOT)
    (folder / "lift.yaml").write_text(EXPERIMENT)
    return folder / "lift.yaml"


@pytest.fixture(scope="module")
def result(experiment):
    """Return the folder of a comparison."""
    return compared(experiment, experiment.with_name("result"))


def rows_of(text):
    return list(csv.DictReader(io.StringIO(text)))


def units_of(text):
    return {(row["joint"], row["quantity"]): row["unit"] for row in rows_of(text)}


# Tables ----------------------------------------------------------------------------------------


def test_every_format_names_both_units_and_which_joints_slide(hpid, result):
    _, table, _ = hpid("metrics", result)
    for heading in ("IVC [N m, N]", "ITAE [rad s^2, m s^2]", "||u|| [N m s^0.5, N s^0.5]"):
        assert heading in table
    assert table.count(NOTE) == 1
    _, overall, _ = hpid("metrics", result, "--overall", "--indices", "all", "--units", "deg")
    for heading in ("RMSE [deg, m]", "energy [J]", NOTE.replace("rad", "deg")):
        assert heading in overall
    _, text, _ = hpid("metrics", result, "--csv", "--indices", "all")
    units = units_of(text)
    for joint, ivc, rmse in (("lift", "N", "m"), ("turn", "N m", "rad"), ("", "N m, N", "rad, m")):
        assert (units[joint, "ivc"], units[joint, "rmse"]) == (ivc, rmse)
    found = json.loads((result / "result.json").read_text())["indices"]["runs"]["hPID"]
    assert (found["slides"], found["units"]["ivc"]) == (["lift"], "N m, N")
    assert [found["joint_units"][joint]["chatter"] for joint in ("lift", "turn")] == ["N", "N m"]


@pytest.mark.parametrize(
    ("options", "there", "absent"),
    [
        (("--joints", "lift"), "ITAE [m s^2]", r"\brad\b|N m|slides"),
        (("--joints", "turn"), "ITAE [rad s^2]", "slides"),
        (("--indices", "rise_time,energy"), "energy [J]", "slides"),  # no unit is another one
    ],
)
def test_where_there_is_one_unit_there_is_no_note(hpid, result, options, there, absent):
    _, table, _ = hpid("metrics", result, *options)
    assert there in table
    assert not re.search(absent, table)


# Numbers ---------------------------------------------------------------------------------------


def test_nothing_but_units_changes_where_a_joint_slides(result):
    """The same arrays with and without: the same numbers."""
    series = measure(result / "bags" / "hPID").series
    sliding, turning = (run_indices(series.with_slides(each)) for each in ({"lift"}, ()))
    assert replace(sliding, slides=frozenset()) == turning
    one, other = (rows_of(FORMATS["csv"](Comparison((run,)))) for run in (sliding, turning))
    assert [{**row, "unit": ""} for row in one] == [{**row, "unit": ""} for row in other]
    assert not {"slides", "joint_units"} & set(
        re.findall(r"\w+", FORMATS["json"](Comparison((turning,))))
    )


def test_degrees_leave_alone_what_slides(hpid, result):
    of_unit = {}
    for unit in ("rad", "deg"):
        _, text, _ = hpid("metrics", result, "--csv", "--indices", "all", "--units", unit)
        of_unit[unit] = {
            (row["run"], row["joint"], row["quantity"]): float(row["value"])
            for row in rows_of(text)
            if row["value"]
        }
    degree = 180.0 / np.pi
    rad, deg = of_unit["rad"], of_unit["deg"]
    for (label, joint, key), value in rad.items():
        if joint == "lift":
            assert deg[label, joint, key] == value
    for label in ("PID", "hPID"):
        lift, turn = (rad[label, joint, "itae"] for joint in ("lift", "turn"))
        assert deg[label, "", "itae"] == pytest.approx(lift + degree * turn, rel=1e-12)
        lift, turn = (rad[label, joint, "error_l2"] for joint in ("lift", "turn"))
        assert deg[label, "", "error_l2"] == pytest.approx(np.hypot(lift, degree * turn), rel=1e-9)
        largest = max(rad[label, "lift", "error_max"], degree * rad[label, "turn", "error_max"])
        assert deg[label, "", "error_max"] == pytest.approx(largest, rel=1e-12)
        assert deg[label, "", "ivc"] == rad[label, "", "ivc"]


@pytest.mark.parametrize("unit", ["rad", "deg"])
def test_saved_numbers_keep_their_units(hpid, result, tmp_path, unit):
    saved = tmp_path / "saved.json"
    _, first, _ = hpid("metrics", result, "--units", unit, "--save", saved, "--csv")
    _, again, _ = hpid("metrics", saved, "--units", unit, "--csv")
    assert again == first
    _, other, _ = hpid("metrics", saved, "--units", "deg", "--csv")
    assert units_of(other)["lift", "itae"] == "m s^2"
    assert units_of(other)["turn", "itae"] == "deg s^2"


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"slides": ["hoist"]}, "unknown joint 'hoist'"),
        ({"slides": 3}, "is damaged"),
        ({"slides": []}, "itae is in 'rad s^2, m s^2', but must be in rad s^2 or deg s^2"),
    ],
)
def test_saved_numbers_that_contradict_themselves_are_refused(
    refused, result, tmp_path, change, line
):
    document = json.loads((result / "result.json").read_text())["indices"]
    document["runs"]["PID"] |= change
    (tmp_path / "x.json").write_text(json.dumps(document))
    assert line in refused("metrics", tmp_path / "x.json")


def test_medians_over_both_kinds_are_not_turned_into_degrees(hpid, refused, result, tmp_path):
    bag, saved = result / "bags" / "PID", tmp_path / "medians.json"
    code, table, _ = hpid("metrics", "--group", "A", bag, bag, "--units", "deg", "--save", saved)
    assert code == DONE  # single runs can be
    assert "ITAE [deg s^2, m s^2]" in table
    errors = refused("metrics", saved)
    assert "its totals cannot be given in rad; give the single runs" in errors


# Where it is told from -------------------------------------------------------------------------


def foreign_bag(path, description=None, *, has_reference=True, namespace="/"):
    """Write a bag as ``ros2 bag record`` does: no word of this package's in its metadata."""
    log = [
        *(state(k * MS, lift=0.001 * k, turn=0.002 * k) for k in range(100)),
        *(command(k * MS, lift=1.0 + k % 3, turn=2.0 + k % 5) for k in range(100)),
    ]
    kinds = {"joint_states": JOINT_STATE, "joint_commands": JOINT_STATE}
    if has_reference:
        kinds["joint_trajectory"] = "trajectory_msgs/msg/JointTrajectory"
        log += [trajectory(0, ramp(joint, t1=0.2)) for joint in ("lift", "turn")]
    with BagWriter(path) as bag:
        topics = {name: bag.add_topic(namespace + name, kind) for name, kind in kinds.items()}
        if description is not None:
            kind = "std_msgs/msg/String"
            topic = bag.add_topic(f"{namespace}robot_description", kind)
            bag.write(topic, 0, serialised(kind, description))
        for name, log_time_ns, raw in sorted(log, key=lambda each: each[1]):
            bag.write(topics[name], log_time_ns, raw)
    return path


def test_a_bag_of_this_package_says_it_wherever_it_lies(hpid, result, tmp_path):
    moved = tmp_path / "moved"
    shutil.copytree(result / "bags" / "hPID", moved)
    _, text, _ = hpid("metrics", moved, "--csv")
    assert units_of(text)["lift", "ivc"] == "N"


@pytest.mark.parametrize(
    ("description", "namespace", "unit"),
    [(ROBOT, "/", "N"), (ROBOT, "/left/", "N"), (None, "/", "N m")],
    ids=["said", "in a namespace", "not said"],
)
def test_a_latched_description_in_the_bag_says_it(hpid, tmp_path, description, namespace, unit):
    bag = foreign_bag(tmp_path / "bag", description, namespace=namespace)
    options = () if namespace == "/" else ("--namespace", "left")
    _, text, errors = hpid("metrics", bag, "--csv", *options)
    assert (units_of(text)["lift", "ivc"], units_of(text)["turn", "ivc"]) == (unit, "N m")
    assert "robot_description" not in errors


@pytest.mark.parametrize("text", ["<robot", "not a robot", "<sdf/>"])
def test_a_description_that_cannot_be_used_is_told_and_passed_over(hpid, tmp_path, text):
    code, table, errors = hpid("metrics", foreign_bag(tmp_path / "bag", text))
    assert code == DONE
    assert "IVC [N m]" in table
    assert "/robot_description does not tell which joints slide" in " ".join(errors.split())


def test_a_named_robot_says_it_also_where_its_end_effector_cannot_be_followed(
    hpid, experiment, tmp_path
):
    bag = foreign_bag(tmp_path / "bag", has_reference=False)
    urdf = experiment.with_name("lift.urdf")
    for robot in (urdf, experiment):
        _, table, errors = hpid("metrics", bag, "--robot", robot)
        assert "IVC [N m, N]" in table
    assert "the end effector is not followed" in errors
    code, _, errors = hpid("metrics", bag, "--robot", urdf, "--end-effector", "arm")
    assert code == BAD_INPUT
    assert "no reference of" in errors


def test_what_one_recording_knows_holds_for_all_beside_it(hpid, experiment, tmp_path):
    silent, telling = foreign_bag(tmp_path / "a"), foreign_bag(tmp_path / "b", ROBOT)
    saved = tmp_path / "saved.json"
    _, text, _ = hpid("metrics", silent, "--units", "deg", "--save", saved, "--csv")
    assert units_of(text)["lift", "itae"] == "deg s^2"  # nobody knew
    _, text, _ = hpid("metrics", saved, telling, "--units", "deg", "--csv")
    assert {row["unit"] for row in rows_of(text) if row["joint"] == "lift"} == {
        "N",
        "N s",
        "m s^2",
    }
    for row in rows_of(text):
        if row["ratio"]:
            assert float(row["ratio"]) == pytest.approx(1.0, rel=1e-12)


@pytest.mark.parametrize("entry", ["", "{", '"lift"', "[3]", "{}"])
def test_metadata_come_back_and_damaged_ones_say_nothing(entry):
    assert recorded_slides(slides_entry({"a", "b"})) == {"a", "b"}
    assert recorded_slides({SLIDES_ENTRY: entry}) == frozenset()


# Drawings --------------------------------------------------------------------------------------


def test_a_panel_has_its_joints_unit_and_a_shared_axis_both(result):
    series = [measure(result / "bags" / label, label).series for label in ("PID", "hPID")]
    comparison = Comparison(tuple(run_indices(run) for run in series))
    both = {each.name: each for each in figures_of(comparison, series, 200)}
    for name, axis, titles in (
        ("positions", "position [rad, m]", ["lift [m]", "turn [rad]"]),
        ("efforts", "effort [N m, N]", ["lift [N]", "turn [N m]"]),
        ("phase", "error rate [rad/s, m/s]", ["lift [m, m/s]", "turn [rad, rad/s]"]),
        (
            "spectrum",
            "effort density [N m / √Hz, N / √Hz]",
            ["lift [N / √Hz]", "turn [N m / √Hz]"],
        ),
    ):
        assert (both[name].y, [panel.title for panel in both[name].panels]) == (axis, titles)
    assert both["effort_norm"].y.endswith("over all joints [N m, N]")
    assert "[N m s^0.5, N s^0.5]" in both["effort_norm"].labels[0]
    alone = [RunSeries(run.label, run.joints[:1]) for run in series]
    comparison = Comparison(tuple(run_indices(run) for run in alone))
    figure = next(each for each in figures_of(comparison, alone, 200) if each.name == "efforts")
    assert (figure.y, figure.panels[0].title) == ("effort [N]", "lift")
    page = (result / "report.html").read_text()
    assert NOTE in page
    assert "IVC [N m, N]" in page


# Other commands --------------------------------------------------------------------------------


def test_a_sweep_and_a_study_name_both_units(hpid, experiment, tmp_path):
    options = ("--seeds", "1", "-j", "1", "-o")
    code, _, _ = hpid("sweep", experiment, "--vary", "mu=-0.1", *options, tmp_path / "sweep")
    assert code == DONE
    table = (tmp_path / "sweep" / "table.txt").read_text()
    assert "||u|| [N m s^0.5, N s^0.5]" in table
    assert NOTE in table
    assert json.loads((tmp_path / "sweep" / "sweep.json").read_text())["units"]["ivc"] == "N m, N"
    hpid("study", experiment, *options, tmp_path / "study")
    (table,) = (tmp_path / "study").glob("*.md")
    assert "last \\|e\\| [rad, m]" in table.read_text()
    assert NOTE in table.read_text()
    document = json.loads((tmp_path / "study" / "study.json").read_text())
    assert document["experiments"]["lift"]["slides"] == ["lift"]
    assert document["experiments"]["lift"]["units"]["itae"] == "rad s^2, m s^2"


def test_check_gains_names_the_unit_of_each_inertia(hpid, experiment):
    code, text, told = hpid("check-gains", experiment)
    assert "inertia m [kg m^2; kg: PID lift, hPID lift]" in " ".join(text.split()), (code, told)


def test_identify_has_the_units_of_what_the_recording_knows_to_slide(hpid, tmp_path):
    _, text, _ = hpid("identify", foreign_bag(tmp_path / "bag", ROBOT))
    assert "lift: kg, N s/m and N, where joints that turn have kg m²" in text


def test_margins_and_check_gains_ask_whoever_knows_what_slides(experiment, result):
    for urdf, bag, slides in (
        ("", result / "bags" / "PID", {"lift"}),
        (str(experiment.with_name("lift.urdf")), None, {"lift"}),
        ("", None, set()),
    ):
        assert sliding_joints_from(Namespace(urdf=urdf, bag=bag), None) == slides
    assert sliding_joints_from(Namespace(urdf=""), None) == set()


def test_margins_are_drawn_on_the_inertia_in_its_unit(hpid, experiment, tmp_path):
    code, *told = hpid(
        "margins",
        experiment,
        "--controller",
        "PID",
        "--friction",
        "lift=3",
        "turn=0.1",
        "--plot",
        tmp_path / "loop.svg",
    )
    assert code == DONE, told
    titles = {
        joint: (tmp_path / f"loop-PID-{joint}.svg").read_text() for joint in ("lift", "turn")
    }
    assert "friction 3 N s/m" in titles["lift"]
    assert re.search(r"inertia [0-9.]+ kg,", titles["lift"])
    assert "friction 0.1 N m s/rad" in titles["turn"]
    assert "N s/m" not in titles["turn"]


def test_replay_has_newtons_for_a_joint_that_slides(hpid, result, tmp_path):
    bag = result / "bags" / "PID"
    metadata = yaml.safe_load((bag / "metadata.yaml").read_text())
    held = metadata["rosbag2_bagfile_information"]["custom_data"]["hpid_ros/controllers"]
    other = yaml.safe_load(held)
    for node in other.values():
        if "gains" in node["ros__parameters"]:
            node["ros__parameters"]["gains"]["p"] *= 1.5
    (tmp_path / "other.yaml").write_text(yaml.safe_dump(other))
    _, text, _ = hpid("replay", bag, "--params", tmp_path / "other.yaml")
    lift, turn = text.split("turn:")
    assert re.search(r" N was sent, the law answers \S+ N\b(?! m)", lift)
    assert " N m was sent" not in lift
    assert " N m was sent" in turn


def test_what_stays_is_explained_in_units_of_the_joint():
    loop = LoopSettings("lift", Gains(80.0, 240.0, 8.0), law="pid")
    kept = Upgrade(loop, (0.0, 0.0), (2.5, 2.5), {"law": "2.5 to 2.5 kg m^2"})
    slides = SimpleNamespace(slides=("lift",))
    proposals = Proposals({"lift": kept}, {})
    found = SimpleNamespace(
        recording=SimpleNamespace(loops=[loop]),
        tried=SimpleNamespace(proposals=proposals),
        identification=slides,
        other_goals={},
    )
    _, _, stays, *_ = _changes(found)
    assert stays.rows == [("lift", "2.5 to 2.5 kg")]


def test_an_upgrade_is_explained_in_units_of_the_joint(hpid, experiment, result, tmp_path):
    document = yaml.safe_load(EXPERIMENT)["controllers"]["joints"]
    nodes = {
        f"{joint}_controller": {
            "ros__parameters": {"joint": joint, "law": "pid", "gains": each["gains"]}
        }
        for joint, each in document.items()
    }
    (tmp_path / "pid.yaml").write_text(yaml.safe_dump(nodes))
    upgraded = tmp_path / "up.yaml"
    options = ("--goal", "smooth", "--bag", result / "bags" / "PID", "-o", upgraded)
    inertias = ("--inertia", "lift=2.5", "turn=0.03")
    code, text, _ = hpid("upgrade", tmp_path / "pid.yaml", *options, *inertias)
    assert code == DONE, text
    inertias, lift, turn = re.split(r"/\*\*/\w+_controller:", upgraded.read_text())
    assert "inertia [kg m^2, kg]" in inertias
    assert "the largest velocity in the bag" in lift
    assert not re.search(r"\brad\b|N m\b|kg m", lift)
    assert "upper effort limit [N]" in lift
    assert "upper effort limit [N m]" in turn
    assert "2.5 to 2.5 kg" in text
    assert "0.03 to 0.03 kg m^2" in text
