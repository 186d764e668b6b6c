"""What people reported of the texts of URDFs: encodings, byte order marks, ends of lines."""

import pytest

from hpid_ros.robot.description import RobotDescription, robot_source

BODY = """<!-- made by xacro; {umlaut} --><robot name="a" xmlns:xacro="http://www.ros.org/wiki/xacro">
<link name="base"/><link name="arm"/><joint name="elbow" type="revolute">
<parent link="base"/><child link="arm"/>
<limit lower="-1" upper="1" effort="5" velocity="2"/></joint></robot>"""
DECLARED = "<?xml version='1.0' encoding='{}'?>\n"


@pytest.mark.parametrize("head", ["", DECLARED.format("utf-8"), DECLARED.format("UTF-8")])
@pytest.mark.parametrize("before", ["", "\ufeff", " \r\n", "\ufeff\n"])
@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
def test_a_urdf_is_the_same_as_a_text_and_as_a_file_whatever_is_before_it(
    tmp_path, head, before, line_end
):
    """What an editor put before it, and the encoding that it declares, which a text has not."""
    text = before + (head + BODY.format(umlaut="Füße")).replace("\n", line_end)
    assert robot_source(text) is text
    (tmp_path / "arm.urdf").write_text(text, encoding="utf-8", newline="")
    for source in (text, tmp_path / "arm.urdf"):
        robot = RobotDescription.load(source)
        assert list(robot.joints) == ["elbow"]
        assert robot.joints["elbow"].effort == 5.0
