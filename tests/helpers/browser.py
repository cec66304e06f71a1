"""Pages in a real browser: a probe, a script at the end of the page, reports its results."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

QUIET = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--enable-logging=stderr",
    "--virtual-time-budget=3000",
    "--window-size=1366,900",
]


def chromium() -> str:
    """Return Chromium's command; skips the test where it is not installed."""
    for name in ("chromium", "chromium-browser", "google-chrome"):
        found = shutil.which(name)
        if found:
            return found
    pytest.skip("no Chromium on this machine (apt-get install chromium)")


def loaded(page: Path, *options: str, seconds: float = 120.0) -> str:
    """Return the HTML of a page after its scripts have run; fails on any console output."""
    profile = f"--user-data-dir={page.with_suffix('.profile')}"
    command = [chromium(), *QUIET, *options, profile, "--dump-dom", page.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=seconds, check=True)
    assert "CONSOLE" not in done.stderr, [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    return done.stdout


def probed(text: str, folder: Path) -> list[str]:
    """Return the results of the probe in `document.body.dataset.probe`, split at its bars."""
    page = folder / "page.html"
    page.write_text(text, encoding="utf-8")
    reported = re.search(r'data-probe="([^"]*)"', loaded(page))
    assert reported is not None
    return reported[1].split("|")
