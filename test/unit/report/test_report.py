import base64
import dataclasses
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from harness.runs import response
from hypothesis import assume, given
from hypothesis import strategies as st

from hpid_bench.report.page import render_report
from hpid_ros.base.text import shown
from hpid_ros.messages.series import JointSeries, Losses, Retune, RunSeries, SeriesError
from hpid_ros.metrics.comparison import Comparison, answer
from hpid_ros.metrics.gain_signals import GainSignals
from hpid_ros.metrics.run_numbers import run_indices
from hpid_ros.metrics.signals import Signal
from hpid_ros.metrics.texts import format_values

VOID = {"meta", "br", "hr", "img", "link", "input"}


class Page(HTMLParser):
    """A page read strictly: every tag is closed in its place."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.text, self.ids, self.attributes = [], [], [], [], []
        self.feed(text)
        self.close()
        assert not self.open, f"left open: {self.open}"

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        self.ids += [value for name, value in attrs if name == "id"]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def report(runs, provenance=None, parameters=None, **options):
    comparison = Comparison(tuple(run_indices(run) for run in runs))
    return render_report(comparison, runs, provenance or {}, parameters or {}, **options)


def data_of(text):
    """Return what the page's script is given."""
    begin = text.index('id="report-data">') + len('id="report-data">')
    return json.loads(text[begin : text.index("</script>", begin)])


def figures_in(text):
    return {figure["name"]: figure for figure in data_of(text)["figures"]}


def floats(packed):
    return np.frombuffer(base64.b64decode(packed), dtype="<f4")


@pytest.fixture(scope="module")
def runs():
    return [
        response("PID", 0.6),
        response("hPID", 1.2, losses={"elbow": Losses(unanswered_states=3)}),
    ]


@pytest.fixture(scope="module")
def text(runs):
    provenance = {"seed": 7, "versions": {"numpy": "2.0.0", "rclpy": None}}
    parameters = {
        run.label: {joint: {"law": "pid", "gains.p": 3.5 + k} for k, joint in enumerate(joints)}
        for run in runs
        for joints in [run.joint_names]
    }
    return report(runs, provenance, parameters)


def test_the_page_is_well_formed_and_needs_nothing_from_outside(text):
    page = Page(text)
    assert len(page.ids) == len(set(page.ids))
    assert text.startswith("<!doctype html>")
    assert not {"link", "img", "iframe", "object"} & set(page.tags)
    sources = [v for _, name, v in page.attributes if name in ("src", "href", "xlink:href")]
    assert all(value.startswith("#") for value in sources)
    assert "@import" not in text
    begin = text.index('id="report-data">')
    others = text[:begin] + text[text.index("</script>", begin) :]  # packed numbers hold anything
    assert not re.search(r"url\(|https?:|//[a-z]|\bfetch\b|XMLHttp|\bimport\b", others)
    assert len(text) < 3_000_000


def test_the_answer_comes_first_and_is_the_comparisons_own(text, runs):
    sentence = answer(Comparison(tuple(run_indices(run) for run in runs)))
    body = text[text.index("<h1>") :]
    assert sentence in body
    assert body.index(sentence) < body.index("<h2>")
    order = ["Figures", "All indices", "Parameters", "Data", "Provenance"]
    headings = re.findall(r"<h2[^>]*>([^<]+)</h2>", body)
    assert [each for each in headings if each in order] == order


def test_the_table_holds_every_number_of_every_run(text, runs):
    for run in runs:
        numbers = run_indices(run)
        totals = [r.totals["ivc"] for r in map(run_indices, runs)]
        joints = [r.joints[j]["ivc"] for r in map(run_indices, runs) for j in numbers.joints]
        for value in format_values([*totals, *joints]):
            assert f">{value}</td>" in text


def test_every_figure_has_a_place_a_caption_and_its_data(text):
    page, figures = Page(text), figures_in(text)
    assert list(figures) == [
        "positions",
        "errors",
        "efforts",
        "effort_norm",
        "error_norm",
        "spectrum",
        "phase",
        "trade_off",
    ]
    assert set(figures) <= set(page.ids)
    for figure in figures.values():
        assert f"<summary>{figure['caption']}</summary>" in text
        assert re.search(r"\[.+\]", figure["caption"]), "no unit"


