"""The live page on a real graph, as a person uses it: retuned, tried with two settings, left."""

import json
import re
import signal

import numpy as np
import pytest
from harness.browser import launched
from harness.graph import ros_arguments
from harness.turntable import GAINS, INERTIA, positions, start_turntable, wait_for_rest
from rcl_interfaces.srv import GetParameters

from hpid_bench.cli.main import main

expect = pytest.importorskip("playwright.sync_api", reason="pip install playwright").expect
expect.set_options(timeout=60_000)
pytestmark = pytest.mark.slow

LATE = 60_000  # [ms]
NODE = "turn_controller"
AGAIN = r"(, attempt \d+|, back to where the motion began)?"


@pytest.fixture(scope="module")
def harness(module_harness, tmp_path_factory):
    folder = tmp_path_factory.mktemp("turntable")
    start_turntable(module_harness, folder, pace=0.5, inertia=INERTIA, require_certificate=True)
    return module_harness


@pytest.fixture(scope="module")
def tuner(harness):
    """Return the page's process; beside other tests a browser may be late to say that it holds."""
    arguments = ros_arguments(port=0, open_browser=False, rate=10.0, button_timeout=2.0)
    return harness.processes.start("live_tuner", "live.live_tuner", arguments)


@pytest.fixture(scope="module")
def context(harness, tuner):
    """Return a browser that has opened the address once: it has the cookie."""
    events = []
    harness.wait(lambda: events.extend(tuner.read_events()) or events, what="the page")
    assert tuner.log.read_text().startswith(f"hpid live: {events[0]['url']}\n")
    with launched() as browser:
        context = browser.new_context(
            viewport={"width": 1300, "height": 1000}, base_url=events[0]["url"]
        )
        context.set_default_timeout(LATE)
        yield context


@pytest.fixture
def page(context):
    """Return the page of the turntable's controller, opened."""
    opened = context.new_page()
    opened.goto("")
    opened.get_by_role("checkbox", name="choose turn").wait_for()
    yield opened
    print(opened.locator("ul.log").inner_text())  # shown where a test fails
    opened.close()


def logged(page, text):
    page.get_by_role("listitem").filter(has_text=text).first.wait_for()


def type_into(page, name, value):
    page.get_by_role("spinbutton", name=re.compile(name)).fill(str(value))


def test_a_joint_is_tried_with_two_settings_of_which_one_is_kept(harness, page, capsys):
    page.get_by_role("button", name="hPID").click()
    # Above 0, so weaker than the PID close by: it has phase left where a machine is late.
    type_into(page, "homogeneity degree", 0.1)
    type_into(page, "effort scale", 0.5)
    page.get_by_text("certified stable for μ from").wait_for()
    assert positions(harness).std() < 1e-4  # nothing is sent by choosing

    page.get_by_role("tab", name="Try").click()
    type_into(page, re.escape("at most [rad or m]"), 0.2)
    type_into(page, re.escape("lasts [s]"), 2.0)
    page.get_by_role("button", name="Get ready").click()
    hold_until(page, "in force", "measuring")
    page.mouse.up()
    hold_until(page, "chosen", "measuring")
    page.mouse.up()
    row = page.get_by_role("row").filter(has_text="ITAE")
    before, after, ratio = (float(each) for each in row.inner_text().split("\t")[1:4])
    assert ratio == pytest.approx(after / before, rel=0.02)
    assert ratio > 0.0
    hpid, *command = page.locator(".command").first.inner_text().split()
    assert (hpid, main([*command, "--json"])) == ("hpid", 0)
    *_, begin, _, end = command  # the motion's: neither what was before it nor what came after
    assert float(end) - float(begin) == pytest.approx(2.0, abs=0.01)
    (run,) = json.loads(capsys.readouterr().out)["runs"].values()
    assert run["totals"]["itae"] == pytest.approx(before, rel=1e-3)
    page.get_by_role("button", name="keep in force").click()
    logged(page, "trial: kept, now in force: in force")

    while not is_let_go_in_the_middle_and_returns(harness, page):
        pass
    page.get_by_role("button", name="Cancel").click()
    logged(page, "trial: cancelled")


def is_let_go_in_the_middle_and_returns(harness, page):
    """Let go in the middle of a motion; return whether it goes back, and is prepared once more.

    On a busy machine the controller may be so late that the trial's own tolerance stops it.
    """
    log = page.get_by_role("listitem")
    stops = log.filter(has_text=re.compile("trial: stopped: turn is .* from its reference"))
    stopped = stops.count()
    page.get_by_role("button", name="Get ready").click()
    began = positions(harness)[-1]
    hold_until(page, "in force", "moving")
    harness.wait(lambda: abs(positions(harness)[-1] - began) > 0.05, what="the joint to move")
    page.mouse.up()
    logged(page, of_trial("in force", "stopped: the button was released"))
    assert abs(wait_for_rest(harness) - began) > 0.03
    hold_until(page, "in force, back to where the motion began", "moving")
    ready = said(page, "in force, attempt 2", "ready: let go, then hold the button")
    harness.wait(lambda: ready.count() or stops.count() > stopped, what="the way back")
    page.mouse.up()
    if not ready.count():
        wait_for_rest(harness)
        return False
    assert positions(harness)[-1] == pytest.approx(began, abs=5e-3)
    return True


