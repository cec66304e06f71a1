"""The interface of progress callbacks. The command line draws progress on stderr."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """Called with the number of steps `done` of `total` in the stage `what`."""

    def __call__(self, what: str, done: int, total: int) -> None: ...


def silent(what: str, done: int, total: int) -> None:
    """Ignore progress."""
