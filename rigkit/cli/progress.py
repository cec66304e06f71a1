"""Progress on stderr: a bar on a terminal, lines elsewhere; a stage that takes long says so while it works."""

from __future__ import annotations

import sys
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, field

from rigkit.core.progress import Progress

REDRAW_S = 0.1
TICK_S = 1.0
"""Time after which the seconds beside a bar go on although no step is done."""
REPEAT_S = 5.0
"""Time after which a stage that goes on says how far it is where there is no terminal to draw a bar on."""
MIN_GROWTH = 1.5
"""Without a further step it says so again after this multiple of its time, so that a log does not fill."""
BAR_WIDTH = 24


def progress_on_stderr() -> Progress:
    """Return a progress callback: a bar on a terminal, elsewhere one line for each finished stage, and some between for
    those that take long."""
    global _shown
    _shown = _Display()
    return _shown


def end_bar(*, last: bool = False) -> None:
    """End the line of a bar that is not full, before other words; `last`: no more of it is drawn."""
    if _shown is not None:
        _shown.end_line(last=last)


@dataclass(eq=False, slots=True)
class _Stage:
    """A stage, its steps done and in all, and the time of its beginning and of the last words on it."""

    what: str
    total: int
    done: int = 0
    started: float = field(default_factory=lambda: time.monotonic())
    drawn: float = 0.0
    told: int = 0

    def words(self) -> str:
        """Return the line of the stage for a log."""
        spent = time.monotonic() - self.started
        if self.done >= self.total:
            return f"{self.what}: {self.done} done in {spent:.1f} s"
        return f"{self.what}: {self.done} of {self.total}" + (f" after {spent:.0f} s" if self.done == self.told else "")

    def bar(self) -> str:
        """Return the line of the stage for a terminal."""
        finished, spent = self.done >= self.total, time.monotonic() - self.started
        filled = BAR_WIDTH * self.done // max(self.total, 1)
        bar = "#" * filled + "." * (BAR_WIDTH - filled)
        end = f" {spent:.1f} s\n" if finished else f" {spent:.0f} s" if spent >= TICK_S else ""
        return f"\r{self.what:<36.36} [{bar}] {self.done}/{self.total}{end}"

    def is_due(self, terminal: bool) -> bool:
        """Return whether words are due although the stage is not finished."""
        now = time.monotonic()
        if terminal:
            return now - self.drawn >= (REDRAW_S if self.done > self.told else TICK_S)
        waited = now - max(self.drawn, self.started)
        moved = self.done > self.told
        return waited >= REPEAT_S and (moved or now - self.started >= MIN_GROWTH * (self.drawn - self.started))


class _Display:
    """The callback; a thread repeats the current stage while no step is done."""

    def __init__(self) -> None:
        self._stages: dict[str, _Stage] = {}
        self._lock = threading.Lock()
        self._stream = sys.stderr
        self._watched = self._bar_is_open = False

    def end_line(self, *, last: bool) -> None:
        with self._lock:
            if last:
                self._stages.clear()
            if self._bar_is_open:
                self._bar_is_open = False
                with suppress(OSError, ValueError):
                    print(file=self._stream, flush=True)

    def __call__(self, what: str, done: int, total: int) -> None:
        with self._lock:
            stage = self._stages.setdefault(what, _Stage(what, total))
            stage.done, stage.total = done, total
            if done >= total:
                self._draw(self._stages.pop(what))
            elif stage.is_due(self._is_terminal()):
                self._draw(stage)
            if self._stages and not self._watched:
                self._watched = True
                threading.Thread(target=self._watch, daemon=True).start()

    def _watch(self) -> None:
        # Where stderr is another one, what it was for has ended.
        while sys.stderr is self._stream and threading.main_thread().is_alive():
            time.sleep(REDRAW_S)
            with self._lock:
                stage = next(reversed(self._stages.values()), None)
                if stage is None:
                    self._watched = False
                    return
                if stage.is_due(self._is_terminal()):
                    self._draw(stage)

    def _is_terminal(self) -> bool:
        # A closed or full stderr must not stop the work.
        with suppress(OSError, ValueError):
            return self._stream.isatty()
        return False

    def _draw(self, stage: _Stage) -> None:
        terminal = self._is_terminal()
        with suppress(OSError, ValueError):
            print(
                stage.bar() if terminal else stage.words(), end="" if terminal else "\n", file=self._stream, flush=True
            )
        stage.drawn, stage.told = time.monotonic(), stage.done
        self._bar_is_open = terminal and stage.done < stage.total


_shown: _Display | None = None
"""The last one made; a run has one at a time."""
