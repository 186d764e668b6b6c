"""The figures: what is in them, how matplotlib draws them, and their files."""

import dataclasses
import math
import os
import re
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

from hpid_bench.report.figures import BACKGROUND, RUN_STYLES, figures_of, phase_curve
from hpid_bench.report.plots import (
    TickLabels,
    drawing_bytes,
    drawn,
    figure_style,
    laid_out,
    legend_outside,
    log_ticks,
)
from hpid_ros.control import Gains, LoopSettings
from hpid_ros.control.assembly import make_law, make_norm, make_velocity_source
from hpid_ros.control.settings import NormSettings, VelocitySettings
from hpid_ros.messages.series import JointSeries, Retune, RunSeries
from hpid_ros.metrics.comparison import Comparison, fold_repeats
from hpid_ros.metrics.gain_signals import gain_signals
from hpid_ros.metrics.indices import chatter, l2_norm
from hpid_ros.metrics.quantities import ITAE, IVC
from hpid_ros.metrics.run_numbers import run_indices
from hpid_ros.metrics.signals import Signal, envelope, norm_over_joints

pytestmark = pytest.mark.slow

SETTINGS = LoopSettings(
    "joint0",
    Gains(40.0, 130.0, 4.0),
    mu=-0.2,
    norm=NormSettings(error_scale=0.5, floor=0.01),
    velocity=VelocitySettings("filtered"),
)
NAMES = ["positions", "errors", "efforts", "effort_norm", "error_norm", "spectrum", "phase"]


def swing(label="PID", frequency=1.5, joints=2, count=4001, seed=0):
    """A joint that swings about its reference with a fast part in its effort."""
    t = np.arange(count) * 1e-3
    stamps = 10**18 + np.round(t * 1e9).astype(np.int64)
    noise = np.random.default_rng(seed).normal(size=count)
    series = []
    for k in range(joints):
        error = (1.0 + k) * np.exp(-0.3 * t) * np.cos(2 * math.pi * frequency * t)
        effort = 5.0 * error + 0.3 * np.sin(2 * math.pi * 80.0 * t) + 0.01 * noise
        series.append(JointSeries(f"joint{k}", stamps, -error, 0.0 * t, stamps, effort))
    return RunSeries(label, tuple(series))


def compared(runs):
    return Comparison(tuple(run_indices(run) for run in runs))


def figures(runs, samples=20_000, **more):
    return {each.name: each for each in figures_of(compared(runs), runs, samples, **more)}


def drawing(figure, runs):
    return drawn(figure, [run.label for run in runs])


def shown(figure, runs):
    """Return a drawing whose places are all known."""
    plot = drawing(figure, runs)
    with figure_style():
        plot.draw_without_rendering()
    return plot


def panels(plot):
    return [axes for axes in plot.axes if axes.get_visible()]


def lines_of(axes, style):
    return [line for line in axes.lines if line.get_color() == style.color]


def legend(plot):
    return [text.get_text() for text in plot.legends[0].get_texts()]


@pytest.fixture(scope="module")
def runs():
    return [swing("PID"), swing("hPID", 2.0)]


@pytest.fixture(scope="module")
def gains(runs):
    settings = {"joint0": SETTINGS, "joint1": SETTINGS}
    return {"hPID": gain_signals(runs[1], settings)}


# What is drawn ---------------------------------------------------------------------------------


def test_each_joint_has_a_panel_with_the_signal_of_each_run(runs):
    turned = [runs[0], RunSeries("hPID", runs[1].joints[::-1])]  # matched by name
    plot = drawing(figures(turned)["positions"], turned)
    assert [axes.get_title(loc="left") for axes in panels(plot)] == list(runs[0].joint_names)
    assert (plot.get_supylabel(), plot.get_supxlabel()) == ("position [rad]", "time [s]")
    assert legend(plot) == ["PID", "hPID", "reference"]
    for axes, joint in zip(panels(plot), runs[1].joints, strict=True):
        (line,) = lines_of(axes, RUN_STYLES[1])
        assert np.array_equal(line.get_xdata(), joint.time)
        assert np.array_equal(line.get_ydata(), joint.position)


