"""Result folders: what the package did not write is never removed, and no result gets lost."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from harness.studies import wait_until

from hpid_bench.cli.commands import DONE
from hpid_bench.cli.main import main
from hpid_bench.experiment.in_process import write_document
from hpid_bench.experiment.result_folder import MARKER, Marker, ResultFolder
from hpid_ros.base.errors import ExperimentError, ResultExistsError
from hpid_ros.base.files import write_file


def files_in(folder):
    """Return every file below a folder with what it holds."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def made(path, text="old", force=False, label="PID", **others):
    """Write a small result."""
    with ResultFolder.create(path, force=force) as folder:
        folder.write("result.json", text)
        for name, content in others.items():
            folder.write(f"{name}.txt", content)
        bag = folder.bag(label)
        bag.mkdir(parents=True)
        (bag / f"{label}.mcap").write_text(text)
        (folder.nodes(label) / "robot.urdf").write_text("<robot/>")
    return folder


def test_a_result_is_replaced_by_what_the_package_wrote_and_nothing_else_is_touched(
    tmp_path, caplog
):
    output = tmp_path / "result"
    made(output, only_old="x")
    foreign = {"note.txt": "mine", "bags/PID/note.txt": "mine", "bags/own/run.mcap": "mine"}
    for name, text in foreign.items():
        write_file(output / name, text)
    folder = made(output, "new", force=True, label="hPID")
    assert folder.path == output
    names = {"result.json", "bags/hPID/hPID.mcap", "nodes/hPID/robot.urdf"}
    assert set(files_in(output)) == {*names, *foreign, MARKER}
    assert (output / "result.json").read_text() == "new"
    assert all((output / name).read_text() == text for name, text in foreign.items())
    assert Marker.read(output) == Marker(names, is_finished=True)
    assert "they were kept" in caplog.text
    assert all(name in caplog.text for name in foreign)
    assert not (output / "nodes" / "PID").exists()


def test_a_result_is_replaced_with_its_paths_whatever_its_folder_is_called(tmp_path):
    output = tmp_path / f"é und {'lang ' * 20}" / "result"
    output.parent.mkdir()
    for text, is_new in (("old", False), ("new", True)):
        with ResultFolder.create(output, force=is_new) as folder:
            folder.write("result.json", text)
            folder.bag("PID").mkdir(parents=True)
            write_file(folder.bag("PID") / "PID.mcap", text)
            folder.write(f"figures/{text}.png", text)
            place = folder.nodes("PID")
            write_document(place / "bridge.yaml", {"robot": f"{place.resolve()}/robot.urdf"})
        if not is_new:
            write_file(output / "figures" / "note.txt", "mine")
    files = files_in(output)
    assert files.pop("figures/note.txt") == b"mine"
    assert {name for name in files if "old" in name} == set()
    assert files["bags/PID/PID.mcap"] == b"new"
    named = yaml.safe_load(files["nodes/PID/bridge.yaml"].decode())["robot"]
    assert named == f"{output.resolve()}/nodes/PID/robot.urdf"


def ended_by(error, output, force):
    """Begin a result that does not come to its end."""

    def run():
        with ResultFolder.create(output, force=force) as folder:
            folder.write("result.json", "half")
            write_file(folder.bag("PID") / "PID.mcap", "half")
            raise error

    with pytest.raises(error):
        run()


@pytest.mark.parametrize("error", [KeyboardInterrupt, ExperimentError])
def test_a_run_that_does_not_end_leaves_the_former_result_as_it_was(tmp_path, caplog, error):
    output = tmp_path / "result"
    made(output)
    before = files_in(output)
    ended_by(error, output, force=True)
    (aside,) = output.glob("unfinished-*")
    assert (aside / "result.json").read_text() == "half"
    assert str(aside) in caplog.text
    assert before.items() <= files_in(output).items()
    made(output, "new", force=True)  # and the next one is not disturbed by it
    assert (aside / "result.json").read_text() == "half"


def test_a_first_run_that_does_not_end_stays_where_it_was_asked_for(tmp_path):
    output = tmp_path / "result"
    ended_by(KeyboardInterrupt, output, force=False)
    assert (output / "bags" / "PID" / "PID.mcap").read_text() == "half"
    assert not Marker.read(output).is_finished
    made(output, "new", force=True)
    assert (output / "bags" / "PID" / "PID.mcap").read_text() == "new"


def test_somebody_elses_file_is_not_written_over(tmp_path):
    output = tmp_path / "result"
    made(output)
    write_file(output / "table.txt", "mine")
    with pytest.raises(ResultExistsError, match=r"table.txt is in the way.*the new result is in"):
        made(output, "new", force=True, table="ours")
    assert (output / "table.txt").read_text() == "mine"
    assert (output / "result.json").read_text() == "old"
    (aside,) = output.glob("unfinished-*")
    assert (aside / "result.json").read_text() == "new"


