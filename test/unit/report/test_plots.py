import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image

from hpid_ros.messages.series import JointSeries, RunSeries, SeriesError
from hpid_ros.metrics.indices import l2_norm
from hpid_ros.metrics.quantities import Signal, envelope, norm_over_joints
from hpid_ros.report.panels import TickLabels, laid_out, legend_outside
from hpid_ros.report.plots import (
    FIGURES,
    effort_norm_figure,
    efforts_figure,
    error_norm_figure,
    errors_figure,
    positions_figure,
    render,
    save_figures,
)
from hpid_ros.report.style import PAPER, RUN_STYLES

pytestmark = pytest.mark.slow

START_NS = 1_700_000_000_000_000_000


def response(label, damping, joints=3, count=901):
    t = np.linspace(0.0, 9.0, count)
    stamps = START_NS + np.round(t * 1e9).astype(np.int64)
    series = []
    for k in range(joints):
        reference = np.full(count, 1.0 + k)
        position = reference * (1.0 - np.exp(-damping * t) * np.cos((3 + k) * t))
        effort = 5.0 * (reference - position)
        series.append(JointSeries(f"joint{k}", stamps, position, reference, stamps, effort))
    return RunSeries(label, tuple(series))


@pytest.fixture
def runs():
    return [response("PID", 0.6), response("hPID", 1.2)]


def panels(figure):
    return [axes for axes in figure.axes if axes.get_visible()]


def lines_of(axes, style):
    return [line for line in axes.lines if line.get_color() == style.color]


# What is drawn ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("draw", "attribute", "label"),
    [
        (positions_figure, "position", "position [rad]"),
        (efforts_figure, "effort", "effort [N m]"),
        (errors_figure, "error", "error [rad]"),
    ],
)
def test_each_joint_has_a_panel_with_the_signal_of_each_run(runs, draw, attribute, label):
    figure = draw(runs)
    assert [axes.get_title(loc="left") for axes in panels(figure)] == list(runs[0].joint_names)
    assert figure.get_supylabel() == label
    assert figure.get_supxlabel() == "time [s]"
    for axes, joint in zip(panels(figure), runs[1].joints, strict=True):
        (line,) = lines_of(axes, RUN_STYLES[1])
        assert np.array_equal(line.get_xdata(), joint.time)
        assert np.array_equal(line.get_ydata(), getattr(joint, attribute))


def test_positions_stand_over_their_reference_and_the_legend_names_all(runs):
    figure = positions_figure(runs)
    assert any(
        np.array_equal(line.get_ydata(), runs[0].joints[0].reference)
        for line in panels(figure)[0].lines
    )
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts == ["PID", "hPID", "reference"]


def test_joints_are_matched_by_name_and_not_by_place(runs):
    turned = RunSeries("hPID", runs[1].joints[::-1])
    for axes, joint in zip(panels(errors_figure([runs[0], turned])), runs[1].joints, strict=True):
        (line,) = lines_of(axes, RUN_STYLES[1])
        assert np.array_equal(line.get_ydata(), joint.error)


@pytest.mark.parametrize(
    ("draw", "attribute", "unit"),
    [(effort_norm_figure, "effort", "N m"), (error_norm_figure, "error", "rad")],
)
def test_norm_figures_show_the_euclidean_norm_over_joints(runs, draw, attribute, unit):
    figure = draw(runs)
    (axes,) = panels(figure)
    (line,) = lines_of(axes, RUN_STYLES[0])
    stacked = np.stack([getattr(joint, attribute) for joint in runs[0].joints])
    assert line.get_ydata() == pytest.approx(np.linalg.norm(stacked, axis=0))
    assert f"[{unit}]" in axes.get_ylabel()
    total = l2_norm(runs[0].joints[0].time, np.linalg.norm(stacked, axis=0))
    assert f"{total:.4g}" in figure.legends[0].get_texts()[0].get_text()


def test_the_calmer_signal_is_drawn_over_the_rougher(runs):
    for order in (runs, runs[::-1]):
        axes = panels(efforts_figure(order))[0]
        heights = {
            run.label: lines_of(axes, style)[0].get_zorder()
            for run, style in zip(order, RUN_STYLES, strict=False)
        }
        assert heights["hPID"] > heights["PID"]


