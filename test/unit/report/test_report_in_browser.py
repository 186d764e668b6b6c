"""The report in a real browser: opens from disk, zooms, tells values, in both themes, narrow.

Needs Chromium (Debian: ``apt install chromium``) and playwright from PyPI; skipped without them.
"""

import numpy as np
import pytest
from harness.browser import launched
from harness.runs import response

from hpid_bench.report.page import render_report
from hpid_ros.messages.series import Retune
from hpid_ros.metrics.comparison import Comparison
from hpid_ros.metrics.run_numbers import run_indices

pytestmark = pytest.mark.slow

LATE = 20_000  # [ms]


@pytest.fixture(scope="module")
def browser():
    with launched() as found:
        yield found


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    retunes = (Retune(4_000_000_000, "/c", "mu = 0.1"),)
    runs = [
        response(label, damping, samples=901, retunes=retunes)
        for label, damping in (("PID", 0.6), ("hPID", 1.2))
    ]
    comparison = Comparison(tuple(run_indices(run) for run in runs))
    parameters = {"hPID": {"elbow": {"mu": -0.1}, "shoulder": {"mu": -0.2}}}
    path = tmp_path_factory.mktemp("report") / "report.html"
    path.write_text(render_report(comparison, runs, {"seed": 7}, parameters), encoding="utf-8")
    return path.as_uri()


@pytest.fixture
def open_page(browser, report):
    """Return a function that opens the report and fails the test on any error or request."""
    contexts, wrong, requests = [], [], []

    def opened(width=1200, scheme="light"):
        context = browser.new_context(
            viewport={"width": width, "height": 900}, color_scheme=scheme, offline=True
        )
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(LATE)
        page.on("console", lambda said: wrong.append(said.text))
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("request", lambda request: requests.append(request.url))
        page.goto(report)
        page.wait_for_selector("canvas")
        page.wait_for_function(DRAWN)
        return page

    yield opened
    for context in contexts:
        context.close()
    assert wrong == []
    assert set(requests) == {report}


DRAWN = "() => document.querySelector('canvas').width !== 300"
"""A canvas is 300 wide before anything is drawn."""

INK = """canvas => {
  const pen = canvas.getContext('2d');
  const {data} = pen.getImageData(0, 0, canvas.width, canvas.height);
  let sum = 0;
  for (let k = 3; k < data.length; k += 4) sum += data[k] > 0;
  return sum;
}"""


def picture(canvas):
    return canvas.evaluate("canvas => canvas.toDataURL()")


def wait_until(page, canvas, how, before):
    """Wait until a canvas is (``===``) or is not (``!==``) as it was before."""
    is_so = f"([canvas, before]) => canvas.toDataURL() {how} before"
    page.wait_for_function(is_so, arg=[canvas.element_handle(), before])


@pytest.mark.parametrize(("width", "scheme"), [(400, "dark"), (1200, "light")])
def test_every_chart_is_drawn_and_named_and_the_page_never_scrolls_sideways(
    open_page, width, scheme
):
    page = open_page(width, scheme)
    canvases = page.locator("canvas").all()
    assert len(canvases) == 2 * 5 + 2 + 2
    page.wait_for_function(f"[...document.querySelectorAll('canvas')].every({INK})")
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.evaluate(
        "[...document.querySelectorAll('canvas')].every((e) => e.getAttribute('aria-label'))"
    )
    # The keyboard reaches all but tabs, among which the arrows move.
    assert not page.evaluate(
        "[...document.querySelectorAll('button, canvas, summary')]"
        ".filter((each) => each.tabIndex < 0 && each.getAttribute('role') !== 'tab').length"
    )


def test_the_answer_is_on_the_first_screen_and_the_rest_is_folded(open_page):
    page = open_page(800)
    assert page.locator(".scroll").first.evaluate("box => box.scrollWidth <= box.clientWidth")
    assert page.locator("tfoot").first.evaluate("row => row.getBoundingClientRect().bottom") < 900
    figures = page.locator("details.figure")
    are_open = figures.evaluate_all("all => all.map(each => each.open)")
    assert are_open == [True, *[False] * (len(are_open) - 1)]
    folded = figures.nth(1)
    assert not folded.locator("canvas").first.is_visible()
    folded.locator("summary").click()
    folded.locator("canvas").first.wait_for(state="visible")
    assert folded.locator("canvas").first.evaluate(INK)
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert all(figures.evaluate_all("all => all.map(each => each.open)"))
    page.evaluate("dispatchEvent(new Event('afterprint'))")
    after = figures.evaluate_all("all => all.map(each => each.open)")
    assert after == [True, True, *[False] * (len(after) - 2)]