def test_norm_figures_show_the_euclidean_norm_over_joints(runs):
    plot = drawing(figures(runs)["effort_norm"], runs)
    (line,) = lines_of(panels(plot)[0], RUN_STYLES[0])
    norm = np.linalg.norm([joint.effort for joint in runs[0].joints], axis=0)
    assert line.get_ydata() == pytest.approx(norm)
    assert plot.get_supylabel() == "norm of the effort over all joints [N m]"
    assert f"{l2_norm(runs[0].joints[0].time, norm):.4g}" in legend(plot)[0]


def test_the_calmer_signal_is_drawn_over_the_rougher(runs):
    for order in (runs, runs[::-1]):
        axes = panels(drawing(figures(order)["errors"], order))[0]
        heights = {
            run.label: lines_of(axes, style)[0].get_zorder()
            for run, style in zip(order, RUN_STYLES, strict=False)
        }
        assert heights["PID"] > heights["hPID"]


def test_the_spectrum_has_its_peak_where_the_effort_swings_and_marks_the_cutoff(runs):
    first, second = runs[0].joints
    silent = dataclasses.replace(second, command_stamps_ns=(), effort=())
    some = [dataclasses.replace(runs[0], joints=(first, silent)), runs[1]]
    figure = figures(some)["spectrum"]
    for panel, series in zip(figure.panels, runs[1].joints, strict=True):
        _, frequency, density, _ = panel.lines[-1]
        fast = frequency > 20.0
        assert frequency[fast][np.argmax(density[fast])] == pytest.approx(80.0, abs=1.0)
        power = float(np.sum(density[fast] ** 2)) * (frequency[1] - frequency[0])
        assert math.sqrt(power) == pytest.approx(chatter(series, 20.0), rel=0.01)
    assert [len(panel.lines) for panel in figure.panels] == [2, 1]
    plot = drawing(figure, some)
    assert legend(plot)[-1] == "chatter above 20 Hz"
    assert (plot.get_supxlabel(), plot.get_supylabel()) == (
        "frequency [Hz]",
        "effort density [N m / √Hz]",
    )


def test_the_phase_portrait_shows_the_error_and_its_true_rate(runs):
    series = runs[0].joints[0]
    curve = phase_curve(series, 10_000)
    omega, t = 2 * math.pi * 1.5, series.time
    decay = np.exp(-0.3 * t)
    rate = -decay * (0.3 * np.cos(omega * t) + omega * np.sin(omega * t))
    assert np.allclose(curve.error, series.error, atol=5e-3)
    assert np.allclose(curve.rate[50:-50], rate[50:-50], atol=0.05)
    assert phase_curve(series, 100).error.size <= 100
    line = figures(runs)["phase"].panels[0].lines[0]
    assert np.array_equal(line.y, curve.rate)


def test_a_jump_of_the_reference_tears_the_phase_portrait():
    """Its derivative says nothing of the joint, and would hide all that does."""
    t = np.arange(4001) * 1e-3
    stamps = np.round(t * 1e9).astype(np.int64)
    reference = np.where(t < 2.0, 0.0, 1.0)
    position = np.where(t < 2.0, 0.0, 1.0 - np.exp(-5.0 * (t - 2.0)))
    series = JointSeries("a", stamps, position, reference, stamps, t)
    for points in (10_000, 100):
        curve = phase_curve(series, points)
        assert np.isnan(curve.rate).sum() == 1
        after = np.flatnonzero(np.isnan(curve.rate))[0] + 1
        assert np.allclose(curve.rate[after:], -5.0 * curve.error[after:], atol=0.2)
        assert curve.error[after - 1] == 0.0
    ramp = dataclasses.replace(series, reference=np.clip(t - 1.0, 0.0, 1.0))
    assert not np.isnan(phase_curve(ramp, 10_000).rate).any()