@pytest.mark.parametrize("edge", ["upper", "lower"])
@pytest.mark.parametrize("knows_outside", [True, False], ids=["3.7", "3.6"])
def test_a_legend_covers_no_panel_whatever_matplotlib_knows(edge, knows_outside, monkeypatch):
    legend = Figure.legend

    def legend_of_old(self, **what):
        if what["loc"].startswith("outside"):
            raise ValueError(f"{what['loc']!r} is not a valid value for loc")
        return legend(self, **what)

    if not knows_outside:
        monkeypatch.setattr(Figure, "legend", legend_of_old)
    figure = Figure(figsize=(6.0, 3.0))
    axes = figure.subplots(1, 2)
    handles = [axes[0].plot([0, 1], label=f"run {k}")[0] for k in range(5)]
    legend_outside(figure, handles, edge, columns=2)
    laid_out(figure)
    renderer = FigureCanvasAgg(figure).get_renderer()
    covered = figure.legends[0].get_window_extent(renderer)
    assert not any(covered.overlaps(each.get_tightbbox(renderer)) for each in axes)
    assert figure.bbox.y0 <= covered.y0
    assert covered.y1 <= figure.bbox.y1


def ticks_in_view(axis):
    low, high = sorted(axis.get_view_interval())
    ticks = axis.get_major_ticks()
    return [tick.label1 for tick in ticks if low <= tick.get_loc() <= high]


@pytest.mark.parametrize("joints", [1, 2, 3, 4, 7, 8, 13])
def test_no_labels_overlap_whatever_the_number_of_joints(joints):
    figure = errors_figure([response("PID", 0.6, joints, 91), response("hPID", 1.2, joints, 91)])
    assert len(panels(figure)) == joints
    render(figure, "png")
    texts = [figure._supxlabel, figure._supylabel, *figure.legends]
    for axes in panels(figure):
        ticks = [*ticks_in_view(axes.xaxis), *ticks_in_view(axes.yaxis)]
        texts += [axes._left_title, *(text for text in ticks if text.get_visible())]
    # A text's box is as high as its font: a tenth of it is air.
    boxes = [text.get_window_extent().shrunk(0.9, 0.9) for text in texts]
    assert len(boxes) > 5 * joints
    for k, box in enumerate(boxes):
        assert box.x0 >= 0
        assert box.y0 >= 0
        assert not any(box.overlaps(other) for other in boxes[:k])


def test_the_lowest_panel_of_each_column_carries_the_time():
    figure = errors_figure([response("PID", 0.6, 7, 91)])
    render(figure, "png")
    labelled = [
        axes.get_title(loc="left")
        for axes in panels(figure)
        if any(label.get_visible() for label in ticks_in_view(axes.xaxis))
    ]
    assert labelled == ["joint5", "joint6"]


def test_no_offset_or_power_stands_where_the_joints_name_is():
    stamps = np.array([0, 10**9], dtype=np.int64)
    for low, high in ((1e6, 1e6 + 1e-3), (0.0, 1e-9), (-1e-16, 1e-16), (0.0, 3e9), (0.0, 0.9)):
        series = JointSeries("a", stamps, [low, high], [low, high], stamps, [low, high])
        figure = positions_figure([RunSeries("x", (series,))])
        render(figure, "png")
        (axes,) = panels(figure)
        assert axes.yaxis.get_offset_text().get_text() == ""
        labels = [label.get_text() for label in ticks_in_view(axes.yaxis)]
        assert len(set(labels)) == len(labels) > 1


@pytest.mark.parametrize(
    ("ticks", "labels"),
    [
        ([0.0, 0.25, 0.5], ["0.00", "0.25", "0.50"]),
        ([-20.0, 0.0, 20.0], ["−20", "0", "20"]),
        ([-0.1 - 1e-17, -1e-18, 0.1], ["−0.1", "0.0", "0.1"]),
        ([0.0, 2e-9, 4e-9], ["0", "2e−9", "4e−9"]),
    ],
)
def test_ticks_of_one_axis_have_the_fewest_decimals_that_tell_them_apart(ticks, labels):
    assert TickLabels().format_ticks(ticks) == labels


def test_runs_are_told_apart_by_lightness_and_by_line_too():
    def lightness(color):
        return float(np.dot([0.2126, 0.7152, 0.0722], np.array(to_rgb(color)) ** 2.2))

    first, second = RUN_STYLES[:2]
    assert abs(lightness(first.color) - lightness(second.color)) > 0.1
    assert first.dashes != second.dashes
    for style in RUN_STYLES:
        contrast = (lightness(PAPER) + 0.05) / (lightness(style.color) + 0.05)
        assert contrast >= 3.0, f"{style.color} is too faint on paper"
    for style in RUN_STYLES[1:]:
        assert style.tint != PAPER  # a peak in the gap of a dash is drawn all the same


