"""A page in a real browser that a test reads and types into: the DevTools protocol over a pipe."""

from __future__ import annotations

import base64
import json
import os
import select
import subprocess
import time
from pathlib import Path
from typing import Any

from helpers.browser import chromium

PATIENCE_S = 60.0
"""Timeout for one answer of the browser."""


class DrivenPage:
    """A page at an address; `complaints` are its console messages and uncaught errors."""

    def __init__(
        self, url: str, profile: Path, *options: str, size_px: tuple[int, int] = (1366, 900), before: str = ""
    ) -> None:
        """Open the page; the script `before` runs before its own."""
        to_browser, self._write = os.pipe()
        self._read, from_browser = os.pipe()
        command = [
            chromium(), "--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", "--mute-audio",
            "--remote-debugging-pipe", f"--user-data-dir={profile}", f"--window-size={size_px[0]},{size_px[1]}",
            *options, "about:blank",
        ]  # fmt: skip
        # The browser reads commands from file descriptor 3 and writes answers to 4.
        shell = f'exec "$@" 3<&{to_browser} 4>&{from_browser}'
        self._process = subprocess.Popen(
            ["bash", "-c", shell, "chromium", *command],
            pass_fds=(to_browser, from_browser),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(to_browser)
        os.close(from_browser)
        self.complaints: list[str] = []
        self._rest, self._count = b"", 0
        self._session: str | None = None
        pages = [t for t in self._ask("Target.getTargets")["targetInfos"] if t["type"] == "page"]
        reported = self._ask("Target.attachToTarget", targetId=pages[0]["targetId"], flatten=True)
        self._session = reported["sessionId"]
        self._ask("Runtime.enable")
        self._ask("Log.enable")
        self._ask("Page.enable")
        if before:
            self._ask("Page.addScriptToEvaluateOnNewDocument", source=before)
        self._ask("Page.navigate", url=url)

    def evaluate(self, script: str) -> Any:
        """Return the value of an expression in the page."""
        return self._ask("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def wait(self, script: str, seconds: float) -> Any:
        """Return the value of an expression as soon as it is true."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            value = self.evaluate(script)
            if value:
                return value
            time.sleep(0.1)
        raise AssertionError(
            f"not within {seconds} s: {script}; the page says {self.evaluate('document.body.innerText')}"
        )

    def press(self, key: str) -> None:
        """Press and release a key that types a character."""
        for kind in ("keyDown", "keyUp"):
            self._ask("Input.dispatchKeyEvent", type=kind, key=key, text=key if kind == "keyDown" else "")

    def picture(self, path: Path) -> None:
        """Write a screenshot, as PNG."""
        path.write_bytes(base64.b64decode(self._ask("Page.captureScreenshot")["data"]))

    def close(self) -> None:
        """Kill the browser."""
        self._process.kill()
        self._process.wait()
        os.close(self._read)
        os.close(self._write)

    def _ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._count += 1
        asked = {"id": self._count, "method": method, "params": parameters}
        if self._session is not None:
            asked["sessionId"] = self._session
        os.write(self._write, json.dumps(asked).encode() + b"\0")
        while True:
            printed = self._next()
            if printed.get("id") == self._count:
                assert "error" not in printed, printed
                result: dict[str, Any] = printed["result"]
                return result
            if printed.get("method") in ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded"):
                self.complaints.append(json.dumps(printed["params"])[:500])

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            ready, _, _ = select.select([self._read], [], [], PATIENCE_S)
            assert ready, "the browser says nothing"
            more = os.read(self._read, 1 << 20)
            assert more, "the browser has ended"
            self._rest += more
        one, self._rest = self._rest.split(b"\0", 1)
        reported: dict[str, Any] = json.loads(one)
        return reported
