"""Meshes with which PyBullet crashes are one line, and the others are read."""

import pytest

from hpid_ros.base.errors import RobotDescriptionError

bullet = pytest.importorskip("hpid_ros.simulation.bullet")

CORNERS = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
GOOD = f"{CORNERS}f 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"
BAD = {"no corners": "f 1 2 3\n", "far away": "v 0 0 0\nf 999999999 1 1\n"}


def robot(*meshes, kind="collision"):
    links = "".join(
        f'<link name="l{number}"><{kind}><geometry><mesh filename="{mesh}"/></geometry></{kind}>'
        "</link>"
        for number, mesh in enumerate(meshes)
    )
    return f'<robot name="r">{links}</robot>'


@pytest.fixture
def mesh(tmp_path):
    def write(text, name="mesh.obj"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


@pytest.mark.parametrize("kind", ["collision", "visual"])
@pytest.mark.parametrize("text", BAD.values(), ids=BAD)
def test_a_mesh_that_crashes_its_reader_is_one_line_that_names_it(mesh, text, kind):
    files = [mesh(GOOD, "good.obj"), mesh(text, "bad.obj"), mesh(GOOD, "other.obj")]
    with pytest.raises(RobotDescriptionError) as refusal:
        bullet.require_readable_meshes(robot(*files, kind=kind))
    assert str(refusal.value) == f"PyBullet cannot read the mesh {files[1]}: it crashes (SIGSEGV)"


def test_a_mesh_is_tried_once_until_its_file_changes(mesh, monkeypatch):
    file = mesh(GOOD)
    bullet.require_readable_meshes(robot(file, file))
    with monkeypatch.context() as without:
        without.setattr(bullet, "_tried", lambda files: pytest.fail("tried again"))
        bullet.require_readable_meshes(robot(file))
    mesh(BAD["no corners"])
    with pytest.raises(RobotDescriptionError, match="it crashes"):
        bullet.require_readable_meshes(robot(file))


def test_what_takes_too_long_and_what_is_refused_in_words_is_told_apart(mesh, monkeypatch):
    bullet.require_readable_meshes(robot(mesh("nonsense", "mesh.stl")))
    monkeypatch.setattr(bullet, "_TRIED_WITHIN", 0.01)
    with pytest.raises(RobotDescriptionError, match=r"it has not been read within 0.01 s") as hung:
        bullet.require_readable_meshes(robot(mesh("o a\n" * 3 + GOOD, "slow.obj")))
    assert "\n" not in str(hung.value)
