"""Handlers of the library's log: notes to stderr, with -v also details; with --log-file everything to a file."""

from __future__ import annotations

import argparse
import logging
import re
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TextIO

from rigkit.cli.console import file_path
from rigkit.cli.progress import end_bar
from rigkit.core.errors import InputError, printable
from rigkit.io.disk.reading import usable_path

FORMAT = "%(asctime)s %(levelname)s %(name)s: %(message)s"
LINE = re.compile(rb"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} [A-Z]+ rigkit")
"""Start of a log file of rigkit."""


def add_log_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the log arguments of every verb."""
    group = parser.add_argument_group("log")
    group.add_argument("-v", "--verbose", action="store_true", help="log each step to stderr")
    group.add_argument("--log-file", type=file_path, metavar="FILE", help="append this log, with times, to FILE")


def _appending(path: Path) -> logging.Handler:
    """Return a handler that appends to a file; raises InputError if it is no log of rigkit, or cannot be written."""
    usable_path(path)
    try:
        if path.exists() and not path.is_file():
            raise InputError(f"--log-file '{path}' is no regular file; choose another name")
        if path.exists():
            with path.open("rb") as stream:
                head = stream.read(64)
            if head and not LINE.match(head):
                raise InputError(f"--log-file '{path}' is no log of rigkit and stays as it is; choose another name")
        kept = _InFile(path, encoding="utf-8", errors="backslashreplace")
    except OSError as error:
        raise InputError(f"--log-file '{path}': {error.strerror}; choose another file") from error
    kept.setFormatter(logging.Formatter(FORMAT))
    return kept


class _InFile(logging.FileHandler):
    """Appends to a file; if the disk is full, it says so once and does not stop the work."""

    given = False

    def handleError(self, record: logging.LogRecord) -> None:
        if not self.given:
            self.given = True
            with suppress(OSError, ValueError):
                print(f"--log-file '{self.baseFilename}' cannot grow: the log ends here", file=sys.stderr)

    def close(self) -> None:
        with suppress(OSError):
            super().close()


class _OnStderr(logging.Handler):
    """Writes to the current `sys.stderr`, and each warning once a run: a damaged file may be read several times. A
    stderr that is closed loses notes, not results."""

    def __init__(self, level: int) -> None:
        super().__init__(level)
        self._warnings: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno == logging.WARNING:
            if record.getMessage() in self._warnings:
                return
            self._warnings.add(record.getMessage())
        end_bar()
        try:
            print("\n".join(map(printable, self.format(record).split("\n"))), file=sys.stderr)
        except (OSError, ValueError):
            return


def _noted(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    logging.getLogger("rigkit.warnings").debug("%s: %s (%s:%d)", category.__name__, message, filename, lineno)


@contextmanager
def logging_to(*, verbose: bool, log_file: Path | None) -> Iterator[None]:
    """Send the log of the package to stderr (with details if `verbose`) and to `log_file` within the block.

    Python's warnings, such as numpy's about invalid values, count as details. Raises InputError if the file cannot be
    written.
    """
    root = logging.getLogger("rigkit")
    terminal = _OnStderr(logging.DEBUG if verbose else logging.INFO)
    handlers: list[logging.Handler] = [terminal]
    if log_file is not None:
        handlers.append(_appending(log_file))
    before = root.level
    root.setLevel(logging.DEBUG if verbose or log_file is not None else logging.INFO)
    for handler in handlers:
        root.addHandler(handler)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _noted
            yield
    finally:
        root.setLevel(before)
        for handler in handlers:
            root.removeHandler(handler)
            handler.close()


def logged_run(args: argparse.Namespace) -> int:
    """Run the verb, and log its options and any exception."""
    log = logging.getLogger(__name__)
    log.debug("rigkit %s: %s", args.verb, {k: v for k, v in vars(args).items() if k not in ("verb", "run")})
    try:
        return int(args.run(args))
    except BaseException:
        log.debug("ended by", exc_info=True)
        raise