def test_the_charts_hold_the_recorded_signals(text, runs):
    figures = figures_in(text)
    for name, attribute in (("positions", "position"), ("errors", "error"), ("efforts", "effort")):
        for k, panel in enumerate(figures[name]["panels"]):
            lines = {line["run"]: line for line in panel["lines"]}
            for j, run in enumerate(runs):
                x, y = floats(lines[j]["x"]), floats(lines[j]["y"])
                recorded = getattr(run.joints[k], attribute)
                at = np.interp(x, run.joints[k].time, recorded)
                assert np.allclose(y, at, atol=1e-5)
                assert y.max() == np.float32(recorded.max())
    reference = figures["positions"]["panels"][1]["lines"][0]
    assert reference["run"] == -1
    assert set(floats(reference["y"])) == {2.0}
    trade_off = figures["trade_off"]["panels"][0]["lines"][1]
    assert floats(trade_off["y"])[0] == np.float32(run_indices(runs[1]).totals["itae"])


def test_a_long_run_of_many_joints_stays_a_small_page_and_keeps_its_peaks():
    names = [f"joint{k}" for k in range(8)]
    t = np.arange(20_001) * 1e-3
    stamps = np.round(t * 1e9).astype(np.int64)
    random = np.random.default_rng(0)
    many = []
    for label in ("a", "b", "c", "d"):
        joints = []
        for name in names:
            noise = random.normal(size=t.size)
            noise[12_345] = 50.0
            joints.append(JointSeries(name, stamps, noise, noise * 0.0, stamps, noise))
        many.append(RunSeries(label, tuple(joints)))
    text = report(many)
    assert len(text) < 3_000_000
    figures = figures_in(text)
    for panel in figures["efforts"]["panels"]:
        assert all(floats(line["y"]).max() == 50.0 for line in panel["lines"])


def test_gains_and_retunes_are_drawn_and_listed(runs):
    signal = Signal(runs[0].joints[0].state_stamps_ns, np.ones(301))
    gains = {"hPID": dict.fromkeys(("shoulder", "elbow"), GainSignals(signal, signal))}
    retuned = dataclasses.replace(
        runs[1], retunes=(Retune(3_000_000_000, "/elbow_controller", "mu = -0.2"),)
    )
    text = report([runs[0], retuned], gains=gains)
    figures = figures_in(text)
    assert [line["run"] for line in figures["multiplier"]["panels"][0]["lines"]] == [1]
    assert figures["norm"]["yLog"]
    assert figures["efforts"]["panels"][0]["marks"] == [{"run": 1, "x": 3.0}]
    for cell in ("3.000", "/elbow_controller", "mu = -0.2"):
        assert f">{cell}</td>" in text


def test_colours_come_from_variables_that_both_themes_define(text):
    style = text[: text.index("</style>")]
    light, dark = style.split("@media screen and (prefers-color-scheme: dark)")
    used = set(re.findall(r"var\((--[\w-]+)\)", style)) | set(
        re.findall(r'color\("(--[\w-]+)"\)', text)
    )
    used |= {f"--run-{run['style']}" for run in data_of(text)["runs"]}
    for variable in used:
        assert f"{variable}:" in light
        assert dark.count(f"{variable}:") == 2  # by the system's wish, and by the reader's


def test_wide_things_scroll_in_boxes_of_their_own(text):
    tables = [m.start() for m in re.finditer(r"<table\b", text)]
    for start in tables:
        box = text.rindex("<div", 0, start)
        assert text[box:start].startswith('<div class="scroll" tabindex="0" role="region"')
        assert "</div>" not in text[box:start]


def test_losses_parameters_and_provenance_are_listed(text):
    words = "".join(Page(text).text)
    assert "hPID lost samples in elbow: unanswered states 3, repeated commands 0" in words
    assert "PID: none. Each joint has 301 states and 301 commands." in words
    assert 'class="warning"' not in report([response("PID", 0.6), response("hPID", 1.2)])
    # What joints share is said once.
    assert text.count("The same for all joints:") == text.count("<li>law = pid</li>") == 2
    assert "<td>4.5</td>" in text
    for name, value in (("seed", "7"), ("versions.numpy", "2.0.0"), ("versions.rclpy", "–")):
        assert f'<th scope="row">{name}</th><td>{value}</td>' in text


