"""Progress as the core sees it: something that is told how far the work is. The command line draws it on stderr."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """Told `done` of `total` steps of the stage called `what`."""

    def __call__(self, what: str, done: int, total: int) -> None: ...


def silent(what: str, done: int, total: int) -> None:
    """Say nothing."""
