"""The page as a person uses it, in a real browser, over joints that are simulated.

Needs Chromium (Debian: ``apt install chromium``) and playwright from PyPI; skipped without them.
"""

import queue
import re

import pytest
from harness.browser import launched
from harness.simulated_graph import SimulatedGraph, arm

from hpid_bench.live.page.server import PageServer

pytestmark = pytest.mark.slow

LATE = 60_000  # [ms]
NODES = [f"/arm_joint_{number}_controller" for number in (1, 2, 3)]


class ServedGraph(SimulatedGraph):
    """A simulated graph with its page, and what has reached it."""

    def __init__(self):
        super().__init__(arm())
        self.told = queue.Queue()
        self.page = PageServer(self, port=0)
        self.url = self.page.url
        self.root = self.url.partition("?")[0]

    def set(self, node, values):
        self.told.put((node, dict(values)))
        return super().set(node, values)

    def change_state(self, node, transition):
        self.told.put((node, transition))
        return super().change_state(node, transition)

    def next(self, count=1):
        return [self.told.get(timeout=LATE / 1000) for _ in range(count)]

    def nothing_more(self):
        return self.told.empty()


@pytest.fixture(scope="module")
def context():
    with launched() as browser:
        made = browser.new_context(viewport={"width": 1300, "height": 950})
        made.set_default_timeout(LATE)
        yield made


@pytest.fixture(scope="module")
def shared():
    graph = ServedGraph()
    yield graph
    graph.page.stop()


@pytest.fixture
def server(shared):
    while not shared.told.empty():
        shared.told.get()
    return shared


@pytest.fixture
def open_page(context, server):
    """Return a function that opens the page and fails the test on any error or foreign request."""
    pages, wrong, requests = [], [], []

    def opened(address=None):
        pages.append(page := context.new_page())
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("console", lambda said: said.type == "error" and wrong.append(said.text))
        page.on("request", lambda request: requests.append(request.url))
        page.goto(address or server.url)
        return page

    yield opened
    for page in pages:
        page.close()
    # a page that is opened while another one closes may find its socket closed
    assert [each for each in wrong if "WebSocket" not in each] == []
    local = re.compile(r"(https?|ws)://127\.0\.0\.1:\d+/|data:|blob:")
    assert [each for each in requests if not local.match(each)] == []


def choose(page, *numbers):
    page.get_by_role("checkbox", name="choose arm_joint_3").wait_for()
    page.get_by_role("button", name="choose no joint").click()
    page.wait_for_function("!document.querySelector('.joints [aria-checked=true]')")
    for number in numbers:
        page.get_by_role("checkbox", name=f"choose arm_joint_{number}").click()


def apply(page):
    page.get_by_role("button", name="Apply", exact=True).click()


def discard(page):  # a page that is closed at once may not have said what was chosen
    page.get_by_role("button", name="Discard").click()
    page.get_by_text(re.compile("chosen, not sent")).wait_for(state="hidden")


def type_into(page, name, value):
    page.get_by_role("spinbutton", name=re.compile(name)).fill(str(value))
    page.get_by_text(re.compile("chosen, not sent")).wait_for()


def drag(page, name, begin, end):
    """Pull a slider that is enabled from one share of its length to another."""
    slider = page.get_by_role("slider", name=re.compile(name), disabled=False)
    box = slider.bounding_box()
    middle = 0.5 * box["height"]
    slider.hover(position={"x": begin * box["width"], "y": middle})
    page.mouse.down()
    page.mouse.move(box["x"] + end * box["width"], box["y"] + middle, steps=8)


def logged(page, text):
    page.get_by_role("listitem").filter(has_text=text).first.wait_for()


def test_one_joint_is_retuned_and_the_step_is_undone(open_page, server):
    page = open_page()
    choose(page, 1)
    type_into(page, "proportional gain", 96)
    assert server.nothing_more()
    apply(page)
    assert server.next() == [(NODES[0], {"gains.p": 96.0})]
    page.keyboard.press("Tab")
    page.get_by_role("button", name="Undo").click()
    assert server.next() == [(NODES[0], {"gains.p": 80.0})]
    type_into(page, "bandwidth", 2)
    apply(page)
    assert server.next() == [(NODES[0], {"gains.p": 320.0, "gains.i": 1600.0, "gains.d": 16.0})]


