"""What is dear to make, made once for all processes of a run of the tests."""

from __future__ import annotations

import importlib
import os
import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeVar

import pytest

Made = TypeVar("Made")


def once_a_run(factory: pytest.TempPathFactory, name: str, make: Callable[[], Made]) -> Made:
    """Return what `make` returns: the first process of this run that asks for `name` calls it, and pickles the result.

    A process that asks meanwhile waits. Nothing outlives the run: it lies in the run's own temporary folder.
    """
    folder = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    kept = folder / f"{name}.pickle"
    with _alone(folder / f"{name}.lock"):
        if not kept.exists():
            written = folder / f"{name}-{os.getpid()}.pickle"
            written.write_bytes(pickle.dumps(make()))
            written.replace(kept)
    found: Made = pickle.loads(kept.read_bytes())
    return found


@contextmanager
def _alone(lock: Path) -> Iterator[None]:
    """Only one process at a time is inside; on Windows, where files are locked otherwise, each makes its own."""
    with lock.open("w") as file:
        with suppress(ImportError):
            fcntl = importlib.import_module("fcntl")
            fcntl.flock(file, fcntl.LOCK_EX)
        yield