MARKUP = st.sampled_from(
    [
        "<script>",
        "</script>",
        "</style>",
        "<!--",
        "-->",
        "<b onclick='x'>",
        '" onload="x',
        "]]>",
        "{{ 7 * 7 }}",
        "{% raw %}",
        "&lt;",
        "&#60;",
        "^2",
        "\x1b[2J",
        "\u202e",
        "'",
        "`",
        "\0",
    ]
)
names = st.lists(MARKUP | st.text(max_size=3), min_size=1, max_size=4).map("".join).filter(bool)


def page_of(label, joint, text):
    """Return the page of two runs whose labels, joint and everything else are strangers' texts."""
    runs = [
        response(f"PID{label}", 0.6, (joint, "b"), samples=31),
        response(f"h{label}", 1.2, (joint, "b"), {joint: Losses(1, 1)}, samples=31),
    ]
    retune = Retune(3_000_000_000, text, text)
    runs[1] = dataclasses.replace(runs[1], retunes=(retune,))
    values = {run.label: {joint: {text: text}, "b": {text: 1}} for run in runs}
    return Page(report(runs, {text: {text: text}}, values, warnings=(text,)))


@pytest.fixture(scope="module")
def plain_page():
    return page_of("x", "joint", "text")


@given(label=names, joint=names, text=names)
def test_any_name_is_text_wherever_it_stands(plain_page, label, joint, text):
    assume(joint != "b")
    page = page_of(label, joint, text)
    assert page.tags == plain_page.tags
    attributes = {name for _, name, _ in page.attributes}
    assert attributes <= {name for _, name, _ in plain_page.attributes}
    words = "".join(page.text)
    assert not set("\x1b\u202e\0") & set(words)
    assert all(shown(each) in words for each in (f"PID{label}", joint, text))


def test_warnings_stand_at_the_top_and_are_escaped(runs):
    text = report(runs, warnings=("durations differ: <9 s>",))
    assert '<p class="warning">durations differ: &lt;9 s&gt;</p>' in text
    assert text.index("durations differ") < text.index("<h2>")


def test_numbers_without_recordings_have_a_report_that_says_so(runs):
    comparison = Comparison(tuple(run_indices(run) for run in runs))
    text = render_report(comparison, (), {}, {})
    assert text == render_report(comparison, (), {}, {})
    Page(text)
    assert "saved without their recordings" in text
    assert list(figures_in(text)) == ["trade_off"]
    partly = figures_in(render_report(comparison, runs[1:], {}, {}))
    lines = partly["errors"]["panels"][0]["lines"]
    assert [line["run"] for line in lines] == [1]  # the colour is that of its place in the table
    with pytest.raises(SeriesError, match="hPID, PID, but the comparison's are PID, hPID"):
        render_report(comparison, runs[::-1], {}, {})


def test_a_run_alone_has_a_report_without_ratios():
    text = report([response("PID", 0.6)])
    Page(text)
    assert "nothing to compare" in text
    assert "the variation of the effort (IVC)" not in text  # the sentence of a comparison
    assert re.search(r"variation of the effort \(IVC\) [\d.]+ N m, effort spent", text)
    assert ">ratio<" not in text


def test_without_references_there_are_no_figures_of_errors_and_the_reason_is_said():
    whole = response("PID", 0.6)
    series = tuple(dataclasses.replace(each, reference=()) for each in whole.joints)
    text = report([dataclasses.replace(whole, joints=series)])
    names = list(figures_in(text))
    assert names == ["positions", "efforts", "effort_norm", "spectrum"]
    assert "<p>No ITAE, ||e||: no reference was recorded.</p>" in text
    assert "no time-weighted error (ITAE), as no reference was recorded" in text
    bare = tuple(
        dataclasses.replace(each, command_stamps_ns=(), effort=()) for each in whole.joints
    )
    names = list(figures_in(report([dataclasses.replace(whole, joints=bare)])))
    assert names == ["positions", "errors", "error_norm", "phase"]


def test_runs_that_cannot_be_compared_get_no_verdict():
    short = response("hPID", 1.2)
    names = ("state_stamps_ns", "position", "reference", "command_stamps_ns", "effort")
    half = tuple(
        dataclasses.replace(each, **{name: getattr(each, name)[:150] for name in names})
        for each in short.joints
    )
    text = report([response("PID", 0.6), dataclasses.replace(short, joints=half)])
    assert "not comparable: durations differ: 9 s and 4.47 s." in text
    assert not re.search(r'class="(better|worse)"', text)
