"""A bag that is repaired has its name only when it is whole (ros2/rosbag2#2003, #1619)."""

import errno

import pytest
from harness.bags import small_log, write_bag

from hpid_ros.base.errors import BagError, ResultExistsError
from hpid_ros.messages import writer
from hpid_ros.messages.writer import BagWriter, repair_bag


@pytest.fixture
def bag(tmp_path):
    return write_bag(tmp_path / "bag", small_log())


@pytest.mark.parametrize(
    ("ending", "raised"),
    [
        (KeyboardInterrupt(), KeyboardInterrupt),
        (OSError(errno.ENOSPC, "No space left on device"), BagError),
        (BagError("bag PLACE cannot be written: No space left on device"), BagError),
    ],
)
def test_a_repair_that_is_interrupted_leaves_nothing_that_looks_whole(
    bag, tmp_path, monkeypatch, ending, raised
):
    """While it is under way nothing has the name, so that kill -9 leaves nothing of it either."""
    target, seen = tmp_path / "deep" / "repaired", []

    class Interrupted(BagWriter):
        def write(self, *message):
            super().write(*message)
            self.flush()
            seen.append((target.exists(), self.path.exists()))
            if len(seen) == 3:
                if isinstance(ending, BagError):
                    raise BagError(str(ending).replace("PLACE", str(self.path)))
                raise ending

    monkeypatch.setattr(writer, "BagWriter", Interrupted)
    with pytest.raises(raised) as error:
        repair_bag(bag, target)
    assert seen == [(False, True)] * 3
    assert list(target.parent.iterdir()) == []
    if raised is BagError:
        assert str(target) in str(error.value)
        assert "unfinished" not in str(error.value)


def test_what_took_the_name_meanwhile_stays(bag, tmp_path, monkeypatch):
    target = tmp_path / "repaired"

    class Slow(BagWriter):
        def close(self):
            super().close()
            target.mkdir()
            (target / "precious").touch()

    monkeypatch.setattr(writer, "BagWriter", Slow)
    with pytest.raises(ResultExistsError, match="exists already"):
        repair_bag(bag, target)
    assert [each.name for each in target.iterdir()] == ["precious"]
    assert {each.name for each in tmp_path.iterdir()} == {"bag", "repaired"}
