"""Spectrum, phase portrait, gains over time, error against effort, retunes, saved files."""

import dataclasses
import math

import numpy as np
import pytest
from matplotlib.figure import Figure

from hpid_ros.control import Gains, LoopSettings
from hpid_ros.control.assembly import make_law, make_norm, make_velocity_source
from hpid_ros.control.settings import NormSettings, VelocitySettings
from hpid_ros.messages.series import JointSeries, Retune, RunSeries, SeriesError
from hpid_ros.metrics.comparison import Comparison
from hpid_ros.metrics.folding import fold_repeats
from hpid_ros.metrics.indices import chatter
from hpid_ros.metrics.measure import gain_signals
from hpid_ros.metrics.quantities import ITAE, IVC
from hpid_ros.metrics.results import run_indices
from hpid_ros.report.panels import log_ticks
from hpid_ros.report.plots import (
    FIGURES,
    efforts_figure,
    error_norm_figure,
    multiplier_figure,
    norm_figure,
    phase_figure,
    render,
    save_figures,
    spectrum_figure,
)
from hpid_ros.report.portraits import phase_curve, trade_off_figure
from hpid_ros.report.style import RUN_STYLES

pytestmark = pytest.mark.slow


def swing(label="PID", frequency=1.5, joints=2, count=4001, seed=0):
    """A joint that swings about its reference with a fast part in its effort."""
    t = np.arange(count) * 1e-3
    stamps = np.round(t * 1e9).astype(np.int64)
    noise = np.random.default_rng(seed).normal(size=count)
    series = []
    for k in range(joints):
        error = (1.0 + k) * np.exp(-0.3 * t) * np.cos(2 * math.pi * frequency * t)
        effort = 5.0 * error + 0.3 * np.sin(2 * math.pi * 80.0 * t) + 0.01 * noise
        series.append(JointSeries(f"joint{k}", stamps, -error, 0.0 * t, stamps, effort))
    return RunSeries(label, tuple(series))


@pytest.fixture(scope="module")
def runs():
    return [swing("PID"), swing("hPID", 2.0)]


def panels(figure):
    return [axes for axes in figure.axes if axes.get_visible()]


def line_of(axes, style):
    return next(line for line in axes.lines if line.get_color() == style.color)


