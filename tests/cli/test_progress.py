"""Bars and lines of progress."""

from __future__ import annotations

import io
import logging
import sys
import time
from collections.abc import Callable

import pytest

from rigkit.cli import progress
from rigkit.cli.log import logging_to
from rigkit.cli.operating_system import say
from rigkit.cli.progress import progress_on_stderr


class Terminal(io.StringIO):
    """A stream that calls itself a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Return a function that sets the time; nothing goes on by itself."""
    at = [0.0]
    monkeypatch.setattr("rigkit.cli.progress.time.monotonic", lambda: at[0])
    monkeypatch.setattr("rigkit.cli.progress.threading.Thread.start", lambda thread: None)

    def set_to(seconds: float) -> None:
        at[0] = seconds

    return set_to


def test_a_long_stage_says_how_far_it_is_where_there_is_no_terminal(
    clock: Callable[[float], None], capsys: pytest.CaptureFixture[str]
) -> None:
    show = progress_on_stderr()
    for done, seconds in enumerate([0.0, 1.0, 6.0, 7.0, 12.0, 13.0]):
        clock(seconds)
        show("pairs", done, 5)
    assert capsys.readouterr().err.splitlines() == ["pairs: 2 of 5", "pairs: 4 of 5", "pairs: 5 done in 13.0 s"]


def test_a_stage_without_steps_says_how_long_it_takes_ever_more_seldom(
    clock: Callable[[float], None], capsys: pytest.CaptureFixture[str]
) -> None:
    show = progress_on_stderr()
    for seconds in range(31):
        clock(float(seconds))
        show("pairs", 0, 2)
    assert capsys.readouterr().err.splitlines() == [f"pairs: 0 of 2 after {k} s" for k in (5, 10, 15, 23)]


def test_time_goes_on_beside_a_bar_while_no_step_is_done(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "TICK_S", 0.01)
    monkeypatch.setattr(progress, "REDRAW_S", 0.01)
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    show = progress_on_stderr()
    show("pairs", 0, 2)
    until = time.monotonic() + 5.0
    while terminal.getvalue().count("0/2") < 3 and time.monotonic() < until:
        time.sleep(0.01)
    show("pairs", 2, 2)
    drawn = terminal.getvalue()
    assert drawn.count("0/2") >= 3 and drawn.endswith("s\n")


def test_other_words_begin_a_line_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    show = progress_on_stderr()
    with logging_to(verbose=False, log_file=None):
        show("pairs", 0, 2)
        words = "something to look at"
        logging.getLogger("rigkit.test").warning(words)
        show("pairs", 1, 2)
    say("interrupted")
    lines = terminal.getvalue().split("\n")
    assert words in lines and "rigkit: interrupted" in lines
