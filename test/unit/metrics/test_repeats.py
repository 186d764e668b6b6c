"""Repeats, units, saved numbers, and what keeps runs from being compared."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from harness.runs import recording
from hypothesis import given
from hypothesis import strategies as st

from hpid_bench.report.table import table_text
from hpid_ros.messages.series import JointSeries, RunSeries, SeriesError
from hpid_ros.metrics.comparison import (
    Comparison,
    fold_repeats,
    median_and_quartiles,
    mismatches,
)
from hpid_ros.metrics.quantities import (
    ENERGY,
    ERROR_L2,
    ISE,
    ITAE,
    IVC,
    OVERSHOOT,
    QUANTITIES,
    RISE_TIME,
    RMSE,
)
from hpid_ros.metrics.results import with_angles_in
from hpid_ros.metrics.run_numbers import run_indices
from hpid_ros.metrics.saved_results import runs_from_mapping
from hpid_ros.metrics.texts import table_csv, table_lines


def numbers(*arguments, **options):
    return run_indices(recording(*arguments, **options))


# Repeats ---------------------------------------------------------------------------------------


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=30))
def test_medians_and_quartiles_are_numpys(values):
    median, quartiles = median_and_quartiles(values)
    expected = np.quantile(values, [0.25, 0.5, 0.75])
    assert (quartiles[0], median, quartiles[1]) == pytest.approx(tuple(expected), abs=1e-6)


def test_a_run_that_never_settles_is_the_largest_of_its_repeats():
    assert median_and_quartiles([1.0, math.inf, 2.0]) == (2.0, (1.5, math.inf))


def test_runs_of_one_label_become_their_median_whatever_their_order():
    scales = (1.0, 3.0, 2.0)
    runs = [numbers("PID", scale) for scale in scales]
    (folded,) = fold_repeats(runs)
    for quantity in QUANTITIES.values():
        for joint in ("a", "b", None):
            values = [run.value(quantity, joint) for run in runs]
            if not any(map(math.isnan, values)):
                assert folded.value(quantity, joint) == sorted(values)[1]
    assert folded.spread.repeats == 3
    low, high = folded.spread.quartiles[None]["ivc"]
    assert low < folded.value(IVC) < high
    assert dict(fold_repeats(runs[::-1])[0].joints) == dict(folded.joints)


def test_labels_stay_in_order_and_single_runs_as_they_are():
    runs = [numbers("PID"), numbers("hPID"), numbers("PID", 2.0)]
    folded = fold_repeats(runs)
    assert [run.label for run in folded] == ["PID", "hPID"]
    assert folded[1] is runs[1]


def test_repeats_that_do_not_belong_together_are_refused():
    with pytest.raises(SeriesError, match="repeats of 'PID' do not have the same joints: a, b"):
        fold_repeats([numbers("PID"), numbers("PID", names=("a", "c"))])
    (median,) = fold_repeats([numbers("PID"), numbers("PID", 2.0)])
    with pytest.raises(SeriesError, match="medians already"):
        fold_repeats([median, numbers("PID")])


def test_tables_and_files_show_the_number_of_repeats_and_the_quartiles():
    folded = fold_repeats([numbers("PID", s) for s in (1.0, 2.0, 3.0)] + [numbers("hPID")])
    comparison = Comparison(folded)
    text = table_text(comparison, 160)
    assert "PID (3)" in text
    assert "quartiles" in text
    rows = [line.split(",") for line in table_csv(comparison).splitlines()]
    low, high = folded[0].spread.quartiles[None]["ivc"]
    assert rows[0][-5:-1] == ["repeats", "first_quartile", "third_quartile", "note"]
    assert ["3", repr(low), repr(high), ""] in [row[-5:-1] for row in rows]
    assert all(row[-5:-1] == ["", "", "", ""] for row in rows if row[0] == "hPID")
    assert "PID (3)" in table_lines(comparison)


# Units -----------------------------------------------------------------------------------------


def test_degrees_multiply_once_for_each_rad_in_the_unit_and_leave_the_rest():
    run = numbers()
    turned = with_angles_in(run, "deg")
    degree = 180.0 / math.pi
    for quantity, factor in ((ITAE, degree), (RMSE, degree), (ISE, degree**2), (ERROR_L2, degree)):
        for joint in ("a", None):
            ratio = turned.value(quantity, joint) / run.value(quantity, joint)
            assert ratio == pytest.approx(factor, rel=1e-14)
    for quantity in (IVC, RISE_TIME, OVERSHOOT, ENERGY):
        assert turned.value(quantity) == run.value(quantity)
    assert (ISE.unit_in("deg"), IVC.unit_in("deg")) == ("deg^2 s", "N m")
    back = with_angles_in(turned, "rad")
    assert back.value(ISE) == pytest.approx(run.value(ISE), rel=1e-14)


def test_units_are_printed_and_ratios_do_not_depend_on_them():
    runs = [numbers("PID"), numbers("hPID", 2.0)]
    comparison = Comparison(tuple(with_angles_in(run, "deg") for run in runs))
    assert comparison.ratio("hPID", ITAE) == pytest.approx(Comparison(runs).ratio("hPID", ITAE))
    for text in (table_text(comparison), table_lines(comparison), table_csv(comparison)):
        assert "deg s^2" in text
        assert "rad" not in text
    with pytest.raises(SeriesError, match="differ in the unit of angles: deg and rad"):
        Comparison((comparison.runs[0], runs[1]))
    with pytest.raises(SeriesError, match="unknown unit of angles 'grad'"):
        with_angles_in(runs[0], "grad")


# Saved -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("unit", ["rad", "deg"])
def test_saved_numbers_come_back_to_the_bit(unit):
    runs = [numbers("PID", 1.0), numbers("hPID", 2.0), numbers("hPID", 3.0)]
    comparison = Comparison(fold_repeats([with_angles_in(run, unit) for run in runs]))
    text = json.dumps(comparison.as_mapping(), allow_nan=False)
    assert Comparison(runs_from_mapping(json.loads(text), "x.json")) == comparison
    wrapped = {"experiment": "e", "indices": json.loads(text)}
    assert runs_from_mapping(wrapped, "result.json") == comparison.runs


def test_an_infinite_number_survives_saving():
    t = np.arange(2001) * 1e-3
    stamps = np.round(t * 1e9).astype(np.int64)
    stuck = JointSeries("a", stamps, 0.5 * (t > 0.1), np.ones(t.size), stamps, t)
    comparison = Comparison((run_indices(RunSeries("x", (stuck,))),))
    saved = json.loads(json.dumps(comparison.as_mapping(), allow_nan=False))
    assert saved["runs"]["x"]["joints"]["a"]["settling_time"] is None
    assert runs_from_mapping(saved, "x.json") == comparison.runs


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: [], "holds no saved indices"),
        (lambda d: {"runs": {}}, "holds no saved indices"),
        (lambda d: d["runs"]["x"].pop("units") and d, "is damaged: no entry 'units'"),
        (lambda d: d["runs"]["x"]["joints"]["a"].update(ivc="high") or d, "'high' is no number"),
        (lambda d: d["runs"]["x"]["joints"]["a"].update(ivc=10**400) or d, "is damaged"),
        (lambda d: d["runs"]["x"]["units"].update(itae="grad s^2") or d, "must be in rad s"),
        (lambda d: d["runs"]["x"]["units"].update(ivc="N") or d, "ivc is in N, but must be in N"),
        (lambda d: d["runs"]["x"].update(joints={}) or d, "has no joint"),
    ],
)
def test_a_file_that_holds_no_numbers_is_one_line(change, words):
    document = Comparison((numbers("x"),)).as_mapping()
    document = change(json.loads(json.dumps(document)))
    with pytest.raises(SeriesError, match=words) as raised:
        runs_from_mapping(document, "some.json")
    assert "some.json" in str(raised.value)
    assert "\n" not in str(raised.value)


# Conditions ------------------------------------------------------------------------------------


def test_runs_under_the_same_conditions_are_compared_in_silence():
    assert mismatches([numbers("PID"), numbers("hPID", 2.0)]) == []


@pytest.mark.parametrize(
    ("other", "words"),
    [
        (numbers("hPID", duration=3.0), "durations differ: 2 s and 3 s"),
        (numbers("hPID", shift=0.3), "references differ: b"),
        (numbers("hPID", period=2e-3), "state rates differ: 1000 Hz and 500 Hz"),
        (run_indices(recording("hPID"), 50.0), "chatter cut-offs differ: 20 Hz and 50 Hz"),
        (with_angles_in(numbers("hPID"), "deg"), "units differ: rad and deg"),
    ],
)
def test_what_differs_is_named_with_both_runs(other, words):
    assert mismatches([numbers("PID"), other]) == [f"runs 'PID' and 'hPID': {words}"]


def test_efforts_of_another_time_or_rate_spoil_the_efforts_alone_also_saved():
    def with_efforts(label, kept):
        run = recording(label)
        joints = (
            replace(each, command_stamps_ns=each.command_stamps_ns[kept], effort=each.effort[kept])
            for each in run.joints
        )
        return run_indices(replace(run, joints=tuple(joints)))

    whole = numbers("PID")
    assert mismatches([whole, with_efforts("hPID", slice(2, None))]) == []
    for kept, what in ((slice(500, None), "times"), (slice(None, None, 2), "rates")):
        found = with_efforts("hPID", kept)
        saved = runs_from_mapping(Comparison((found,)).as_mapping(), "x.json")
        for other in (found, *saved):
            line = f"runs 'PID' and 'hPID': {what} of the efforts differ: a, b"
            assert mismatches([whole, other]) == [line]
            comparison = Comparison((whole, other))
            assert math.isnan(comparison.ratio("hPID", IVC))
            assert comparison.ratio("hPID", ITAE) == 1.0
    assert "efforts" not in whole.as_mapping()["conditions"]


def test_repeats_and_runs_of_unknown_conditions_are_named():
    (line,) = mismatches([numbers("PID"), numbers("PID", shift=0.3)])
    assert line == "repeats of 'PID': references differ: b"
    bare = Comparison((numbers("hPID"),)).as_mapping()
    del bare["runs"]["hPID"]["conditions"]
    (line,) = mismatches([numbers("PID"), *runs_from_mapping(bare, "x")])
    assert "conditions of 'hPID' were not saved" in line