def test_snapshots_and_files_are_kept_and_come_back_to(open_page, server, tmp_path):
    page = open_page()
    page.get_by_role("tab", name="Save").click()
    page.get_by_role("textbox", name="name of the snapshot").fill("before")
    page.get_by_role("button", name="Keep what is in force").click()
    page.get_by_role("tab", name="Tune").click()
    choose(page, 2)
    type_into(page, "integral gain", 50)
    apply(page)
    assert server.next() == [(NODES[1], {"gains.i": 50.0})]
    page.get_by_role("tab", name="Save").click()
    page.get_by_role("button", name="go back to it").first.click()
    assert server.next() == [(NODES[1], {"gains.i": 100.0})]
    with page.expect_download() as download:
        page.get_by_role("button", name="Save controllers.yaml").click()
    saved = tmp_path / "controllers.yaml"
    download.value.save_as(saved)
    changed = tmp_path / "changed.yaml"
    changed.write_text(saved.read_text().replace("mu: -0.2", "mu: 0.1"))
    page.set_input_files("input[type=file]", changed)
    logged(page, "changed.yaml: staged for arm_joint_1, arm_joint_2, arm_joint_3")
    broken = tmp_path / "broken.yaml"
    broken.write_text("a: [")
    page.set_input_files("input[type=file]", broken)
    logged(page, "cannot read broken.yaml: line 1")
    page.get_by_role("tab", name="Tune").click()
    discard(page)
    assert server.nothing_more()


def activate(page, server):
    page.get_by_text("inactive").first.wait_for()
    for number, node in enumerate(NODES, 1):
        page.get_by_role("button", name=f"activate arm_joint_{number}", exact=True).click()
        assert server.next() == [(node, "activate")]


def test_a_page_looks_on_until_its_person_takes_control_and_all_stop_by_escape(open_page, server):
    first = open_page()
    choose(first, 1)
    second = open_page(server.root)
    second.get_by_text(re.compile(r"^page \d+ at 127.0.0.1 has control: this one")).wait_for()
    choose(second, 1)
    assert second.get_by_role("spinbutton", name=re.compile("proportional")).is_disabled()
    second.keyboard.press("Control+Enter")
    second.get_by_role("button", name="Take control").click()
    first.get_by_text(re.compile("^page .* has control: this one looks on")).wait_for()
    logged(first, re.compile(r"page \d+ at 127.0.0.1 has taken control from page \d+ at"))
    type_into(second, "proportional gain", 90)
    first.keyboard.press("Control+Enter")  # its button is off now
    discard(second)
    assert server.nothing_more()
    second.get_by_role("spinbutton", name=re.compile("derivative")).click()  # also out of a field
    for page in (first, second):
        page.keyboard.press("Escape")
        assert sorted(server.next(3)) == [(node, "deactivate") for node in NODES]
        activate(second, server)


def test_a_page_that_is_closed_in_the_middle_of_a_drag_changes_nothing(open_page, server):
    page = open_page()
    choose(page, 3)
    page.get_by_text("certified stable for μ from -0.495 to +0.495").wait_for()
    place = page.locator(".interval-certified").bounding_box()
    whole = page.locator(".interval").bounding_box()
    assert place["width"] == pytest.approx(0.99 * whole["width"], rel=0.02)
    type_into(page, "integral gain", 350)
    type_into(page, "homogeneity degree", 0.3)
    page.get_by_text("μ = 0.3 is NOT certified").wait_for()
    discard(page)
    drag(page, "homogeneity degree", 0.3, 0.1)
    page.get_by_text(re.compile("chosen, not sent: arm_joint_3: mu -0.4")).wait_for()
    page.close()
    other = open_page()
    other.get_by_text("you have control").wait_for()
    assert server.nothing_more()
    discard(other)