def test_a_table_wider_than_the_page_says_so_scrolls_and_shrinks_on_paper(open_page):
    page = open_page(400)
    box = page.locator(".scroll").first
    page.wait_for_function("document.querySelector('.scroll').classList.contains('more-right')")
    hint = "getComputedStyle(document.querySelector('.scroll'), '::before').content"
    assert "scroll sideways" in page.evaluate(hint)
    box.evaluate("box => { box.scrollLeft = box.scrollWidth; }")
    page.wait_for_function("document.querySelector('.scroll').classList.contains('more-left')")
    assert "more-right" not in box.get_attribute("class")
    page.set_viewport_size({"width": 718, "height": 900})  # A4 less its margins
    page.emulate_media(media="print")
    widths = page.evaluate(
        "[...document.querySelectorAll('.scroll')].map(e => e.scrollWidth - e.clientWidth)"
    )
    assert max(widths) <= 1
    wide = open_page(1200)
    assert "wide" not in wide.locator(".scroll").first.get_attribute("class")


def test_tabs_work_by_mouse_and_by_keys(open_page):
    page = open_page()
    tabs = page.get_by_role("tab")
    assert tabs.all_inner_texts() == ["Figures", "All indices", "Parameters", "Data", "Provenance"]
    page.get_by_role("tab", name="Provenance").click()
    assert page.locator("section:visible h2").all_inner_texts() == ["Provenance"]
    page.keyboard.press("ArrowRight")  # round to the first
    assert page.locator("section:visible h2").all_inner_texts() == ["Figures"]
    page.keyboard.press("End")
    page.keyboard.press("ArrowLeft")
    assert page.locator("section:visible h2").all_inner_texts() == ["Data"]
    assert page.evaluate("document.activeElement.textContent") == "Data"
    assert page.locator("[role=tab][aria-selected=true]").count() == 1


def test_a_drag_zooms_all_time_charts_and_a_double_click_shows_the_whole(open_page):
    page = open_page()
    first = page.locator("#positions canvas").first
    other = page.locator("#errors canvas").last
    whole, other_whole = picture(first), picture(other)
    first.evaluate("canvas => canvas.scrollIntoView({block: 'center'})")
    box = first.bounding_box()
    middle = box["y"] + box["height"] / 2
    for start, end in ((5, 30), (100, 200)):  # the first within the labels of the axis
        assert picture(other) == other_whole
        page.mouse.move(box["x"] + start, middle)
        page.mouse.down()
        page.mouse.move(box["x"] + end, middle, steps=5)
        page.mouse.up()
        page.mouse.move(5, 5)
        page.evaluate("new Promise(done => requestAnimationFrame(() => setTimeout(done)))")
    wait_until(page, other, "!==", other_whole)
    assert picture(first) != whole
    first.dblclick()
    page.mouse.move(5, 5)
    wait_until(page, other, "===", other_whole)


def test_the_keyboard_reads_values_and_zooms(open_page):
    page = open_page()
    page.locator("#errors summary").click()
    chart = page.locator("#errors .panel").first
    canvas = chart.locator("canvas")
    whole = picture(canvas)
    canvas.focus()
    page.keyboard.press("ArrowRight")
    page.wait_for_function("document.querySelector('#errors output').textContent !== ''")
    text = chart.locator("output").inner_text()
    at = 9.0 * 0.51
    expected = np.exp(-0.6 * at) * np.cos(3 * at)
    assert text.startswith("time [s] 4.59: PID ")
    value = float(text.split("PID ")[1].split(",")[0].replace("\u2212", "-"))
    assert value == pytest.approx(expected, abs=2e-3)
    page.keyboard.press("+")
    page.keyboard.press("Shift+ArrowRight")
    wait_until(page, canvas, "!==", whole)
    page.keyboard.press("0")
    page.mouse.move(5, 5)
    assert "hPID" in chart.locator("output").inner_text()


def test_a_run_can_be_hidden_and_the_theme_be_chosen(open_page):
    page = open_page()
    page.locator("#efforts summary").click()
    canvas = page.locator("#efforts canvas").first
    before = picture(canvas)
    button = page.locator("#efforts").get_by_role("button", name="hPID", exact=True)
    button.click()
    assert button.get_attribute("aria-pressed") == "false"
    wait_until(page, canvas, "!==", before)
    light = page.evaluate("getComputedStyle(document.body).backgroundColor")
    theme = page.get_by_role("button", name="theme")
    theme.click()
    theme.click()
    assert theme.inner_text() == "theme: dark"
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") != light
