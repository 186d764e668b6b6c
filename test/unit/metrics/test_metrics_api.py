"""The indices of recordings from Python, as the README shows them."""

import json
import re
from dataclasses import replace

import pytest
from harness.bags import small_log, write_bag
from harness.places import ROOT

from hpid_ros.base.errors import HpidError, SettingError
from hpid_ros.messages.selection import BagSelection
from hpid_ros.metrics import Measuring, compare, measure, measure_all, summary
from hpid_ros.metrics.measure import saved_parameters
from hpid_ros.metrics.quantities import ITAE, IVC

README = ROOT / "README.md"


@pytest.fixture
def bags(tmp_path):
    return [
        write_bag(tmp_path / "results/mine/bags" / label, small_log(gain))
        for label, gain in (("PID", 1.0), ("hPID", 2.0))
    ]


def test_the_readme_shows_how(bags, monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    (block,) = (each for each in blocks if "hpid_ros.metrics" in each)
    assert len(block.splitlines()) <= 10
    exec(block, {})
    said = capsys.readouterr().out.splitlines()
    pid, hpid = (measure(bag) for bag in bags)
    assert said[0] == f"{hpid.run.value(ITAE)} {hpid.defects}"
    assert float(said[1]) == hpid.run.value(ITAE) / pid.run.value(ITAE)


def test_what_was_measured_and_what_is_yet_to_be_compare_alike(bags):
    measured = measure_all(bags)
    assert [each.run.label for each in measured] == ["PID", "hPID"]
    assert compare(bags) == compare(measured) == compare([measured[0], bags[1]])
    swapped = compare(bags, baseline="hPID")
    assert swapped.baseline.label == "hPID"
    assert swapped.ratio("PID", IVC) == pytest.approx(1.0 / compare(bags).ratio("hPID", IVC))
    with pytest.raises(SettingError, match="baseline"):
        compare(bags, baseline="pid")


def test_a_number_at_the_end_of_a_folders_name_is_part_of_it(tmp_path):
    """Two unlike bags of one name would be folded as repeats of one run."""
    bags = [write_bag(tmp_path / f"kp_0.{k}", small_log(1.0 + k)) for k in (1, 2)]
    assert [each.run.label for each in measure_all(bags)] == ["kp_0.1", "kp_0.2"]
    file = next(bags[0].glob("*.mcap"))
    assert [each.run.label for each in measure_all([file])] == [file.stem]


def test_recordings_of_unlike_length_are_cut_unless_a_window_was_asked_for(bags, tmp_path):
    longer = write_bag(tmp_path / "longer", small_log(2.0, count=300))
    whole, cut = measure(longer), measure_all([bags[0], longer])[1]
    assert whole.run.cut == ""
    assert cut.run.cut.startswith("cut to ")
    window = Measuring(BagSelection(start=0.0, end=0.02))
    assert all(each.run.cut == "" for each in measure_all([bags[0], longer], window))


def test_recordings_stay_in_memory_only_if_they_are_wanted(bags):
    kept, gone = measure(bags[0]), measure(bags[0], how=Measuring(keeps_series=False))
    assert kept.series is not None
    assert gone.series is None
    assert kept.run == gone.run
    assert summary([kept]).series == (kept.series,)
    assert summary([gone]).series == ()


def test_what_cannot_be_measured_is_refused_in_one_line(bags, tmp_path):
    for path in (tmp_path / "nothing", tmp_path):
        with pytest.raises(HpidError) as refused:
            measure(path)
        assert "\n" not in str(refused.value)
    lost = replace(measure(bags[0]), defects=("half of it is gone",))
    assert "half of it is gone" in summary([lost]).warnings


def test_parameters_of_a_result_that_are_none_are_passed_over(tmp_path):
    document = {"parameters": {"PID": {"a": {"law": "pid"}, "b": None, "c": 1.0}}}
    (tmp_path / "result.json").write_text(json.dumps(document))
    assert saved_parameters(tmp_path / "bags" / "PID") == {"a": {"law": "pid"}}
