"""The shapes that are drawn of a URDF, and what stands in for those that cannot be."""

import logging

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hpid_ros.base.errors import RobotDescriptionError
from hpid_ros.base.resources import share_folder
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.kinematics import Kinematics, link_poses
from hpid_ros.robot.shapes import PLAIN, drawn_shapes

ROBOT = RobotDescription.load(share_folder() / "urdf" / "mobile_manipulator.urdf")
COLLISION = '<collision><geometry><sphere radius="0.1"/></geometry></collision>'


def robot(link):
    text = (
        '<robot name="r"><material name="red"><color rgba="1 0 0 1"/></material>'
        f'<link name="a">{link}</link><link name="b"/>'
        '<joint name="j" type="revolute"><parent link="a"/><child link="b"/>'
        '<origin xyz="0 0.3 0.4"/><axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" '
        'velocity="1"/></joint></robot>'
    )
    return RobotDescription.load(text)


def visual(form, more=""):
    return f"<visual>{more}<geometry>{form}</geometry></visual>"


def test_a_shape_has_its_place_its_size_and_its_colour():
    origin = '<origin xyz="1 2 3" rpy="0.1 0.2 0.3"/><material name="red"/>'
    (shape,) = drawn_shapes(robot(visual('<box size="1 2 3"/>', origin)))
    assert (shape.link, shape.form, shape.size) == ("a", "box", (1.0, 2.0, 3.0))
    assert shape.color == (1.0, 0.0, 0.0, 1.0)
    assert shape.position.tolist() == [1.0, 2.0, 3.0]
    # About fixed axes, x first: the matrices multiply the other way round.
    turns = [
        Rotation.from_euler(axis, angle)
        for axis, angle in zip("zyx", (0.3, 0.2, 0.1), strict=True)
    ]
    assert np.allclose(shape.rotation, (turns[0] * turns[1] * turns[2]).as_matrix())


def test_the_robot_of_the_package_is_drawn_whole():
    shapes = drawn_shapes(ROBOT)
    assert len(shapes) == ROBOT.xml.count("<visual>")
    assert all(shape.color != PLAIN for shape in shapes)


@pytest.mark.parametrize("name", ["lost.stl", "there.ply"])
def test_collision_shapes_stand_in_for_meshes_that_cannot_be_read(name, tmp_path, caplog):
    (tmp_path / "there.ply").write_text("ply")
    mesh = visual(f'<mesh filename="{tmp_path / name}"/>')
    with caplog.at_level(logging.WARNING):
        (shape,) = drawn_shapes(robot(mesh + COLLISION))
    assert (shape.form, shape.size) == ("sphere", (0.1,))
    assert name in caplog.text
    assert len(caplog.messages) == 1


def test_a_robot_without_shapes_is_drawn_by_its_bones():
    bone, ball = drawn_shapes(robot(""))
    ends = [bone.position + bone.rotation @ (0, 0, sign * 0.25) for sign in (-1, 1)]
    assert np.allclose(ends, [(0, 0, 0), (0, 0.3, 0.4)])  # from the link's frame to the joint
    assert np.allclose(ball.position, (0, 0.3, 0.4))


def test_a_shape_that_is_no_number_is_one_line():
    with pytest.raises(RobotDescriptionError, match="link 'a' has a shape that cannot be drawn"):
        drawn_shapes(robot(visual('<sphere radius="big"/>')))


def test_every_link_is_where_its_own_kinematics_put_it():
    joints = [name for name in ROBOT.joints if name.startswith("arm")]
    generator = np.random.default_rng(3)
    positions = {name: generator.uniform(-1.0, 1.0, 4) for name in joints}
    poses = link_poses(ROBOT, positions, 4)
    assert set(poses) == set(ROBOT.links)
    chain = Kinematics(ROBOT, "tool0")
    own = chain.poses(np.column_stack([positions[name] for name in chain.joints]))
    assert np.allclose(poses["tool0"].positions, own.positions, atol=1e-12)
    assert np.allclose(poses["tool0"].rotations, own.rotations, atol=1e-12)
    assert np.allclose(poses[ROBOT.root].positions, 0.0)
