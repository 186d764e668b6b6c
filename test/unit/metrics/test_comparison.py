import csv
import dataclasses
import io
import json
import math
import re
import warnings

import pytest
from harness.runs import recording, run
from hypothesis import example, given
from hypothesis import strategies as st
from rich.console import Console

from hpid_bench.report.table import ComparisonTable, table_text
from hpid_ros.messages.quality import DataQuality, RecordingQuality
from hpid_ros.messages.series import SeriesError
from hpid_ros.metrics.alignment import common_cuts, outline_of
from hpid_ros.metrics.comparison import (
    Comparison,
    Verdict,
    answer,
    fold_repeats,
    ratio,
    verdict,
    verdict_lines,
)
from hpid_ros.metrics.quantities import (
    CHATTER,
    EFFORT_L2,
    ERROR_L2,
    IAVC,
    INDICES,
    ITAE,
    IVC,
    L2_NORMS,
    Data,
)
from hpid_ros.metrics.run_numbers import run_indices
from hpid_ros.metrics.saved_results import runs_from_mapping
from hpid_ros.metrics.texts import (
    CSV_COLUMNS,
    cells_of,
    format_ratio,
    format_values,
    headings_of,
    table_csv,
    table_lines,
)

# The paper's Table I and norms.
PAPER_PID = ((982, 114, 2.776), (2390, 142, 4.385), (836, 43, 1.198), (111, 67, 6.589))
PAPER_HPID = ((615, 65, 2.806), (618, 68, 3.704), (853, 50, 0.987), (56, 65, 6.345))


@pytest.fixture
def paper():
    return Comparison(
        (run("PID", PAPER_PID, (423.933, 52.2818)), run("hPID", PAPER_HPID, (329.459, 55.0789)))
    )


@pytest.fixture
def three(paper):
    return Comparison((*paper.runs, run("hPID_canonical", PAPER_HPID)))


# Comparison ------------------------------------------------------------------------------------


def test_ratios_are_over_the_first_run(paper):
    assert paper.ratio("hPID", IVC, "joint2") == 618 / 2390
    assert paper.ratio("hPID", IAVC) == (65 + 68 + 50 + 65) / (114 + 142 + 43 + 67)
    assert paper.ratio("hPID", EFFORT_L2) == 329.459 / 423.933
    assert paper.ratio("PID", ERROR_L2) == 1.0


def test_a_verdict_says_in_how_many_joints_each_number_got_worse(paper):
    """As in the paper's table: a sum hides that joint 3 has more jumps."""
    assert paper.worse_joints("hPID") == {IVC: (1, 4), IAVC: (1, 4), ITAE: (1, 4)}
    assert "IVC 1/4, IAVC 1/4, ITAE 1/4." in list(verdict_lines(paper))[1]
    assert "IVC 1 of 4, IAVC 1 of 4, ITAE 1 of 4." in answer(paper)
    alone = Comparison((run("a", [(1, 1, 1)]), run("b", [(2, 2, 2)])))
    assert len(list(verdict_lines(alone))) == 1


@given(st.floats(0.0, 1e300), st.floats(0.0, 1e300))
def test_a_ratio_is_always_defined_without_a_warning(value, baseline):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        quotient = ratio(value, baseline)
    assert not math.isnan(quotient)
    assert (quotient == 1.0) if value == baseline else True


def test_a_zero_baseline_makes_zero_equal_and_anything_else_infinitely_worse():
    assert ratio(0.0, 0.0) == 1.0
    assert ratio(1e-300, 0.0) == math.inf
    assert verdict(ratio(1.0, 0.0)) is Verdict.WORSE


def test_runs_that_cannot_be_compared_are_refused():
    one = run("PID", PAPER_PID)
    with pytest.raises(SeriesError, match="at least one run"):
        Comparison(())
    with pytest.raises(SeriesError, match="unlike labels"):
        Comparison((one, one))
    with pytest.raises(SeriesError, match="only one of them has elbow, joint4"):
        Comparison((one, run("b", PAPER_HPID, names=["joint1", "joint2", "joint3", "elbow"])))
    with pytest.raises(SeriesError, match="unknown run 'hpid'"):
        Comparison((one,)).ratio("hpid", IVC)