def labels_of(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_the_spectrum_has_its_peak_where_the_effort_swings_and_marks_the_cutoff(runs):
    figure = spectrum_figure(runs)
    for axes, series in zip(panels(figure), runs[1].joints, strict=True):
        frequency, density = line_of(axes, RUN_STYLES[1]).get_data()
        fast = frequency > 20.0
        assert frequency[fast][np.argmax(density[fast])] == pytest.approx(80.0, abs=1.0)
        power = float(np.sum(density[fast] ** 2)) * (frequency[1] - frequency[0])
        assert math.sqrt(power) == pytest.approx(chatter(series, 20.0), rel=0.01)
    assert labels_of(figure)[-1] == "chatter above 20 Hz"
    assert "[Hz]" in figure.get_supxlabel()
    assert "N m" in figure.get_supylabel()


@pytest.mark.parametrize(
    ("limits", "labels"),
    [
        ((3e-3, 8e-3), ["0.004", "0.006", "0.008"]),
        ((1.5, 60.0), ["2", "5", "10", "20", "50"]),
    ],
)
def test_a_short_logarithmic_axis_has_numbers_to_read_it_by(limits, labels):
    axis = Figure().subplots().yaxis
    axis.axes.set(yscale="log", ylim=limits)
    log_ticks(axis)
    low, high = limits
    shown = [
        label.get_text()
        for label, at in zip(axis.get_ticklabels(), axis.get_ticklocs(), strict=True)
        if low <= at <= high
    ]
    assert shown == labels


def test_a_joint_without_efforts_leaves_its_spectrum_empty(runs):
    first, second = runs[0].joints
    silent = dataclasses.replace(second, command_stamps_ns=(), effort=())
    figure = spectrum_figure([dataclasses.replace(runs[0], joints=(first, silent))])
    render(figure, "png")
    assert len(line_of(panels(figure)[0], RUN_STYLES[0]).get_xdata()) > 100


def test_the_phase_portrait_shows_the_error_and_its_true_rate(runs):
    series = runs[0].joints[0]
    curve = phase_curve(series, 10_000)
    omega, t = 2 * math.pi * 1.5, series.time
    decay = np.exp(-0.3 * t)
    rate = -decay * (0.3 * np.cos(omega * t) + omega * np.sin(omega * t))
    assert np.allclose(curve.error, series.error, atol=5e-3)
    assert np.allclose(curve.rate[50:-50], rate[50:-50], atol=0.05)
    x, y = line_of(panels(phase_figure(runs))[0], RUN_STYLES[0]).get_data()
    assert (x.size, y.size) == (4001, 4001)
    thin = phase_curve(series, 100)
    assert thin.error.size <= 100


def test_a_jump_of_the_reference_tears_the_phase_portrait():
    """Its derivative says nothing of the joint, and would hide all that does."""
    t = np.arange(4001) * 1e-3
    stamps = np.round(t * 1e9).astype(np.int64)
    reference = np.where(t < 2.0, 0.0, 1.0)
    position = np.where(t < 2.0, 0.0, 1.0 - np.exp(-5.0 * (t - 2.0)))
    series = JointSeries("a", stamps, position, reference, stamps, t)
    for points, share in ((10_000, 1e-3), (100, 0.05)):
        curve = phase_curve(series, points)
        assert np.isnan(curve.rate).sum() == 1
        after = np.flatnonzero(np.isnan(curve.rate))[0] + 1
        assert np.allclose(curve.rate[after:], -5.0 * curve.error[after:], atol=0.2)
        assert np.nanmax(np.abs(curve.rate)) == pytest.approx(5.0, rel=0.05 + share)
        assert curve.error[after - 1] == 0.0
    ramp = dataclasses.replace(series, reference=np.clip(t - 1.0, 0.0, 1.0))
    assert not np.isnan(phase_curve(ramp, 10_000).rate).any()


def test_the_rate_of_the_phase_portrait_is_not_drowned_by_encoder_counts():
    t = np.arange(4001) * 1e-3
    count = 2 * math.pi / 16384
    stamps = np.round(t * 1e9).astype(np.int64)
    position = count * np.round(np.sin(t) / count)
    series = JointSeries("a", stamps, position, 0.0 * t, stamps, t)
    bare = np.diff(position) / 1e-3
    wrong = np.abs(phase_curve(series, 5000).rate[50:-50] + np.cos(t[50:-50])).max()
    assert wrong < 0.1 * np.abs(bare - np.cos(t[1:])).max()


SETTINGS = LoopSettings(
    "joint0",
    Gains(40.0, 130.0, 4.0),
    mu=-0.2,
    norm=NormSettings(error_scale=0.5, floor=0.01),
    velocity=VelocitySettings("filtered"),
)


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


def test_the_error_rate_is_the_references_rate_minus_the_velocity():
    t = np.arange(2001) * 1e-3
    stamps = np.round(t * 1e9).astype(np.int64)
    reference = np.sin(3.0 * t)
    series = JointSeries("joint0", stamps, reference - 0.3, reference, stamps, t)
    settings = SETTINGS.with_parameters({"velocity_filter_time_constant": 0.0})
    norm = gain_signals(RunSeries("x", (series,)), {"joint0": settings})["joint0"].norm.values
    at_rest = make_norm(settings)(0.3, 0.0)
    assert np.allclose(norm[1:], at_rest, rtol=1e-6)  # it moves with its reference
    jump = JointSeries("joint0", stamps, 0.0 * t, 1.0 * (t > 1.0), stamps, t)
    norm = gain_signals(RunSeries("x", (jump,)), {"joint0": settings})["joint0"].norm.values
    assert norm.max() == pytest.approx(make_norm(settings)(1.0, 0.0))  # a jump has no rate


def test_a_linear_pid_has_the_multiplier_one_and_unknown_settings_none():
    run = swing(joints=1)
    linear = dataclasses.replace(SETTINGS, law="pid")
    values = gain_signals(run, {"joint0": linear})["joint0"].multiplier.values
    assert set(values) == {1.0}
    assert gain_signals(run, {}) is None


def test_gains_are_drawn_by_joint_with_the_norm_on_a_logarithmic_axis():
    run = swing(joints=1)
    gains = {"PID": gain_signals(run, {"joint0": SETTINGS})}
    (axes,) = panels(norm_figure([run], gains, 5000))
    assert axes.get_yscale() == "log"
    (axes,) = panels(multiplier_figure([run], gains, 5000))
    drawn = line_of(axes, RUN_STYLES[0]).get_ydata()
    assert np.array_equal(drawn, gains["PID"]["joint0"].multiplier.values)


def test_the_trade_off_shows_medians_with_bars_and_every_repeat():
    single = [
        run_indices(swing(label, frequency, seed=seed))
        for label, frequency in (("PID", 1.5), ("hPID", 2.0))
        for seed in range(3)
    ]
    comparison = Comparison(fold_repeats(single))
    figure = trade_off_figure(comparison, single)
    assert labels_of(figure) == ["PID (3)", "hPID (3)"]
    axes = panels(figure)[0]
    points = {(line.get_xdata()[0], line.get_ydata()[0]) for line in axes.lines}
    for run in (*single, *comparison.runs):
        assert (run.value(IVC), run.value(ITAE)) in points
    low, high = comparison.runs[0].spread.quartiles[None]["ivc"]
    assert any(list(line.get_xdata()) == [low, high] for line in axes.lines)
    assert axes.get_xlabel() == "variation of the effort, IVC [N m]"


def test_retunes_stand_at_their_time_in_every_figure_over_time(runs):
    retuned = dataclasses.replace(runs[1], retunes=(Retune(1_500_000_000, "/c", "mu = 0"),))
    for draw in (efforts_figure, error_norm_figure):
        figure = draw([runs[0], retuned])
        assert labels_of(figure)[-1] == "retuned"
        for axes in panels(figure):
            marks = [line for line in axes.lines if list(line.get_xdata()) == [1.5, 1.5]]
            assert [line.get_color() for line in marks] == [RUN_STYLES[1].color]
        assert "retuned" not in labels_of(draw(runs))


def boxes_of(figure):
    """Return the boxes of all texts that are seen."""
    texts = [each for each in (figure._supxlabel, figure._supylabel) if each is not None]
    texts += figure.legends
    for axes in panels(figure):
        texts += [axes._left_title, axes.xaxis.label, axes.yaxis.label]
        for axis in (axes.xaxis, axes.yaxis):
            low, high = sorted(axis.get_view_interval())
            ticks = (tick for tick in axis.get_major_ticks() if low <= tick.get_loc() <= high)
            texts += [tick.label1 for tick in ticks if tick.label1.get_visible()]
    texts = [each for each in texts if not hasattr(each, "get_text") or each.get_text()]
    return [each.get_window_extent().shrunk(0.9, 0.9) for each in texts if each.get_visible()]


@pytest.mark.parametrize("joints", [1, 2, 8])
def test_no_labels_overlap(joints):
    runs = [swing("PID", joints=joints), swing("a controller with a long name", joints=joints)]
    runs += [swing(f"another controller {k}", joints=joints) for k in range(4)]
    settings = {f"joint{k}": SETTINGS for k in range(joints)}
    gains = {run.label: gain_signals(run, settings) for run in runs}
    comparison = Comparison(tuple(run_indices(run) for run in runs))
    figures = {name: draw(runs) for name, draw in FIGURES.items()}
    figures |= {"norm": norm_figure(runs, gains, 500), "trade": trade_off_figure(comparison)}
    figures["multiplier"] = multiplier_figure(runs, gains, 500)
    for name, figure in figures.items():
        render(figure, "png")
        boxes = boxes_of(figure)
        width, height = figure.bbox.width, figure.bbox.height
        for k, box in enumerate(boxes):
            assert min(box.x0, box.y0) >= 0, name
            assert max(box.x1 - width, box.y1 - height) <= 0, name
            assert not any(box.overlaps(other) for other in boxes[:k]), name


def test_everything_that_can_be_drawn_is_saved_in_each_format(runs, tmp_path):
    comparison = Comparison(tuple(run_indices(run) for run in runs))
    settings = {"joint0": SETTINGS, "joint1": SETTINGS}
    gains = {"hPID": gain_signals(runs[1], settings)}
    paths = save_figures(runs, tmp_path, ("png", "pdf", "svg"), comparison=comparison, gains=gains)
    names = [*FIGURES, "norm", "multiplier", "trade_off"]
    forms = ("png", "pdf", "svg")
    assert [path.name for path in paths] == [f"{n}.{f}" for n in names for f in forms]
    assert all(path.stat().st_size > 1000 for path in paths)


def test_numbers_alone_give_the_trade_off_and_nothing_gives_an_error(runs, tmp_path):
    comparison = Comparison(tuple(run_indices(run) for run in runs))
    paths = save_figures((), tmp_path, ("svg",), comparison=comparison)
    assert [path.name for path in paths] == ["trade_off.svg"]
    with pytest.raises(SeriesError, match="at least one run"):
        save_figures((), tmp_path)
