"""What others call their joints and snapshots stays text in the operator's browser.

Needs Chromium (Debian: ``apt install chromium``) and playwright from PyPI; skipped without them.
"""

import ast

import pytest
from harness.browser import launched
from harness.page_process import PageProcess
from harness.places import ROOT

from hpid_bench.live.session import name_shown

pytestmark = pytest.mark.slow

LATE = 60_000  # [ms]
RUN = "window.isRun=1"
NAMES = [
    f'j" :data-x="{RUN}',
    f"j' :style='{RUN}",
    f"j :onclick={RUN} onclick={RUN} :class={RUN}",
    f"<script>{RUN}</script>",
    f'<img src=x onerror="{RUN}">',
    "{{ constructor.constructor('window.isRun=1')() }}",
    "${window.isRun=1} `${window.isRun=1}`",
    'two\nlines\r\n\u2028 and "more\\',
    "\u202eright to left\u202c \u05d0\u05d1",
    "l" * 300,
    "{a|rich} {value} %s %(name)s",
]
NODES = [f"/hostile_{number:02}_controller" for number in range(len(NAMES))]


JOINTS = dict(zip(NODES, NAMES, strict=True))
HOSTILE = f"""
from dataclasses import replace

class Hostile(SimulatedGraph):
    def watch(self, nodes):
        super().watch(nodes[:2])  # to simulate all of them takes its time

    def controllers(self):  # which send the same as texts
        return {{
            node: replace(each, health=each.health._replace(message=each.joint))
            for node, each in super().controllers().items()
        }}

graph = Hostile({{node: loop_settings(name) for node, name in {JOINTS!r}.items()}})
"""


@pytest.fixture(scope="module")
def served():
    server = PageProcess(HOSTILE)
    yield server
    server.close()


@pytest.fixture
def wrong():
    """Return what the browser has said of errors; a test that wants some takes them out."""
    return []


@pytest.fixture
def page(served, wrong, tmp_path):
    """Return the page, opened, which fails the test on any error or script that ran."""
    with launched() as browser:
        page = browser.new_page(viewport={"width": 1300, "height": 1400})
        page.set_default_timeout(LATE)
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("console", lambda said: said.type == "error" and wrong.append(said.text))
        page.on("dialog", lambda dialog: wrong.append(dialog.message))
        page.goto(served.url)
        page.locator(".joints tbody tr").nth(len(NAMES) - 1).wait_for()
        yield page
        page.screenshot(path=tmp_path / "page.png")
        assert page.evaluate("window.isRun") is None
    assert wrong == []


def frames(page, count):
    page.wait_for_function(
        "(until) => window.hpidLive.frames > until",
        arg=page.evaluate("window.hpidLive.frames") + count,
    )


def logged(page, text):
    page.locator(".log").get_by_text(text).first.wait_for()


def attributes(page, selector):
    """Return the names of all attributes below a selector."""
    return set(
        page.evaluate(
            """(selector) => [...document.querySelectorAll(`${selector} *`)]
                .flatMap((each) => each.getAttributeNames())""",
            selector,
        )
    )


def test_names_of_joints_and_snapshots_are_shown_and_never_run(page):
    frames(page, 20)  # several times each row is refreshed
    assert page.locator(".joints tbody tr").count() == len(NAMES)
    for name in NAMES[:7]:
        label = f"choose {name_shown(name)}"
        assert page.get_by_role("checkbox", name=label, exact=True).count() == 1
    shown = page.locator(".joint-name").all_inner_texts()
    assert shown[3].strip() == f"<script>{RUN}</script>"
    assert r'two\nlines\r\n\u2028 and "more' in shown[7]
    assert r"\u202e" in shown[8]
    assert len(shown[9]) < 100
    assert not {"data-x", "onclick", "onerror", "src"} & attributes(page, ".joints")
    page.get_by_role("button", name="choose all joints").click()
    page.get_by_role("spinbutton", name="homogeneity degree").fill("-0.1")
    page.get_by_text("chosen, not sent").wait_for()
    page.get_by_role("button", name="Apply", exact=True).click()
    logged(page, "mu -0.1")
    page.get_by_role("tab", name="Save").click()
    for name in NAMES[:4]:
        page.get_by_role("textbox", name="name of the snapshot").fill(name)
        page.get_by_role("button", name="Keep what is in force").click()
        logged(page, f"snapshot {name} of")
    page.get_by_role("tab", name="Try").click()
    page.get_by_role("combobox", name="first with").click()
    page.get_by_role("option", name=f"snapshot {NAMES[0]}").click()
    page.locator(".joint-name .nicegui-label, .joint-name > div").first.hover()
    page.locator(".state").first.hover()
    box = page.locator(".chart").first.bounding_box()
    page.mouse.move(box["x"] + 0.8 * box["width"], box["y"] + 0.5 * box["height"])
    frames(page, 5)
    assert not {"data-x", "onclick", "onerror"} & attributes(page, "body")
    width = page.evaluate("document.documentElement.scrollWidth")
    assert width <= 1300


def test_a_script_that_got_onto_the_page_would_not_run(page, wrong):
    """What is left: NiceGUI evaluates what its own server sends."""
    blocked = page.evaluate(
        """() => new Promise((resolve) => {
            const blocked = [];
            document.addEventListener("securitypolicyviolation", (event) => {
                blocked.push(event.violatedDirective);
                if (blocked.length === 2) resolve(blocked.sort());
            });
            const script = document.createElement("script");
            script.textContent = "window.isRun = 1";
            document.body.append(script);
            const element = document.createElement("div");
            element.innerHTML = '<b onclick="window.isRun = 1">b</b>';
            document.body.append(element);
            element.firstChild.click();
        })"""
    )
    assert blocked == ["script-src-attr", "script-src-elem"]
    assert len(wrong) == 2
    assert all("Content Security Policy" in each for each in wrong)
    wrong.clear()


def test_what_is_parsed_for_properties_and_markup_is_written_here():
    """NiceGUI parses the text of props(), classes() and style(); markup is not made at all."""
    for path in sorted((ROOT / "hpid_bench" / "live" / "page").glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)):
                continue
            name, where = node.func.attr, f"{path.name}:{node.lineno}"
            assert name not in ("html", "markdown", "add_slot", "mermaid"), where
            if name == "props":
                parts = [part for each in node.args for part in ast.walk(each)]
                assert not any(isinstance(part, ast.JoinedStr) for part in parts), where