def test_the_rate_of_the_phase_portrait_is_not_drowned_by_encoder_counts():
    t = np.arange(4001) * 1e-3
    count = 2 * math.pi / 16384
    position = count * np.round(np.sin(t) / count)
    stamps = np.round(t * 1e9).astype(np.int64)
    series = JointSeries("a", stamps, position, 0.0 * t, stamps, t)
    wrong = np.abs(phase_curve(series, 5000).rate[50:-50] + np.cos(t[50:-50])).max()
    assert wrong < 0.1 * np.abs(np.diff(position) / 1e-3 - np.cos(t[1:])).max()


def test_gains_are_drawn_by_joint_with_the_norm_on_a_logarithmic_axis(runs, gains):
    found = figures(runs, gains=gains)
    assert list(found) == [*NAMES, "norm", "multiplier", "trade_off"]
    assert panels(drawing(found["norm"], runs))[0].get_yscale() == "log"
    plot = drawing(found["multiplier"], runs)
    assert legend(plot) == ["hPID"]
    (line,) = lines_of(panels(plot)[0], RUN_STYLES[1])  # in the run's own colour
    expected = gains["hPID"]["joint0"].multiplier.values
    assert np.array_equal(np.unique(line.get_ydata()), np.unique(expected))


def test_the_trade_off_shows_medians_with_bars_and_every_repeat():
    single = [
        run_indices(swing(label, frequency, seed=seed))
        for label, frequency in (("PID", 1.5), ("hPID", 2.0))
        for seed in range(3)
    ]
    comparison = Comparison(fold_repeats(single))
    (figure,) = figures_of(comparison, (), 100, repeats=single)
    plot = drawn(figure, ["PID", "hPID"])
    assert legend(plot) == ["PID (3)", "hPID (3)"]
    axes = panels(plot)[0]
    points = {(line.get_xdata()[0], line.get_ydata()[0]) for line in axes.lines}
    assert points >= {(run.value(IVC), run.value(ITAE)) for run in (*single, *comparison.runs)}
    low, high = comparison.runs[0].spread.quartiles[None]["ivc"]
    assert any(list(line.get_xdata()) == [low, high] for line in axes.lines)
    assert axes.get_xlabel() == "variation of the effort, IVC [N m]"


def test_retunes_stand_at_their_time_in_every_figure_over_time(runs):
    retune = Retune(10**18 + 1_500_000_000, "/c", "mu = 0")
    retuned = [runs[0], dataclasses.replace(runs[1], retunes=(retune,))]
    for name in ("efforts", "error_norm"):
        plot = drawing(figures(retuned)[name], retuned)
        assert legend(plot)[-1] == "retuned"
        for axes in panels(plot):
            marks = [line for line in axes.lines if list(line.get_xdata()) == [1.5, 1.5]]
            assert [line.get_color() for line in marks] == [RUN_STYLES[1].color]
    assert "retuned" not in legend(drawing(figures(runs)["efforts"], runs))


def test_runs_without_commands_or_of_one_state_can_be_drawn():
    silent = JointSeries("a", [0, 10**9], [0.0, 0.0], [1.0, 1.0], [], [])
    single = JointSeries("a", [5], [0.0], [1.0], [5], [2.0])
    for series, left_out in ((silent, {"efforts", "effort_norm", "spectrum"}), (single, set())):
        some = [RunSeries("x", (series,))]
        found = figures(some)
        assert set(found) == set(NAMES) - left_out
        for figure in found.values():
            assert panels(shown(figure, some))


# Layout ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("edge", ["upper", "lower"])
@pytest.mark.parametrize("knows_outside", [True, False], ids=["3.7", "3.6"])
def test_a_legend_covers_no_panel_whatever_matplotlib_knows(edge, knows_outside, monkeypatch):
    own = Figure.legend

    def legend_of_old(self, **what):
        if what["loc"].startswith("outside"):
            raise ValueError(f"{what['loc']!r} is not a valid value for loc")
        return own(self, **what)

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