@pytest.mark.faults
def test_stop_ends_what_is_ready_and_a_press_cannot_move_a_stopped_joint(harness, page):
    page.get_by_role("tab", name="Try").click()
    hold = hold_button(page)
    expect(hold).to_be_disabled()
    press_too_early(page)
    logged(page, "trial: not ready yet: let go, and press again when the button is green")
    assert positions(harness).std() < 1e-4
    page.mouse.up()
    page.get_by_text(re.compile("^in force: hold the button")).wait_for()
    expect(hold).to_be_enabled()

    page.keyboard.press("Escape")
    page.get_by_text(re.compile("^ended by Stop")).wait_for()
    expect(hold).to_be_disabled()
    page.get_by_role("button", name="activate turn", exact=True).wait_for()
    page.evaluate("setInterval(() => window.hpidLive.socket.send('hold'), 50)")  # all the same
    harness.wait(lambda: not harness.is_there("hpid_exciter"), what="the motion's end")
    page.get_by_text("turn is inactive: activate it first", exact=True).wait_for()
    expect(page.get_by_role("button", name="Get ready")).to_be_disabled()
    assert all(list(each.effort) == [0.0] for each in harness.heard_from_now(0.5))
    assert np.ptp(positions(harness)) < 1e-6  # it coasts as it stood: nothing drives or brakes it
    page.get_by_role("button", name="activate turn", exact=True).click()
    page.get_by_role("button", name="deactivate turn", exact=True).wait_for()
    assert positions(harness, 1.0).std() < 1e-4


def of_trial(label, text):
    """Return what the log has of a motion, or of another attempt at it."""
    return re.compile(rf"trial: {label}{AGAIN}: {text}")


def said(page, label, text):
    """Return where the page says of a motion how far it is."""
    return page.get_by_text(re.compile(rf"^{label}{AGAIN}: {text}"))


def hold_button(page):
    return page.get_by_role("button", name="hold to run, release to stop")


def press_too_early(page):
    """Have a motion prepared, and hold the button before it is ready."""
    while True:
        page.get_by_role("button", name="Get ready").click()
        said(page, "in force", "(preparing|hold the button)").wait_for()
        hold_button(page).hover()
        page.mouse.down()
        ignored = said(page, "in force", "ready: let go, then hold the button")
        ignored.or_(said(page, "in force", "moving")).first.wait_for()
        if ignored.count():
            return
        page.mouse.up()  # it was ready before the press came
        page.get_by_role("button", name="Cancel").click()
        logged(page, "trial: cancelled")


def hold_until(page, label, stage):
    """Hold the button when a motion is ready, until it is at a stage, and go on."""
    log = page.get_by_role("listitem").filter(has_text=of_trial(label, stage))
    reached = said(page, label, stage) if stage == "moving" else log
    lapsed = said(page, label, "ready: let go, then hold the button")
    while True:
        said(page, label, "hold the button").wait_for()
        expect(hold_button(page)).to_be_enabled()
        hold_button(page).hover()
        page.mouse.down()
        reached.or_(lapsed).first.wait_for()
        if reached.count():
            return
        page.mouse.up()


@pytest.mark.faults
def test_a_page_that_is_ended_during_a_trial_sets_back_what_was_tried(harness, tuner, page):
    before = GAINS["gains__p"]
    type_into(page, "proportional gain", before + 5.0)
    page.get_by_role("tab", name="Try").click()
    page.get_by_role("combobox", name="first with").click()
    page.get_by_role("option", name="what is chosen").click()
    page.get_by_role("button", name="Get ready").click()
    said(page, "chosen", "hold the button").wait_for()
    assert proportional_gain(harness) == before + 5.0
    hold_until(page, "chosen", "moving")
    tuner.process.send_signal(signal.SIGINT)  # Ctrl-C, while joints move
    harness.wait(lambda: tuner.process.poll() is not None, what="the page's end")
    assert tuner.process.returncode == 0
    is_told = "still in force" in tuner.log.read_text()  # in the time that it has at its end
    assert (proportional_gain(harness) == before) is not is_told
    wait_for_rest(harness)


def proportional_gain(harness):
    request = GetParameters.Request(names=["gains.p"])
    return harness.call(GetParameters, f"{NODE}/get_parameters", request).values[0].double_value