def test_a_run_without_commands_and_a_run_of_one_state_can_be_drawn():
    silent = JointSeries("a", [0, 10**9], [0.0, 0.0], [1.0, 1.0], [], [])
    single = JointSeries("a", [5], [0.0], [1.0], [5], [2.0])
    for series in (silent, single):
        run = RunSeries("x", (series,))
        for draw in FIGURES.values():
            assert render(draw([run]), "png").startswith(b"\x89PNG")


# Files -----------------------------------------------------------------------------------------


def test_files_are_named_after_figure_and_format_and_open(runs, tmp_path):
    paths = save_figures(runs, tmp_path)
    assert [path.name for path in paths] == [
        f"{name}.{form}" for name in FIGURES for form in ("png", "pdf")
    ]
    assert sorted(tmp_path.iterdir()) == sorted(paths)
    for path in paths:
        if path.suffix == ".png":
            with Image.open(path) as image:
                assert round(image.info["dpi"][0]) == 150
        else:
            assert path.read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize("form", ["png", "pdf", "svg"])
def test_the_same_runs_give_the_same_bytes(runs, form):
    first, second = (render(efforts_figure(runs), form) for _ in range(2))
    assert first == second
    assert b"CreationDate" not in first
    assert b"<dc:date>" not in first
    assert b"matplotlib.org" not in first.partition(b"<svg")[0]


def test_an_unknown_format_is_refused_before_anything_is_written(runs, tmp_path):
    with pytest.raises(SeriesError, match=r"unknown figure format 'jpg'.*pdf, png, svg"):
        save_figures(runs, tmp_path, ("png", "jpg"))
    assert not list(tmp_path.iterdir())


def test_runs_that_do_not_belong_together_are_refused(runs):
    with pytest.raises(SeriesError, match="at least one run"):
        positions_figure([])
    with pytest.raises(SeriesError, match="same joints"):
        positions_figure([runs[0], response("x", 1.0, joints=2)])


def test_drawing_leaves_matplotlib_as_it_was_and_pyplot_alone():
    program = (
        "import sys, matplotlib\n"
        "before = matplotlib.rcParams.copy()\n"
        "from hpid_ros.report.plots import FIGURES, render\n"
        "from hpid_ros.messages.series import JointSeries, RunSeries\n"
        "run = RunSeries('x', (JointSeries('a', [0, 9], [0, 1], [1, 1], [0, 9], [1, 2]),))\n"
        "assert all(render(draw([run]), 'svg') for draw in FIGURES.values())\n"
        "assert matplotlib.rcParams.copy() == before\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )
    path = os.pathsep.join(sys.path)
    subprocess.run(
        [sys.executable, "-c", program], check=True, env={**os.environ, "PYTHONPATH": path}
    )


# Signals ---------------------------------------------------------------------------------------


@given(
    hnp.arrays(np.float64, st.integers(1, 500), elements=st.floats(-1e6, 1e6)),
    st.integers(1, 40),
)
def test_thinning_loses_no_peak_keeps_order_and_invents_nothing(values, buckets):
    signal = Signal(np.arange(values.size, dtype=np.int64) * 7, values)
    thin = envelope(signal, buckets)
    assert thin.values.size <= max(4 * buckets, 1)
    assert np.array_equal(values[thin.stamps_ns // 7], thin.values)
    assert np.all(np.diff(thin.stamps_ns) > 0)
    assert (thin.values.min(), thin.values.max()) == (values.min(), values.max())
    assert (thin.stamps_ns[0], thin.stamps_ns[-1]) == (0, signal.stamps_ns[-1])


def test_a_single_spike_survives_thinning_wherever_it_is():
    stamps = np.arange(9001, dtype=np.int64)
    for spike in range(0, 9001, 97):
        values = np.sin(stamps / 500.0)
        values[spike] = -50.0
        assert envelope(Signal(stamps, values), 50).values.min() == -50.0


def test_a_norm_bridges_lost_samples_and_counts_a_silent_joint_as_zero():
    def signal(stamps, values):
        return Signal(np.array(stamps, dtype=np.int64), np.array(values, dtype=np.float64))

    whole = signal([0, 1, 2, 3], [3.0, 3.0, 3.0, 3.0])
    holed = signal([0, 2], [4.0, 4.0])
    silent = signal([], [])
    stamps_ns, values = norm_over_joints([whole, holed, silent])
    assert stamps_ns.tolist() == [0, 1, 2, 3]
    assert values.tolist() == [5.0, 5.0, 5.0, 3.0]
