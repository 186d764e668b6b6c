"""The live page under connections that never send a token: who has it can always stop."""

import http.client
import os
import resource
import selectors
import socket
import threading
import time
from contextlib import closing, contextmanager, suppress

import pytest
from harness.browser import launched
from harness.page_process import PageProcess

HALF_OPEN = 2000
WITHIN = 1.0  # [s] until a controller is asked to stop, on a machine that has time
RENEWED = 1000  # connections a second
pytestmark = pytest.mark.alone

LATE = 60_000  # [ms]
PARTS = [b"", b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: ", b"POST /stop HTTP/1.1\r\n"]

TOLD = """
class Told(SimulatedGraph):
    def change_state(self, node, transition):
        print(transition, time.monotonic(), flush=True)
        return super().change_state(node, transition)

graph = Told(arm(1))
"""


@pytest.fixture(autouse=True)
def enough_descriptors():
    """Let this process open its side of the connections."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < 2 * HALF_OPEN:
        pytest.skip(f"this process may open {hard} files only")
    resource.setrlimit(resource.RLIMIT_NOFILE, (2 * HALF_OPEN, hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def longest():
    """Return how long a stop may take; others may have more to do here than there are cores."""
    return WITHIN * max(1.0, os.getloadavg()[0] / os.cpu_count())


def asked_at(served):
    """Return when a controller is asked to stop, on the clock of all processes."""
    what, at = served.line().split()
    assert what == "deactivate"
    return float(at)


def stop(served):
    """Return what the server answers to a stop of one who has the token."""
    with closing(http.client.HTTPConnection(*served.place, timeout=60.0)) as connection:
        connection.request("POST", "/stop", headers=served.headers)
        return connection.getresponse().read()


@pytest.fixture(params=["ulimit -Sn 1024;", "ulimit -n 1024;"], ids=["soft limit", "hard limit"])
def served(request):
    server = PageProcess(TOLD, request.param)
    yield server
    server.close()


class Flood:
    """Connections that are half open; one that is dropped comes again."""

    def __init__(self, place):
        self._place = place
        self._selector = selectors.DefaultSelector()
        self._is_on = True
        self.dropped = self._may_open = 0
        for number in range(HALF_OPEN):
            self._open(number)
        self._thread = threading.Thread(target=self._renew)
        self._thread.start()

    def _open(self, number):
        made = socket.socket()
        made.setblocking(False)
        made.connect_ex(self._place)
        self._selector.register(made, selectors.EVENT_WRITE, number)

    def _renew(self):
        while self._is_on:
            self._wait()
            for key, events in self._selector.select(0.05):
                made, number = key.fileobj, key.data
                if events & selectors.EVENT_WRITE:
                    with suppress(OSError):  # it is dropped already
                        made.send(PARTS[number % len(PARTS)])
                    self._selector.modify(made, selectors.EVENT_READ, number)
                elif self._may_open > 0:  # dropped, or answered
                    self._may_open -= 1
                    self.dropped += 1
                    self._selector.unregister(made)
                    made.close()
                    self._open(number)

    def _wait(self):
        """Wait so long that no more than so many are opened again in a second."""
        time.sleep(0.02)
        self._may_open = RENEWED * 0.02

    def close(self):
        self._is_on = False
        self._thread.join()
        for key in list(self._selector.get_map().values()):
            key.fileobj.close()
        self._selector.close()


@contextmanager
def flood(served):
    made = Flood(served.place)
    try:
        yield made
    finally:
        made.close()


def test_a_page_is_stopped_within_a_second_under_half_open_connections(served, faults):
    took = []
    with flood(served) as made:
        until = time.monotonic() + 3.0
        while time.monotonic() < until:
            begun = time.monotonic()
            assert stop(served) == b'{"stopped":true}'
            took.append(asked_at(served) - begun)
        dropped = made.dropped
    print(f"{len(took)} stops, {max(took):.3f} s the slowest, {dropped} connections dropped")
    faults.count("half-open connections to the live page", HALF_OPEN + dropped)
    assert max(took) < longest()


def test_a_page_that_is_open_stops_under_the_same(served):
    with launched() as browser:
        page = browser.new_page()
        page.set_default_timeout(LATE)
        page.goto(served.url)
        page.wait_for_function("window.hpidLive.frames > 5")
        with flood(served):
            page.wait_for_function("window.hpidLive.frames > 20")
            begun = time.monotonic()
            page.keyboard.press("Escape")
            assert asked_at(served) - begun < longest()
            page.get_by_text("inactive").first.wait_for()
        assert not page.locator(".stop-banner").is_visible()
