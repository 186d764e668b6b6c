"""What is too large for memory waits in a file, and gives the same numbers to the last bit."""

import errno
import tempfile
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from harness.bags import S, ramp, small_log, state, trajectory, write_bag

from hpid_bench.cli.main import main
from hpid_ros.base.errors import BagError
from hpid_ros.messages import spill
from hpid_ros.messages.run import read_run
from hpid_ros.messages.series import KeptJoints
from hpid_ros.metrics import run_indices

ARRAYS = ("state_stamps_ns", "position", "reference", "command_stamps_ns", "effort", "known")


@pytest.fixture
def bag(tmp_path):
    return write_bag(tmp_path / "bag", small_log(count=3000))


@pytest.fixture
def kept(bag, monkeypatch):
    """Return a run none of whose arrays has room in memory."""
    monkeypatch.setattr(spill, "BYTES_IN_MEMORY", 0)
    run = read_run(bag, "run", joints=["a", "b"])
    assert isinstance(run.joints, KeptJoints)
    return run


def assert_equal(one, other):
    assert (one.joint, one.is_slide) == (other.joint, other.is_slide)
    for name in ARRAYS:
        first, second = getattr(one, name), getattr(other, name)
        assert (first is None) == (second is None)
        assert first is None or first.tobytes() == second.tobytes()
        assert second is None or not second.flags.writeable


def test_a_run_is_the_same_wherever_its_arrays_are(bag, kept, monkeypatch):
    monkeypatch.undo()
    run = read_run(bag, "run", joints=["a", "b"])
    assert isinstance(run.joints, tuple)
    for one, other in zip(run.joints, kept.joints, strict=True):
        assert_equal(one, other)
    for name in ("joint_names", "slides", "start_ns", "duration", "losses", "outlines"):
        assert getattr(run, name) == getattr(kept, name)
    assert run_indices(run) == run_indices(kept)


def test_joints_are_picked_and_marked_as_in_memory(kept):
    assert_equal(kept.joints[-1], [*kept.joints][-1])
    (last,) = kept.joints[-1:]
    assert_equal(last, kept.joints[len(kept.joints) - 1])
    with pytest.raises(IndexError):
        kept.joints[len(kept.joints)]
    slides = kept.with_slides({"b"})
    assert (slides.slides, kept.slides) == (frozenset("b"), frozenset())
    assert [each.joint for each in slides.joints if each.is_slide] == ["b"]
    narrowed = slides.narrowed({"b"})
    assert (narrowed.joint_names, narrowed.slides) == (("b",), frozenset("b"))
    assert_equal(narrowed.joints[0], replace(kept.joints[1], is_slide=True))


def test_stamps_that_joints_share_are_in_memory_once(kept):
    stamps = [id(each.state_stamps_ns) for each in kept.joints]
    assert len({*stamps}) == 1


@pytest.mark.parametrize(
    "options", [[], ["--start", "0.1", "--end", "2"], ["--reference", "hold"]]
)
def test_metrics_and_report_are_the_same(bag, tmp_path, capsys, monkeypatch, options):
    def numbers(name):
        report = tmp_path / f"{name}.html"
        assert (
            main(["metrics", str(bag), "--format", "json", "--report", str(report), *options]) == 0
        )
        return capsys.readouterr().out, report.read_text().replace(f"{name}.html", "")

    whole = numbers("whole")
    monkeypatch.setattr(spill, "BYTES_IN_MEMORY", 0)
    assert numbers("kept") == whole


def test_joints_with_stamps_of_their_own_come_back_with_these(tmp_path, monkeypatch):
    log = [trajectory(1, ramp("a", t0=0.0, t1=1.0))]
    for k in range(50):
        log += [state(k * S // 100 + 2, a=0.1 * k), state(k * S // 100 + 9, b=0.1 * k)]
    bag = write_bag(tmp_path / "bag", log)
    run = read_run(bag, "run", joints=["a", "b"])
    monkeypatch.setattr(spill, "BYTES_IN_MEMORY", 0)
    for one, other in zip(run.joints, read_run(bag, "run", joints=["a", "b"]).joints, strict=True):
        assert_equal(one, other)


def test_a_full_disk_is_one_line(bag, monkeypatch):
    class Full:
        def write(self, raw):
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(spill, "BYTES_IN_MEMORY", 0)
    monkeypatch.setattr(tempfile, "TemporaryFile", lambda **_: Full())
    with pytest.raises(BagError, match=r"needs room in .* \(TMPDIR\): No space left on device"):
        read_run(bag, "run", joints=["a", "b"])


def test_what_has_room_stays_in_memory_and_what_has_not_comes_back(monkeypatch):
    monkeypatch.setattr(spill, "BYTES_IN_MEMORY", 100)
    spilled = spill.Spill()
    arrays = [np.arange(10.0), np.arange(20.0).reshape(4, 5), np.array([True, False]), np.empty(0)]
    kept = [spilled.keep(each) for each in arrays]
    assert [isinstance(each, spill.Stored) for each in kept] == [False, True, True, False]
    for one, other in zip(arrays, map(spilled.array, kept), strict=True):
        assert np.array_equal(one, other)
        assert one.dtype == other.dtype
    row = np.empty(5)
    copy = partial(spilled.copy_row, kept[1])
    copy(2, row)
    assert row.tolist() == [10.0, 11.0, 12.0, 13.0, 14.0]