def test_curves_are_drawn_from_frames_and_each_change_is_marked(open_page, server):
    page = open_page()
    page.set_viewport_size({"width": 800, "height": 950})  # a tablet
    page.emulate_media(color_scheme="dark")
    choose(page, 1, 2)
    page.wait_for_function(
        """() => {
            const counts = [["position", 4], ["error", 2], ["effort", 2], ["multiplier", 4]];
            return counts.every(([name, count]) => {
                const series = window.hpidLive.charts.get(name)?.getOption()?.series ?? [];
                return series.length === count && series.every((each) => each.data.length > 5);
            });
        }"""
    )
    assert page.evaluate("document.documentElement.scrollWidth") <= 800
    type_into(page, "homogeneity degree", -0.25)
    apply(page)
    assert server.next(2) == [(node, {"mu": -0.25}) for node in NODES[:2]]
    page.wait_for_function(
        """() => window.hpidLive.charts.get("error").getOption().series[0].markLine.data
            .some((each) => each.name === "mu -0.25")"""
    )


def test_marks_of_a_clock_that_went_back_are_forgotten(open_page):
    page = open_page()
    page.wait_for_function("window.hpidLive.frames > 5")
    kept = page.evaluate(
        """() => [[5, [4, 4.5]], [1, [0.5]], [2, []]].map(([now, times]) => {
            const marks = times.map((time) => ({ node: "n", time, text: "" }));
            window.hpidLive.take({ now: { n: now }, curves: {}, marks });
            return window.hpidLive.marks.filter((mark) => mark.node === "n").length;
        })"""
    )
    assert kept == [2, 1, 1]


def test_from_another_page_nothing_is_to_be_had(context, server):
    other = context.new_page()
    other.goto(server.url)  # this browser has the cookie now
    other.goto("data:text/html,<p>another page</p>")
    answer = other.evaluate(
        """async (root) => {
            const socket = new WebSocket(root.replace("http", "ws") + "frames?page=x");
            const opened = await new Promise((resolve) => {
                socket.onopen = () => resolve("open");
                socket.onclose = () => resolve("closed");
            });
            let said = "blocked";
            try {
                await fetch(root + "stop", { method: "POST", mode: "no-cors",
                                             credentials: "include" });
                said = "sent";
            } catch {}
            return [opened, said];
        }""",
        server.root,
    )
    other.close()
    assert answer[0] == "closed"
    assert server.nothing_more()


def test_the_button_is_held_by_the_first_button_alone_and_never_after_it(open_page):
    """A menu that a press opens takes the release away."""
    page = open_page()
    page.wait_for_function("window.hpidLive.frames > 5")
    # A page that NiceGUI has connected again is the same page.
    page.evaluate("window.firstSocket = window.hpidLive.socket; window.hpidLive.start('again')")
    assert page.evaluate("window.firstSocket === window.hpidLive.socket")
    held = page.evaluate(
        """() => {
            const live = window.hpidLive;
            const button = document.createElement("button");
            button.dataset.act = "hold";
            document.body.append(button);
            button.addEventListener("pointerdown", (event) => live.holdBy(event));
            const isHeld = [];
            const send = (name, more) => {
                const event = new PointerEvent(name, { bubbles: true, cancelable: true, ...more });
                const isPrevented = !button.dispatchEvent(event);
                isHeld.push(live.held !== null);
                return isPrevented;
            };
            send("pointerdown", { button: 2, buttons: 2 });
            send("pointerdown", { button: 0, buttons: 1, ctrlKey: true });
            send("pointerdown", { button: 0, buttons: 1 });
            send("pointermove", { buttons: 1 });
            isHeld.push(send("contextmenu", { pointerType: "touch" }));
            isHeld.push(send("contextmenu", {}));
            send("pointerdown", { button: 0, buttons: 1 });
            send("pointermove", { buttons: 0 });
            live.hold(button, false);
            send("pointermove", { buttons: 0 });
            live.release();
            button.remove();
            return isHeld;
        }"""
    )
    assert held == [False, False, True, True, True, True, False, True, True, False, True]


def test_when_the_server_is_gone_the_page_says_so(context, server):
    page = context.new_page()
    page.goto(server.url)
    page.wait_for_function("window.hpidLive.frames > 5")
    assert not page.locator(".lost-banner").is_visible()
    server.page.stop()  # the last test of this file
    page.locator(".lost-banner").wait_for(state="visible")
