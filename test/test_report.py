import itertools
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from hpid_ros.analysis.comparison import Comparison, answer
from hpid_ros.analysis.indices import run_indices
from hpid_ros.analysis.report import render_report
from hpid_ros.analysis.series import JointSeries, Losses, RunSeries, SeriesError
from hpid_ros.analysis.table import format_values

VOID = {"meta", "br", "hr", "img", "link", "input"}
HOSTILE = "<script>alert('x')</script>&\""


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


def response(label, damping, names=("shoulder", "elbow"), losses=None):
    t = np.linspace(0.0, 9.0, 301)
    stamps = np.round(t * 1e9).astype(np.int64)
    joints = []
    for k, name in enumerate(names):
        reference = np.full(t.size, 1.0 + k)
        position = reference * (1.0 - np.exp(-damping * t) * np.cos(3 * t))
        effort = 5 * (reference - position)
        joints.append(JointSeries(name, stamps, position, reference, stamps, effort))
    return RunSeries(label, tuple(joints), losses or {})


def report(runs, provenance=None, parameters=None):
    comparison = Comparison(tuple(run_indices(run) for run in runs))
    return render_report(comparison, runs, provenance or {}, parameters or {})


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


def test_the_page_is_well_formed_and_its_ids_are_unique(text):
    page = Page(text)
    assert len(page.ids) == len(set(page.ids))
    assert text.startswith("<!doctype html>")


def test_every_reference_inside_the_page_has_its_target(text):
    page = Page(text)
    targets = re.findall(r'url\(#([^)]+)\)|href="#([^"]+)"', text)
    assert targets
    assert {a or b for a, b in targets} <= set(page.ids)


def test_the_page_needs_nothing_from_outside(text):
    page = Page(text)
    assert not {"script", "link", "img", "iframe", "object"} & set(page.tags)
    sources = [v for _, name, v in page.attributes if name in ("src", "href", "xlink:href")]
    assert all(value.startswith("#") for value in sources)
    assert "@import" not in text
    assert not re.search(r"url\((?!#)", text)


def test_the_answer_comes_first_and_is_the_comparisons_own(text, runs):
    sentence = answer(Comparison(tuple(run_indices(run) for run in runs)))
    body = text[text.index("<h1>") :]
    assert sentence in body
    assert body.index(sentence) < body.index("<h2>")


def test_headings_descend_by_one_and_name_all_sections(text):
    page = Page(text)
    levels = [int(tag[1]) for tag in page.tags if re.fullmatch(r"h[1-6]", tag)]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(after <= before + 1 for before, after in itertools.pairwise(levels))
    headings = re.findall(r"<h2>(.*?)</h2>", text)
    assert headings == ["Indices", "Figures", "Parameters", "Losses", "Provenance"]


def test_the_table_holds_every_number_of_every_run(text, runs):
    for run in runs:
        numbers = run_indices(run)
        totals = [r.totals.ivc for r in map(run_indices, runs)]
        joints = [r.joints[j].ivc for r in map(run_indices, runs) for j in numbers.joints]
        for value in format_values([*totals, *joints]):
            assert f">{value}</td>" in text


def test_all_figures_are_inline_with_words_for_those_who_cannot_see_them(text):
    page = Page(text)
    assert page.tags.count("svg") == page.tags.count("figure") == 5
    roles = [value for tag, name, value in page.attributes if (tag, name) == ("svg", "role")]
    labels = [v for tag, name, v in page.attributes if (tag, name) == ("svg", "aria-label")]
    assert roles == ["img"] * 5
    assert all("PID and hPID" in label for label in labels)
    assert len(set(labels)) == 5


def test_figures_take_every_colour_from_the_theme(text):
    figures = text[text.index("<svg") : text.rindex("</svg>")]
    assert not re.findall(r"#[0-9a-fA-F]{6}\b", figures)
    used = set(re.findall(r"var\((--[\w-]+)\)", figures))
    style = text[: text.index("</style>")]
    light, dark = style.split("@media (prefers-color-scheme: dark)")
    assert used
    for variable in used:
        assert f"{variable}:" in light
        assert f"{variable}:" in dark


def test_wide_things_scroll_in_boxes_of_their_own(text):
    tables = [m.start() for m in re.finditer(r"<(?:table|svg)\b", text)]
    for start in tables:
        box = text.rindex("<div", 0, start)
        assert text[box:start].startswith('<div class="scroll" tabindex="0" role="region"')
        assert "</div>" not in text[box:start]


def test_losses_are_said_at_the_top_and_listed(text, runs):
    page = Page(text)
    words = "".join(page.text)
    assert "hPID lost samples in elbow: unanswered states 3, repeated commands 0" in words
    assert "PID: none. Each joint has 301 states and 301 commands." in words
    assert 'class="warning"' not in report([response("PID", 0.6), response("hPID", 1.2)])


def test_parameters_that_joints_share_are_said_once_and_others_by_joint(text):
    assert text.count("The same for all joints: law = pid.") == 2
    assert "gains.p" in text
    assert "<td>4.5</td>" in text


def test_provenance_is_flat_and_complete(text):
    for name, value in (("seed", "7"), ("versions.numpy", "2.0.0"), ("versions.rclpy", "–")):
        assert f'<th scope="row">{name}</th><td>{value}</td>' in text


def test_nothing_that_comes_from_outside_becomes_markup():
    runs = [
        response(f"PID{HOSTILE}", 0.6, (HOSTILE, "b")),
        response(f"h{HOSTILE}", 1.2, (HOSTILE, "b"), {HOSTILE: Losses(1, 1)}),
    ]
    settings = {HOSTILE: {HOSTILE: {HOSTILE: HOSTILE}, "b": {HOSTILE: 1}}}
    text = report(runs, {HOSTILE: {HOSTILE: HOSTILE}}, settings)
    page = Page(text)
    assert "script" not in page.tags
    assert "".join(page.text).count(HOSTILE) >= 10


def test_a_report_of_other_runs_than_the_comparisons_is_refused(runs):
    comparison = Comparison(tuple(run_indices(run) for run in runs))
    with pytest.raises(
        SeriesError, match="runs are hPID, PID, but the comparison's are PID, hPID"
    ):
        render_report(comparison, runs[::-1], {}, {})


def test_the_same_run_gives_the_same_page(runs):
    assert report(runs) == report(runs)


def test_a_run_alone_has_a_report_without_ratios():
    text = report([response("PID", 0.6)])
    Page(text)
    assert "nothing to compare" in text
    assert ">ratio<" not in text
