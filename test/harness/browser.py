"""A real browser for pages: Chromium of the distribution, driven by playwright from PyPI.

As a program it says in a line if there is none, for ``make test`` and CI.
"""

import shutil
import subprocess
import sys
from contextlib import contextmanager

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
MISSING = "no browser"
"""What the reason of a skipped test begins with that has found none."""
LINE = "tests of pages in a browser are skipped: no Chromium (Debian: apt install chromium)"


def found():
    """Return the path of a browser; None if there is none."""
    return next(filter(None, map(shutil.which, BROWSERS)), None)


@contextmanager
def launched():
    """Give a browser; skip the test where there is none."""
    import pytest

    playwright = pytest.importorskip("playwright.sync_api", reason="pip install playwright")
    with playwright.sync_playwright() as driver:
        try:
            browser = driver.chromium.launch(executable_path=found(), args=["--no-sandbox"])
        except playwright.Error as error:
            pytest.skip(f"{MISSING} ({error.message.splitlines()[0]}): apt install chromium")
        yield browser
        browser.close()


def main():
    """Return whether no browser starts; Ubuntu's package may be one that needs a snap."""
    path = found()
    starts = (
        path is not None
        and not subprocess.run(
            [path, "--version"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False
        ).returncode
    )
    if not starts:
        print(LINE)
    return int(not starts)


if __name__ == "__main__":
    sys.exit(main())
