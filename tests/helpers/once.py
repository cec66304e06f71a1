"""Expensive fixtures, made once for all processes of a test run."""

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
    """Return the result of `make`: the first process of this run that asks for `name` calls it, and pickles the result.

    Other processes wait meanwhile. The result is kept in the run's own temporary folder.
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
    """Hold a lock that one process has at a time; on Windows, without fcntl, there is none: each makes its own."""
    with lock.open("w") as file:
        with suppress(ImportError):
            fcntl = importlib.import_module("fcntl")
            fcntl.flock(file, fcntl.LOCK_EX)
        yield
