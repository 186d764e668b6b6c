"""The process that serves the live page: found by its address, ended without a trace."""

import signal
import subprocess
import sys
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import HTTPCookieProcessor, build_opener, urlopen

import pytest
from harness.fork_server import run_node
from harness.graph import ros_arguments


def test_the_page_is_served_to_whoever_has_the_token_and_ends_without_a_trace(harness):
    harness.start_controller()
    arguments = ros_arguments(port=0, open_browser=False)
    process = harness.processes.start("live_tuner", "live.live_tuner", arguments)
    events = []
    harness.wait(lambda: events.extend(process.read_events()) or events, what="the page")
    url = events[0]["url"]
    with build_opener(HTTPCookieProcessor()).open(url, timeout=20.0) as answer:
        assert answer.status == 200
    parts = urlsplit(url)
    assert parts.hostname == "127.0.0.1"
    with pytest.raises(HTTPError):
        urlopen(f"http://{parts.netloc}/", timeout=20.0)
    assert process.log.read_text().splitlines()[0] == f"hpid live: {url}"
    process.process.send_signal(signal.SIGINT)
    assert process.process.wait(20.0) == 0
    harness.publish(10**9, 0.1)
    harness.wait(lambda: harness.commands, what="the controller to go on")


@pytest.mark.parametrize("arguments", [{"rate": 200.0}, {"host": "0.0.0.0"}])
def test_what_cannot_be_served_is_one_line(harness, arguments):
    ended = run_node("live.live_tuner", ros_arguments(open_browser=False, **arguments))
    assert ended.returncode == 2
    assert ended.stderr.startswith(*arguments)
    assert ended.stderr.count("\n") == 1


def test_a_missing_library_is_named():
    program = (
        "import sys; sys.modules['nicegui'] = sys.modules['uvicorn'] = None\n"
        "from hpid_ros.live.live_tuner import main; main(['live_tuner'])"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert ended.returncode == 2
    assert "pip install 'hpid_ros[live]'" in ended.stderr
    assert ended.stderr.count("\n") == 1