def boxes_of(plot):
    """Return the boxes of all texts that are seen; a tenth of a font's height is air."""
    texts = [plot._supxlabel, plot._supylabel, *plot.legends]
    for axes in panels(plot):
        texts += [axes._left_title, axes.xaxis.label, axes.yaxis.label]
        texts += [*ticks_in_view(axes.xaxis), *ticks_in_view(axes.yaxis)]
    texts = [each for each in texts if not hasattr(each, "get_text") or each.get_text()]
    return [each.get_window_extent().shrunk(0.9, 0.9) for each in texts if each.get_visible()]


@pytest.mark.parametrize("joints", [1, 7])
def test_no_labels_overlap_whatever_the_number_of_joints(joints):
    labels = ["PID", "a controller with a long name", *(f"another one {k}" for k in range(4))]
    runs = [swing(label, joints=joints, count=201) for label in labels]
    settings = {f"joint{k}": SETTINGS for k in range(joints)}
    gains = {run.label: gain_signals(run, settings) for run in runs}
    found = figures(runs, gains=gains)
    # The others are laid out as one of these; the last two alike for any number of joints.
    kinds = ("positions", "spectrum", "phase", "multiplier", "error_norm", "trade_off")
    for name in kinds if joints == 1 else kinds[:4]:
        plot = shown(found[name], runs)
        boxes = boxes_of(plot)
        for k, box in enumerate(boxes):
            assert min(box.x0, box.y0) >= 0, name
            assert max(box.x1 - plot.bbox.width, box.y1 - plot.bbox.height) <= 0, name
            assert not any(box.overlaps(other) for other in boxes[:k]), name


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


@pytest.mark.parametrize(
    ("limits", "labels"),
    [((3e-3, 8e-3), ["0.004", "0.006", "0.008"]), ((1.5, 60.0), ["2", "5", "10", "20", "50"])],
)
def test_a_short_logarithmic_axis_has_numbers_to_read_it_by(limits, labels):
    axis = Figure().subplots().yaxis
    axis.axes.set(yscale="log", ylim=limits)
    log_ticks(axis)
    shown = zip(axis.get_ticklabels(), axis.get_ticklocs(), strict=True)
    assert [text.get_text() for text, at in shown if limits[0] <= at <= limits[1]] == labels


def test_runs_are_told_apart_by_lightness_and_by_line_too():
    def lightness(color):
        return float(np.dot([0.2126, 0.7152, 0.0722], np.array(to_rgb(color)) ** 2.2))

    first, second = RUN_STYLES[:2]
    assert abs(lightness(first.color) - lightness(second.color)) > 0.1
    assert first.dashes != second.dashes
    for style in RUN_STYLES:
        contrast = (lightness(BACKGROUND) + 0.05) / (lightness(style.color) + 0.05)
        assert contrast >= 3.0, f"{style.color} is too faint on paper"
    assert BACKGROUND not in [style.tint for style in RUN_STYLES[1:]]  # a gap's peak is drawn, too


# Files -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("form", "begin"), [("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<")])
def test_the_same_runs_give_the_same_bytes(runs, form, begin):
    first, second = (
        drawing_bytes(drawing(figures(runs)["error_norm"], runs), form) for _ in range(2)
    )
    assert first == second
    assert first.startswith(begin)
    assert not re.search(rb"CreationDate|<dc:date>", first)


