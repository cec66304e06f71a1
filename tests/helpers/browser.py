"""Pages in a real browser: a probe, a script at the end of the page, reports its results."""

from __future__ import annotations

import base64
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


def pages_printed(page: Path) -> int:
    """Return how many sheets of paper Chromium prints a page on."""
    sheets = page.with_suffix(".printed.pdf")
    command = [chromium(), *QUIET, f"--user-data-dir={page.with_suffix('.profile')}", f"--print-to-pdf={sheets}"]
    subprocess.run([*command, page.as_uri()], capture_output=True, timeout=120.0, check=True)
    return len(re.findall(rb"/Type /Page\s", sheets.read_bytes()))


def probed(text: str, folder: Path) -> list[str]:
    """Return the results of the probe in `document.body.dataset.probe`, split at its bars."""
    page = folder / "page.html"
    page.write_text(text, encoding="utf-8")
    reported = re.search(r'data-probe="([^"]*)"', loaded(page))
    assert reported is not None
    return reported[1].split("|")


MIN_FONT_PX = 11.0
"""Smaller words are hard to read on a phone."""
WIDTHS = (400, 768, 1366)
FRAMES = """<!doctype html><body><script>
const page = atob("%PAGE%"), widths = %WIDTHS%;
const text = new TextDecoder().decode(Uint8Array.from(page, (c) => c.charCodeAt(0)));
let left = widths.length;
const told = [];
for (const width of widths) {
  const frame = document.createElement("iframe");
  frame.style = `width: ${width}px; height: 900px; border: 0`;
  frame.srcdoc = text;
  frame.addEventListener("load", () => {
    const page = frame.contentDocument, scale = (e) => {
      const box = e.ownerSVGElement && e.ownerSVGElement.viewBox.baseVal;
      return box ? e.ownerSVGElement.getBoundingClientRect().width / box.width : 1;
    };
    const words = [...page.querySelectorAll("p, td, th, label, figcaption, svg text, button")]
      .filter((e) => e.textContent.trim() && e.getBoundingClientRect().width > 0);
    const size = (e) => parseFloat(frame.contentWindow.getComputedStyle(e).fontSize) * scale(e);
    const small = Math.min(...words.map(size));
    told.push([width, page.documentElement.scrollWidth, small.toFixed(2)].join(" "));
    if (--left === 0) document.body.dataset.probe = [...told, page.body.dataset.probe].join("|");
  });
  document.body.append(frame);
}
</script></body>"""


def probed_at_widths(page: str, folder: Path) -> tuple[dict[int, tuple[int, float]], list[str]]:
    """Return by width of the window how wide the page gets, and its smallest words, px; and the results of its own
    probe."""
    coded = base64.b64encode(page.encode()).decode()
    found_words = probed(FRAMES.replace("%PAGE%", coded).replace("%WIDTHS%", str(list(WIDTHS))), folder)
    rows = [text.split() for text in found_words[: len(WIDTHS)]]
    return {int(width): (int(wide), float(small)) for width, wide, small in rows}, found_words[len(WIDTHS) :]
