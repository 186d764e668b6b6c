"""A live page of simulated joints in a process of its own: NiceGUI serves one in a process."""

import os
import subprocess
import sys
from urllib.parse import parse_qs, urlsplit

from harness.places import ROOT

_SERVE = """
import sys, time
from harness.simulated_graph import SimulatedGraph, arm, loop_settings
from hpid_bench.live.page.server import PageServer

{program}

page = PageServer(graph, port=0)
print(page.url, flush=True)
sys.stdin.read()
page.stop()
"""


class PageProcess:
    """Serves the page of what a program calls ``graph``, until it is closed."""

    def __init__(self, program, limits=""):
        python = sys.executable, "-c", _SERVE.format(program=program)
        self.process = subprocess.Popen(
            ["bash", "-c", f'{limits} exec "$@"', "-", *python],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": f"{ROOT / 'test'}:{ROOT}"},
        )
        self.url = self.line()
        address = urlsplit(self.url)
        self.place = address.hostname, address.port
        (token,) = parse_qs(address.query)["token"]
        self.headers = {
            "Cookie": f"hpid_live_{address.port}={token}",
            "Origin": f"http://{address.netloc}",
        }

    def line(self):
        """Return the next line that it prints."""
        return self.process.stdout.readline().strip()

    def close(self):
        self.process.stdin.close()
        self.process.wait(30.0)
        self.process.stdout.close()