def test_joints_in_another_order_compare_by_name():
    names = ["a", "b", "c", "d"]
    left, right = run("x", PAPER_PID, names=names), run("y", PAPER_PID[::-1], names=names[::-1])
    comparison = Comparison((left, right))
    assert comparison.joint_names == tuple(names)
    assert all(comparison.ratio("y", IVC, name) == 1.0 for name in names)


def test_the_mapping_is_json_even_against_a_zero_baseline():
    comparison = Comparison((run("a", [(0, 1, 0)]), run("b", [(1, 2, 0)])))
    mapping = json.loads(json.dumps(comparison.as_mapping(), allow_nan=False))
    assert mapping["baseline"] == "a"
    assert mapping["ratios"]["b"]["joints"]["joint1"] == {"ivc": None, "iavc": 2.0, "itae": 1.0}
    assert mapping["ratios"]["b"]["error_l2"] == 1.0
    assert "a" not in mapping["ratios"]


def test_the_answer_says_what_got_better_and_what_got_worse():
    comparison = Comparison((run("PID", [(100, 100, 10)]), run("hPID", [(50, 300, 10)], (0.5, 1))))
    found = re.findall(r"(mixed|[A-Z]\w+:|\(.+?\)|by [\d.]+%|to \d times)", answer(comparison))
    assert " ".join(found) == (
        "mixed Better: (IVC) by 50.0% (||u||) by 50.0% Worse: (IAVC) to 3 times "
        "Unchanged: (ITAE) (||e||)"
    )


@pytest.mark.parametrize(
    ("row", "norms", "judgement"),
    [
        ((50, 120, 10), (0.5, 1.127), Verdict.MIXED),
        ((50, 60, 9), (1.0, 1.0004), Verdict.BETTER),
        ((300, 100.01, 10), (1.0, 1.0), Verdict.WORSE),
        ((100, 100, 10), (1.0, 1.0), Verdict.EQUAL),
    ],
)
def test_the_five_numbers_are_judged_together(row, norms, judgement):
    comparison = Comparison((run("PID", [(100, 100, 10)]), run("hPID", [row], norms)))
    assert comparison.judgement("hPID") is judgement


def test_the_answer_handles_many_runs_and_a_zero_baseline(three):
    assert answer(three).count("against PID, over all 4 joints: ") == 2
    zero = Comparison((run("a", [(0, 1, 1)]), run("b", [(1, 1, 1)])))
    assert "Worse: the variation of the effort (IVC) from zero" in answer(zero)


def test_the_answer_of_a_lone_run_are_its_own_figures(three):
    said = answer(Comparison(three.runs[:1]))
    assert "nothing to compare" in said
    for figure in ("(IVC) 4319 N m", "(ITAE) 14.95 rad s^2", "(||u||) 423.9 N m s^0.5"):
        assert figure in said


# What is not there -----------------------------------------------------------------------------


def lacking(label, *lacks, **options):
    """Return two joints' numbers, of which the second lacks something."""
    numbers = recording(label, **options)
    (first, second) = numbers.joints
    if Data.REFERENCE in lacks:
        second = dataclasses.replace(second, reference=())
    if Data.EFFORT in lacks:
        second = dataclasses.replace(second, command_stamps_ns=(), effort=())
    return run_indices(dataclasses.replace(numbers, joints=(first, second)))


