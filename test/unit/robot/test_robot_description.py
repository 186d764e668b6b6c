import math
from dataclasses import FrozenInstanceError
from pathlib import Path

import pytest

from hpid_bench.cli.main import main
from hpid_ros.base.errors import RobotDescriptionError
from hpid_ros.robot.description import RobotDescription

XML = """<robot name="pair" xmlns:drake="http://drake.mit.edu">
  <link name="base"/><link name="upper"/><link name="lower"/><link name="tip"/>
  <joint name="shoulder" type="revolute">
    <parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
    <limit lower="-1.5" upper="2" effort="7" velocity="3"/>
    <dynamics damping="0.2" friction="0.1"/>
  </joint>
  <joint name="roll" type="continuous">
    <parent link="upper"/><child link="lower"/><limit lower="-1" upper="1" effort="4"/>
  </joint>
  <joint name="mount" type="fixed"><parent link="lower"/><child link="tip"/></joint>
  <transmission name="t">
    <joint name="shoulder"/>
    <actuator name="m">
      <drake:rotor_inertia value="2e-6"/><drake:gear_ratio value="100"/>
    </actuator>
  </transmission>
</robot>"""


def test_every_entry_of_a_joint_is_read():
    shoulder = RobotDescription.load(XML).joints["shoulder"]
    assert (shoulder.type, shoulder.axis) == ("revolute", (0.0, 1.0, 0.0))
    assert (shoulder.parent, shoulder.child) == ("base", "upper")
    assert (shoulder.lower, shoulder.upper) == (-1.5, 2.0)
    assert (shoulder.effort, shoulder.velocity) == (7.0, 3.0)
    assert (shoulder.damping, shoulder.friction) == (0.2, 0.1)
    assert (shoulder.rotor_inertia, shoulder.gear_ratio) == (2e-6, 100.0)
    assert shoulder.reflected_inertia == pytest.approx(0.02)


def test_what_a_urdf_leaves_out_is_unlimited_and_frictionless():
    roll = RobotDescription.load(XML).joints["roll"]
    # A continuous joint turns on whatever its limit element says.
    assert (roll.lower, roll.upper) == (-math.inf, math.inf)
    assert (roll.effort, roll.velocity) == (4.0, math.inf)
    assert (roll.damping, roll.friction, roll.reflected_inertia) == (0.0, 0.0, 0.0)
    assert roll.axis == (1.0, 0.0, 0.0)


def test_only_moving_joints_are_joints_and_all_links_are_links():
    robot = RobotDescription.load(XML)
    assert robot.name == "pair"
    assert list(robot.joints) == ["shoulder", "roll"]
    assert robot.links == ("base", "upper", "lower", "tip")
    assert (robot.root, robot.last_link) == ("base", "tip")
    chosen = robot.select(["roll", "shoulder"])
    assert [joint.name for joint in chosen] == ["roll", "shoulder"]


@pytest.mark.parametrize(
    ("ask", "says"),
    [
        (lambda robot: robot.select(["sholder"]), "did you mean 'shoulder'.*known: roll, sho"),
        (lambda robot: robot.select(["roll", "roll"]), "'roll' is given twice"),
        (lambda robot: robot.link("lowr"), "did you mean 'lower'"),
    ],
)
def test_what_a_robot_lacks_is_answered_with_the_nearest(ask, says):
    with pytest.raises(RobotDescriptionError, match=says):
        ask(RobotDescription.load(XML))


def test_text_and_file_give_the_same_robot(tmp_path: Path):
    path = tmp_path / "pair.urdf"
    path.write_text('<?xml version="1.0" encoding="utf-8"?>\n' + XML, encoding="utf-8")
    from_file, from_text = RobotDescription.load(path), RobotDescription.load("\n " + XML)
    assert from_file.joints == from_text.joints == RobotDescription.load(str(path)).joints
    assert (from_file.folder, from_text.folder) == (tmp_path.resolve(), None)


def test_the_record_cannot_be_changed():
    robot = RobotDescription.load(XML)
    with pytest.raises(FrozenInstanceError):
        robot.name = "other"  # type: ignore[misc]
    with pytest.raises(TypeError):
        robot.joints["roll"] = robot.joints["shoulder"]  # type: ignore[index]


