"""The certificate beside a running controller."""

import os
import signal
import subprocess
import sys
from contextlib import closing

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from harness.graph import Told
from harness.studies import children_of

from hpid_ros.control import LoopSettings
from hpid_ros.stability import certifier as certifiers
from hpid_ros.stability.certifier import Certifier

# Certified from -0.495 to +0.438, which takes a third of the time of most gains.
GAINS = {"gains__p": 5.0, "gains__i": 0.1, "gains__d": 2.0, "inertia": 1.0}
GAINS["norm__rate_weight"] = 1.0
SEARCH = 'import sys; sys.stdin.read(); print(\'{"lower": -0.05, "upper": 0.094}\')'


def settings(**changes):
    values = {"joint": "j", **GAINS, **changes}
    return LoopSettings.from_parameters({k.replace("__", "."): v for k, v in values.items()})


def test_finding_comes_later_and_then_serves_every_degree(monkeypatch):
    monkeypatch.setattr(certifiers, "_SEARCH", [sys.executable, "-c", SEARCH])
    with closing(Certifier()) as certifier:
        assert certifier.finding(settings(mu=0.05)) == (None, "being computed")
        assert certifier.wait(settings(mu=0.05)).is_certified
        assert certifier.finding(settings(mu=0.4)).is_certified is False
        assert certifier.finding(settings(mu=-0.04)).is_certified is True
        assert certifier.finding(settings(mu=0.05, gains__p=5.5)).is_certified is None
        certifier.want(settings(mu=0.05, gains__p=40.0))
        certifier.want(settings(mu=0.05, gains__p=50.0))  # the newest counts
        certifier.want(settings(mu=0.05, gains__p=60.0))
        assert certifier.wait(settings(mu=0.05, gains__p=60.0)).is_certified
        assert certifier.finding(settings(mu=0.05, gains__p=50.0)).is_certified is None
        found = certifier.wait(settings(mu=0.05, inertia=0.0))
    assert found == (None, "unknown: the inertia is not given")


def test_what_is_being_computed_ends_with_the_certifier():
    certifier, before = Certifier(), set(children_of())
    certifier.want(settings(mu=0.05))
    assert len(set(children_of()) - before) == 1
    certifier.close()
    assert set(children_of()) == before
    assert certifier.poll() is False


def test_running_loops_come_first_but_a_loop_that_waits_has_ordinary_priority(monkeypatch):
    begun = []

    def refused(command, **options):
        begun.append(command[:3])
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(subprocess, "Popen", refused)
    with closing(Certifier()) as certifier:
        certifier.wait(settings(mu=0.05))
        certifier.want(settings(mu=0.05, gains__p=40.0))
    assert begun == [["nice", "-n", "0"], ["nice", "-n", "19"]]


@pytest.mark.parametrize("failure", ["no child", "no answer"])
def test_a_computation_that_fails_is_a_finding_and_no_error(monkeypatch, failure):
    """The loop beside which it runs must not end for it."""

    def refused(*arguments, **options):
        raise BlockingIOError(11, "Resource temporarily unavailable")

    with closing(Certifier()) as certifier:
        before = set(children_of())
        if failure == "no child":
            monkeypatch.setattr(subprocess, "Popen", refused)
            certifier.want(settings(mu=0.05))
        else:
            certifier.want(settings(mu=0.05))
            (child,) = set(children_of()) - before
            os.kill(child, signal.SIGKILL)
            while not certifier.poll():
                pass
        found = certifier.finding(settings(mu=0.05))
    assert found.is_certified is False
    assert "computation" in found.text


def test_an_uncertified_degree_is_a_warning(harness):
    told = Told(harness)
    harness.start_controller(mu=0.4, state_watchdog=False, **GAINS | {"gains__i": 0.0})
    harness.ask(0, 0.0)
    line = "mu = 0.4 is not certified stable"
    harness.wait(lambda: line in told.newest().get("message", ""), what="the warning")
    assert told.newest()["level"] == DiagnosticStatus.WARN
    assert harness.set_parameters("elbow_controller", mu=0.0) == (True, "")
    harness.wait(
        lambda: told.says(level=DiagnosticStatus.OK) and "holding" in told.newest()["message"],
        what="the warning to go",
    )


def test_what_is_required_is_refused_until_it_is_certified(harness):
    harness.start_controller(mu=0.05, require_certificate=True, **GAINS)
    harness.ask(0, 0.0)
    is_set, reason = harness.set_parameters("elbow_controller", mu=0.45)
    assert not is_set
    assert "mu = 0.45 is not certified stable; certified degrees: -0.4" in reason
    assert harness.set_parameters("elbow_controller", mu=-0.04) == (True, "")
    is_set, reason = harness.set_parameters("elbow_controller", gains__p=6.0)
    assert (is_set, "being computed" in reason) == (False, True)
    harness.wait(
        lambda: harness.set_parameters("elbow_controller", gains__p=6.0)[0],
        what="the certificate of the new gains",
    )
    assert harness.set_parameters("elbow_controller", mu=0.15) == (True, "")