def test_what_is_not_there_is_a_dash_with_its_reason_in_every_form():
    comparison = Comparison((lacking("PID", Data.REFERENCE), lacking("hPID", Data.REFERENCE)))
    note = "No ITAE, joint b: no reference was recorded."
    text = table_text(comparison)
    assert note in text
    assert re.search(r"^b .* – +– +–$", text, re.MULTILINE)
    assert re.search(r"total .* 0.0100 0.0100 1.000=$", text, re.MULTILINE)
    assert "PID and hPID: reference: totals without b." in text
    assert "0.0000" not in text
    rows = list(csv.DictReader(io.StringIO(table_csv(comparison))))
    empty = {(row["joint"], row["quantity"]) for row in rows if not row["value"]}
    assert empty == {("b", "itae")}
    assert {r["note"] for r in rows if r["quantity"] == "error_l2"} == {"totals without b"}
    reasons = {row["note"] for row in rows if not row["value"]}
    assert reasons == {"no reference was recorded"}
    plain = table_lines(comparison)
    assert "No ITAE, joint b: no reference was recorded." in plain
    assert re.search(r"^ITAE \[rad s\^2\] +b +– +– +–$", plain, re.MULTILINE)
    saved = json.loads(json.dumps(comparison.as_mapping(), allow_nan=False))
    one = saved["runs"]["hPID"]
    assert one["lacking"] == {"b": {"reference": "no reference was recorded"}}
    assert "itae" not in one["joints"]["b"]
    assert one["totals"]["itae"] == one["joints"]["a"]["itae"]
    assert saved["ratios"]["hPID"]["totals"]["itae"] == 1.0
    assert table_text(Comparison(runs_from_mapping(saved, "x.json"))) == text


def test_what_no_joint_has_no_total_has():
    numbers = recording("PID")
    joints = tuple(dataclasses.replace(each, reference=()) for each in numbers.joints)
    comparison = Comparison((run_indices(dataclasses.replace(numbers, joints=joints)),))
    text = table_text(comparison)
    assert re.search(r"total .* –$", text, re.MULTILINE)
    assert "totals without" not in text
    assert "no time-weighted error (ITAE), as no reference was recorded" in answer(comparison)


def test_totals_over_different_joints_are_neither_compared_nor_folded():
    whole, part = lacking("PID"), lacking("hPID", Data.EFFORT)
    comparison = Comparison((whole, part))
    for quantity in (IVC, IAVC, EFFORT_L2):
        assert not math.isnan(part.value(quantity))
        assert math.isnan(comparison.ratio("hPID", quantity))
        assert (
            comparison.ratio("hPID", quantity, "a") == pytest.approx(1.0) or quantity in L2_NORMS
        )
    assert comparison.ratio("hPID", ITAE) == 1.0
    (folded,) = fold_repeats([whole, dataclasses.replace(part, label="PID")])
    assert math.isnan(folded.value(IVC))
    assert folded.value(ITAE) == whole.value(ITAE)


def test_of_two_runs_only_one_of_which_lacks_something_that_one_is_named():
    comparison = Comparison((lacking("PID"), lacking("hPID", Data.EFFORT)))
    note = "No IVC, IAVC of hPID, joint b: no effort was recorded."
    assert note in table_text(comparison)
    assert "0.0000" not in table_text(comparison)
    assert Verdict.EQUAL not in [comparison.verdicts("hPID")[q] for q in (IVC, IAVC, EFFORT_L2)]
    assert "(hPID: no effort was recorded)" in answer(comparison)


def test_what_was_assumed_is_said_and_does_not_compare_with_what_was_recorded():
    quality = {
        name: DataQuality(reference="hold", effort="measured, of /joint_states")
        for name in ("a", "b")
    }
    assumed = run_indices(recording("a", quality=RecordingQuality(joints=quality)))
    twice = Comparison((assumed, dataclasses.replace(assumed, label="b")))
    for text in (table_text(twice), table_lines(twice), answer(twice)):
        assert "a and b: reference: the first position, held as asked for." in text
        assert "effort: measured, of /joint" in text
    assert "reference: the first position, held" in table_csv(twice)
    assert twice.ratio("b", ITAE) == twice.ratio("b", IVC) == 1.0
    saved = json.loads(json.dumps(twice.as_mapping()))
    assert saved["runs"]["a"]["assumed"]["reference"] == "the first position, held as asked for"
    assert Comparison(runs_from_mapping(saved, "x.json")) == twice
    mixed = Comparison((run_indices(recording("PID")), assumed))
    assert math.isnan(mixed.ratio("a", ITAE))
    assert math.isnan(mixed.ratio("a", IVC))
    assert mixed.judgement("a") is Verdict.UNKNOWN
    assert "effort: PID's is commanded, a's is measured, of /joint_states" in answer(mixed)


