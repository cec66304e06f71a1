"""Standard streams, signals, and errors of the operating system."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from rigkit.cli.progress import end_bar
from rigkit.core.errors import IN_PYTHON

MAKE_ROOM, PATH = "make room or choose another folder", "correct the path"
SYSTEM_ERRORS = {
    getattr(errno, name): remedy
    for remedy, names in (
        (MAKE_ROOM, ("ENOSPC", "EDQUOT", "EROFS", "EACCES", "EPERM", "EIO", "EMFILE", "ENFILE")),
        (PATH, ("ENAMETOOLONG", "ELOOP")),
    )
    for name in names
    if hasattr(errno, name)
}
"""Errors of the system that are no bugs -> remedy: a full disk, a read-only folder, too many open files, a bad path."""


class Terminated(KeyboardInterrupt):
    """SIGTERM or SIGHUP, handled like Ctrl-C: partial results are removed."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


def say(words: str, *, before: str = "") -> None:
    """Print the last line of a run to stderr, if that is open."""
    end_bar(last=True)
    with contextlib.suppress(OSError, ValueError):
        print(f"{before}rigkit: {words.replace(IN_PYTHON, '')}", file=sys.stderr, flush=True)


def flush_stderr() -> None:
    """Flush stderr, or replace it if that fails: Python (up to 3.11.2) would otherwise exit with code 120."""
    try:
        sys.stderr.flush()
    except (OSError, ValueError):
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 - for the rest of the process


def open_streams() -> None:
    """Escape characters that the terminal cannot encode, and replace a missing stderr."""
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 - for the rest of the process
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


@contextmanager
def signals_interrupt() -> Iterator[None]:
    """Let SIGTERM and SIGHUP interrupt the block like Ctrl-C; an ignored signal (nohup) stays ignored."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise Terminated(number)

    taken = []
    if threading.current_thread() is threading.main_thread():
        # Windows has no SIGHUP.
        known = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
        taken = [n for n in known if signal.getsignal(n) is signal.SIG_DFL]
    for number in taken:
        signal.signal(number, stop)
    try:
        yield
    finally:
        for number in taken:
            signal.signal(number, signal.SIG_DFL)