def test_drawing_leaves_matplotlib_as_it_was_and_pyplot_alone():
    program = (
        "import sys, matplotlib\n"
        "before = matplotlib.rcParams.copy()\n"
        "from hpid_ros.metrics import Comparison, JointSeries, RunSeries, run_indices\n"
        "from hpid_bench.report.figures import figures_of\n"
        "from hpid_bench.report.plots import drawing_bytes, drawn\n"
        "run = RunSeries('x', (JointSeries('a', [0, 9], [0, 1], [1, 1], [0, 9], [1, 2]),))\n"
        "numbers = Comparison((run_indices(run),))\n"
        "figures = figures_of(numbers, [run], 100)\n"
        "assert [drawing_bytes(drawn(each, ['x']), 'svg') for each in figures]\n"
        "assert matplotlib.rcParams.copy() == before\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )
    path = os.pathsep.join(sys.path)
    subprocess.run(
        [sys.executable, "-c", program], check=True, env={**os.environ, "PYTHONPATH": path}
    )


# Signals ---------------------------------------------------------------------------------------


def test_multiplier_and_norm_are_the_laws_own():
    """The recorded loop, run again sample by sample, has the multipliers that are drawn."""
    run = swing(joints=1)
    signals = gain_signals(run, {"joint0": SETTINGS})["joint0"]
    series, law = run.joints[0], make_law(SETTINGS)
    velocity = make_velocity_source(SETTINGS.velocity)
    expected = []
    for k, position in enumerate(series.position):
        rate = velocity.update(float(position), None, 1e-3 if k else 0.0)
        expected.append(law.multiplier(float(series.error[k]), -rate))
    assert np.allclose(signals.multiplier.values, expected, rtol=1e-9)
    limited = np.maximum(signals.norm.values, 0.01)
    assert np.allclose(limited**-0.2, signals.multiplier.values, rtol=1e-12)
    linear = gain_signals(run, {"joint0": dataclasses.replace(SETTINGS, law="pid")})
    assert set(linear["joint0"].multiplier.values) == {1.0}
    assert gain_signals(run, {}) is None


def test_the_error_rate_is_the_references_rate_minus_the_velocity():
    t = np.arange(2001) * 1e-3
    stamps = np.round(t * 1e9).astype(np.int64)
    reference = np.sin(3.0 * t)
    settings = SETTINGS.with_parameters({"velocity_filter_time_constant": 0.0})

    def norm_of(position, reference):
        series = JointSeries("joint0", stamps, position, reference, stamps, t)
        return gain_signals(RunSeries("x", (series,)), {"joint0": settings})["joint0"].norm.values

    along = norm_of(reference - 0.3, reference)
    # The velocity is a difference, half a period late; the reference's rate is not.
    assert np.allclose(along[1:], make_norm(settings)(0.3, 0.0), rtol=1e-3)
    jump = norm_of(0.0 * t, 1.0 * (t > 1.0))
    assert jump.max() == pytest.approx(make_norm(settings)(1.0, 0.0))  # a jump has no rate


@given(
    hnp.arrays(np.float64, st.integers(1, 500), elements=st.floats(-1e6, 1e6)), st.integers(1, 40)
)
def test_thinning_loses_no_peak_keeps_order_and_invents_nothing(values, buckets):
    signal = Signal(np.arange(values.size, dtype=np.int64) * 7, values)
    thin = envelope(signal, buckets)
    assert thin.values.size <= max(4 * buckets, 1)
    assert np.array_equal(values[thin.stamps_ns // 7], thin.values)
    assert np.all(np.diff(thin.stamps_ns) > 0)
    assert (thin.values.min(), thin.values.max()) == (values.min(), values.max())
    assert (thin.stamps_ns[0], thin.stamps_ns[-1]) == (0, signal.stamps_ns[-1])


def test_a_norm_bridges_lost_samples_and_counts_a_silent_joint_as_zero():
    def signal(stamps, values):
        return Signal(np.array(stamps, dtype=np.int64), np.array(values, dtype=np.float64))

    whole = signal([0, 1, 2, 3], [3.0, 3.0, 3.0, 3.0])
    holed, silent = signal([0, 2], [4.0, 4.0]), signal([], [])
    stamps_ns, values = norm_over_joints([whole, holed, silent])
    assert stamps_ns.tolist() == [0, 1, 2, 3]
    assert values.tolist() == [5.0, 5.0, 5.0, 3.0]