@pytest.mark.parametrize(
    ("other", "reason"),
    [
        ({"duration": 17.7}, "durations differ: 2 s and 17.7 s"),
        ({"period": 2e-3}, "state rates differ: 1000 Hz and 500 Hz"),
    ],
)
def test_runs_of_unlike_length_or_rate_get_no_verdict_but_their_numbers(other, reason):
    comparison = Comparison((lacking("PID"), lacking("hPID", **other)))
    assert comparison.judgement("hPID") is Verdict.UNKNOWN
    assert f"hPID against PID, over all 2 joints: not comparable: {reason}." in answer(comparison)
    text = table_text(comparison)
    assert f"hPID against PID: not comparable: {reason}." in text
    assert f"No ratios of hPID to PID: {reason}." in text
    assert not re.search(r"\d[▼▲=]", text)
    assert not re.search(r"\d[▼▲=]", table_lines(comparison))
    mapping = comparison.as_mapping()
    assert mapping["not_compared"] == {"hPID": {reason: "all"}}
    assert mapping["ratios"]["hPID"]["totals"] == {}
    for row in csv.DictReader(io.StringIO(table_csv(comparison))):
        assert row["value"]
        assert not row["ratio"]
        assert row["note"] == ("" if row["run"] == "PID" else f"not compared: {reason}")


def test_an_unlike_cutoff_spoils_the_chatter_alone_and_a_few_lost_states_nothing():
    comparison = Comparison((lacking("PID"), run_indices(recording("hPID"), 50.0)))
    assert math.isnan(comparison.ratio("hPID", CHATTER))
    assert comparison.ratio("hPID", IVC) == 1.0
    assert comparison.judgement("hPID") is Verdict.EQUAL
    fewer = Comparison((lacking("PID"), lacking("hPID", period=1.02e-3)))
    assert fewer.judgement("hPID") is not Verdict.UNKNOWN


def test_recordings_are_cut_to_the_time_that_all_have_from_where_their_references_begin():
    def starts(duration, begin):
        quality = RecordingQuality(joints={"a": DataQuality(reference_from=begin)})
        return outline_of(recording("run", duration=duration, quality=quality))

    long, short = starts(17.7, 2.0), starts(4.5, 0.5)
    (first, second) = common_cuts([long, short])
    assert first[:2] == pytest.approx((2.0, 6.0))
    assert second[:2] == pytest.approx((0.5, 4.5))
    assert first.text == "cut to 4 s of 17.7 s, from 2 s on, where its reference begins"
    assert common_cuts([long, starts(17.7, 2.0)]) == ()
    assert len(common_cuts([long, starts(17.7, 5.0)])) == 2
    without = common_cuts([long, starts(4.0, None)])
    assert [cut.start for cut in without] == [0.0, 0.0]
    assert without[0].text.endswith("from 0 s on, where its states do")
    assert without[1].text == ""
    assert common_cuts([long, starts(4.0, 3.99)]) == ()  # nothing to speak of in common
    assert common_cuts([long]) == ()


# The table -------------------------------------------------------------------------------------