@pytest.mark.parametrize("place", [".", "..", "/", "input", "input/..", "home"])
def test_the_folders_that_nobody_means_are_refused(tmp_path, monkeypatch, place):
    """Also with a marker in them, which somebody may have put there."""
    folders = {name: tmp_path / name for name in ("input", "home", "work")}
    for folder in folders.values():
        folder.mkdir()
        Marker({"short.yaml"}, is_finished=True).write(folder)
    monkeypatch.setenv("HOME", str(folders["home"]))
    monkeypatch.chdir(folders["work"])
    before = files_in(tmp_path)
    path = Path(place) if place in (".", "..", "/") else tmp_path / place
    with pytest.raises(ResultExistsError, match="a result needs a folder of its own"):
        ResultFolder.create(path, force=True, inputs=[folders["input"] / "short.yaml"])
    assert files_in(tmp_path) == before


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("former", "results of earlier versions have none"),
        ("link", "is a symbolic link"),
        ("file", "is no folder"),
    ],
)
def test_folders_without_a_marker_links_and_files_are_refused(tmp_path, name, words):
    write_file(tmp_path / "former" / "experiment.yaml", "of an earlier version")
    made(tmp_path / "result")
    (tmp_path / "link").symlink_to(tmp_path / "result")
    (tmp_path / "file").write_text("mine")
    before = files_in(tmp_path)
    with pytest.raises(ResultExistsError, match=words):
        ResultFolder.create(tmp_path / name, force=True)
    assert files_in(tmp_path) == before


@pytest.mark.parametrize(
    "change",
    [
        {"files": ["../precious.txt"]},
        {"files": ["/etc/hostname"]},
        {"files": ["a/../../precious.txt"]},
        {"files": [5]},
        {"files": "precious.txt"},
        {"folders": [".."]},
        {"folders": ["."]},
        {"format": 2},
        {"state": None},
    ],
    ids=str,
)
def test_a_marker_that_leads_elsewhere_or_is_not_understood_removes_nothing(tmp_path, change):
    """A result may come from a stranger, and its marker with it."""
    output = tmp_path / "result"
    made(output)
    (tmp_path / "precious.txt").write_text("mine")
    marker = json.loads((output / MARKER).read_text()) | change
    if change == {"state": None}:
        del marker["state"]
    (output / MARKER).write_text(json.dumps(marker))
    before = files_in(tmp_path)
    with pytest.raises(ResultExistsError, match=MARKER):
        ResultFolder.create(output, force=True)
    assert files_in(tmp_path) == before


@pytest.mark.parametrize("is_unfinished", [False, True])
def test_links_are_not_followed_when_a_result_is_removed(tmp_path, is_unfinished):
    output = tmp_path / "result"
    made(output)
    if is_unfinished:
        Marker({"result.json"}, {"bags/PID", "nodes/PID"}).write(output)
    precious = tmp_path / "precious"
    write_file(precious / "PID" / "PID.mcap", "mine")
    (output / "bags").rename(tmp_path / "elsewhere")
    (output / "bags").symlink_to(precious)
    (output / "nodes" / "PID").rename(tmp_path / "nodes")
    (output / "nodes" / "PID").symlink_to(precious / "PID")
    (output / "result.json").unlink()
    (output / "result.json").symlink_to(precious / "PID" / "PID.mcap")
    with ResultFolder.create(output, force=True) as folder:
        folder.write("other.txt", "new")
    assert files_in(precious) == {"PID/PID.mcap": b"mine"}
    assert (output / "bags").is_symlink()
    assert (output / "result.json").is_symlink()
    with pytest.raises(ResultExistsError, match="in the way"):
        made(output, "new", force=True)
    assert files_in(precious) == {"PID/PID.mcap": b"mine"}


def test_an_interrupted_comparison_keeps_the_former_result_and_its_own_readable_bags(
    experiment_file, tmp_path
):
    """By hand it was Ctrl-C; the signal comes while the second run is being recorded."""
    output = tmp_path / "result"
    made(output)
    before = files_in(output)
    long = experiment_file(duration=200.0)
    command = [sys.executable, "-m", "hpid_bench.cli.main", "compare", str(long), "--in-process"]
    run = subprocess.Popen(
        [*command, "-o", str(output), "--force"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        bags = "unfinished-*/bags/*/*.mcap"
        wait_until(lambda: any(file.stat().st_size > 100_000 for file in output.glob(bags)))
        run.terminate()
        _, told = run.communicate(timeout=60)
    finally:
        run.kill()
        run.wait()
    assert run.returncode == 130
    (aside,) = output.glob("unfinished-*")
    assert f"the former result in {output} is as it was; what was run is in {aside}" in told
    assert before.items() <= files_in(output).items()
    (bag,) = (aside / "bags").iterdir()
    assert main(["metrics", str(bag)]) == DONE


def test_a_file_is_replaced_as_a_whole_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "report.html"
    path.write_text("old")
    path.chmod(0o640)
    write_file(path, "new")
    assert (path.read_text(), path.stat().st_mode & 0o777) == ("new", 0o640)

    def fail(self, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(OSError, match="No space"):
        write_file(path, "newer")
    assert files_in(tmp_path) == {"report.html": b"new"}


@pytest.mark.parametrize("link", ["result.json", "bags", "bags/a", "bags/a/a.mcap"])
def test_nothing_is_written_through_a_link_in_a_result(tmp_path, link):
    """A result of a stranger's that lists a link as its own file leads nowhere else."""
    place, elsewhere = tmp_path / "r", tmp_path / "elsewhere"

    def write(folder, text):
        with folder:
            for name in ("result.json", "bags/a/a.mcap"):
                folder.write(name, text)

    write(ResultFolder.create(place), "old")
    (place / link).rename(elsewhere)
    (place / link).symlink_to(elsewhere)
    for opened in (ResultFolder.reopen(place), ResultFolder.create(place, force=True)):
        with pytest.raises(ResultExistsError, match="this package did not write it"):
            write(opened, "new")
        assert (place / link).is_symlink()
        found = files_in(elsewhere).values() if elsewhere.is_dir() else [elsewhere.read_bytes()]
        assert list(found) == [b"old"]
