"""Tests of pages that are skipped for want of a browser are told, and fail where one must be."""

import os
import subprocess
import sys

import pytest
from harness import browser
from harness.places import ROOT

REQUIRED = "HPID_BROWSER_REQUIRED"  # as .ci/run sets it
SKIPPED = "test/unit/report/test_report_in_browser.py"


def run(folder, *command, **variables):
    """Return the exit code of a command that finds no browser, and what it prints."""
    inherited = {name: text for name, text in os.environ.items() if name != REQUIRED}
    done = subprocess.run(
        [sys.executable, *command],
        cwd=ROOT,
        env={**inherited, "PATH": str(folder), **variables},
        capture_output=True,
        text=True,
        check=False,
    )
    return done.returncode, done.stdout


@pytest.mark.parametrize(("required", "code"), [({}, 0), ({REQUIRED: "1"}, 1)])
def test_tests_that_were_skipped_are_told_and_fail_in_ci(tmp_path, required, code):
    home = {"HOME": str(tmp_path), "PYTEST_ADDOPTS": ""}  # nor one that playwright has installed
    found, said = run(tmp_path, "-m", "pytest", "-q", SKIPPED, **home, **required)
    assert found == code, said
    assert f" {browser.LINE}\n" in said


def test_make_test_ends_with_what_to_install(tmp_path):
    assert run(tmp_path, "test/harness/browser.py") == (1, f"{browser.LINE}\n")
    fake = tmp_path / "chromium"
    for code in (1, 0):  # Ubuntu's package without its snap does not start
        fake.write_text(f"#!/bin/sh\nexit {code}\n")
        fake.chmod(0o755)
        assert run(tmp_path, "test/harness/browser.py")[0] == code