@pytest.mark.parametrize(
    ("broken", "says"),
    [
        ("<robot", "not readable XML"),
        ("<sdf/>", "root is <sdf>"),
        ('<robot name="r"/>', "one root link, not 0: none"),
        ('<robot><link name="a"/><link name="b"/></robot>', "one root link, not 2: a, b"),
        (XML.replace('lower="-1.5"', 'lower="low"'), "lower='low' is not a finite number"),
        (XML.replace('damping="0.2"', 'damping="nan"'), "damping='nan'"),
        (XML.replace('damping="0.2"', 'damping="-0.2"'), "damping='-0.2' must be >= 0"),
        (XML.replace('effort="7"', 'effort="-7"'), "effort='-7' must be >= 0"),
        (XML.replace('xyz="0 1 0"', 'xyz="0 1"'), "axis '0 1' is not a direction"),
        (XML.replace('xyz="0 1 0"', 'xyz="0 0 0"'), "axis '0 0 0' is not a direction"),
        (XML.replace('"revolute"', '"revolut"'), "did you mean 'revolute'"),
        (XML.replace('name="roll"', 'name="shoulder"'), "two joints of the name 'shoulder'"),
        (XML.replace('<child link="upper"/>', ""), "no <child link"),
        (XML.replace('"2e-6"', '"-1"'), "rotor inertia -1.0"),
        (XML.replace(' xmlns:drake="http://drake.mit.edu"', ""), "unbound prefix"),
    ],
)
def test_a_broken_description_is_one_clear_line(broken: str, says: str):
    with pytest.raises(RobotDescriptionError) as caught:
        RobotDescription.load(broken)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_cannot_be_read_is_one_clear_line(tmp_path: Path):
    binary = tmp_path / "robot.urdf"
    binary.write_bytes(b"\xff\xfe\x00\x80")
    for path, says in (
        (tmp_path / "missing.urdf", "does not exist"),
        (tmp_path, "it is a folder, not a file"),
        (binary, "it is not UTF-8 text"),
        (Path("/dev/zero"), "it is a device, not a file"),
    ):
        with pytest.raises(RobotDescriptionError, match=says) as caught:
            RobotDescription.load(path)
        assert "\n" not in str(caught.value)
        assert str(path) in str(caught.value)


def links(names: str) -> str:
    return "".join(f'<link name="{name}"/>' for name in names.split())


def joints(*pairs: tuple[str, str]) -> str:
    return "".join(
        f'<joint name="j{k}" type="continuous"><parent link="{parent}"/><child link="{child}"/>'
        "</joint>"
        for k, (parent, child) in enumerate(pairs, 1)
    )


LAUGHS = "".join(f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">' for k in range(1, 13))
CHAIN = range(900)
NO_TREES = {
    "two in a circle": (
        links("a b c d") + joints(("a", "b"), ("c", "d"), ("d", "c")),
        "links hang in a circle, on no root: c, d",
    ),
    "all in a circle": (
        links("a b") + joints(("a", "b"), ("b", "a")),
        "must have one root link, not 0: none",
    ),
    "a link on itself": (
        links("a b") + joints(("a", "b"), ("b", "b")),
        "link 'b' hangs on two joints, 'j1' and 'j2'",
    ),
    "a link with two parents": (
        links("a b c") + joints(("a", "b"), ("a", "c"), ("b", "c")),
        "link 'c' hangs on two joints, 'j2' and 'j3'",
    ),
    "a link that is not there": (
        links("a b") + joints(("a", "b"), ("b", "x")),
        "joint 'j2', child: unknown link 'x'; known: a, b",
    ),
    "a link twice": (links("a b b") + joints(("a", "b")), "two links of the name 'b'"),
    "links in a row": (
        links(" ".join(f"l{k}" for k in CHAIN))
        + joints(*((f"l{k}", f"l{k + 1}") for k in CHAIN[:-1])),
        "more than 256 links in a row",
    ),
    "many joints": (
        links("r " + " ".join(f"l{k}" for k in range(1001)))
        + joints(*(("r", f"l{k}") for k in range(1001))),
        "more than 1000 moving joints",
    ),
    "many links": (links(" ".join(f"l{k}" for k in range(4001))), "more than 4000 links"),
    "deep elements": (
        links("a") + "<x>" * 200_000 + "</x>" * 200_000,
        "its elements have more than 32 levels",
    ),
    "a macro": (
        '<xacro:macro name="m" xmlns:xacro="http://www.ros.org/wiki/xacro"/>',
        "is xacro and not a URDF yet: expand it first",
    ),
    "an expression": ('<link name="${side}_arm"/>', "is xacro and not a URDF yet"),
}


@pytest.mark.parametrize("what", NO_TREES)
def test_links_that_are_no_tree_are_one_line(tmp_path: Path, capsys, what: str):
    content, says = NO_TREES[what]
    file = tmp_path / "robot.urdf"
    file.write_text(f'<robot name="r">{content}</robot>')
    assert main(["robot", str(file)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"hpid: {file}")
    assert says in line


@pytest.mark.parametrize(
    ("entities", "text"),
    [
        (f'<!ENTITY a0 "ha">{LAUGHS}', "&a12;"),
        (f'<!ENTITY a "{"x" * 100_000}">', "&a;" * 50_000),
        ('<!ENTITY a SYSTEM "file:///etc/passwd">', "&a;"),
    ],
)
def test_entities_are_not_expanded_without_end(entities: str, text: str):
    xml = f'<!DOCTYPE robot [{entities}]><robot name="r"><link name="a"/><x>{text}</x></robot>'
    with pytest.raises(RobotDescriptionError, match="is not readable XML"):
        RobotDescription.load(xml)


def test_a_file_larger_than_any_urdf_is_not_read_to_its_end(tmp_path: Path):
    large = tmp_path / "large.urdf"
    with large.open("wb") as stream:
        stream.truncate(1 << 40)  # that takes no place
    with pytest.raises(RobotDescriptionError, match="has more than 16777216 bytes"):
        RobotDescription.load(large)