def test_the_table_of_two_runs_fits_eighty_columns_side_by_side(paper):
    lines = table_text(paper, 80).splitlines()
    assert max(map(len, lines)) <= 80
    assert all(f"{quantity.symbol} [{quantity.unit}]" in lines[0] for quantity in INDICES)
    row = next(line for line in lines if line.startswith("joint2"))
    assert re.split(r"\s+", row)[:4] == ["joint2", "2390.0", "618.0", "0.259▼"]
    assert re.split(r"\s+", row)[4:] == ["142.00", "68.00", "0.479▼", "4.385", "3.704", "0.845▼"]
    assert next(line for line in lines if line.startswith("total")).split()[3] == "0.496▼"


def test_better_and_worse_read_without_colour_and_without_unicode(paper):
    assert "0.259▼" in table_text(paper)
    assert "1.054▲" in table_text(paper)  # the error norm
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    console = Console(file=stream, width=80, color_system=None)
    console.print(ComparisonTable(paper))
    stream.flush()
    text = stream.buffer.getvalue().decode("ascii")
    assert "0.259v" in text
    assert "1.054^" in text


@given(st.lists(st.floats(0.0, 1e12), min_size=1, max_size=8))
@example([10000.0, 0.5])  # half of the last decimal is rounded to an even number
def test_formatted_values_line_up_and_never_hide_a_number(values):
    texts = format_values(values)
    plain = {len(text.partition(".")[2]) for text in texts if "e" not in text}
    assert len(plain) <= 1
    for value, text in zip(values, texts, strict=True):
        assert (float(text) == 0.0) == (value == 0.0)
        assert float(text) == pytest.approx(
            value, rel=0.051, abs=0.51 * 10.0 ** -max(plain or {0})
        )


@pytest.mark.parametrize(
    ("value", "text"), [(0.25901, "0.259"), (12.345, "12.35"), (math.inf, "inf"), (1e6, "1.0e6")]
)
def test_formatted_ratios(value, text):
    assert format_ratio(value) == text


# Files -----------------------------------------------------------------------------------------


def test_the_csv_returns_every_number_to_the_bit(three):
    rows = list(csv.DictReader(io.StringIO(table_csv(three))))
    assert tuple(rows[0]) == CSV_COLUMNS
    assert len(rows) == 3 * (4 * 3 + 3 + 2)
    quantities = {quantity.key: quantity for quantity in (*INDICES, *L2_NORMS)}
    for row in rows:
        quantity, joint = quantities[row["quantity"]], row["joint"] or None
        assert float(row["value"]) == three.run(row["run"]).value(quantity, joint)
        assert row["unit"] == quantity.unit
        if row["run"] == "PID":
            assert row["ratio"] == ""
        else:
            assert float(row["ratio"]) == three.ratio(row["run"], quantity, joint)


def test_plain_columns_hold_every_number_with_its_mark(three):
    """What bag_metrics prints: one line for each index and joint, columns under each other."""
    table, notes = table_lines(three).split("\n\n")
    head, *rows = table.splitlines()
    assert head.split() == ["index", "joint", *headings_of(three)]
    lines_of = len(three.joint_names) + 1
    assert len(rows) == lines_of * len(three.indices) + len(three.norms)
    ends = [match.end() for match in re.finditer(r"\S+", head)][2:]
    for line in rows:
        assert {match.end() for match in re.finditer(r"\S+", line)} >= set(ends), line
    for quantity in three.indices:
        cells = cells_of(three, quantity, (*three.joint_names, None))
        for joint, row in zip((*three.joint_names, "total"), cells, strict=True):
            (line,) = (
                each
                for each in rows
                if each.startswith(quantity.symbol + " ") and f" {joint} " in each
            )
            assert line.split()[-len(row) :] == [f"{each.text}{each.mark}" for each in row]
    verdicts = list(verdict_lines(three))
    assert notes.splitlines()[-len(verdicts) :] == verdicts


def test_a_single_run_has_a_table_in_every_form(paper):
    alone = Comparison(paper.runs[:1])
    assert "ratio" not in table_text(alone)
    assert len(table_csv(alone).splitlines()) == 1 + 4 * 3 + 3 + 2
    assert "ratio" not in table_lines(alone)
    assert alone.ratio("PID", ITAE) == 1.0
