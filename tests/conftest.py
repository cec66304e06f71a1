"""Fixtures shared by all tests."""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    """A generator seeded by the test's own name: fixed for the test, different from every other test's."""
    return np.random.default_rng(zlib.crc32(request.node.name.encode()))


@pytest.fixture(scope="session")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with left01.jpg, right01.jpg, ... of `helpers.stereo_pictures`, to read, not to write."""
    from helpers.stereo_pictures import write_pictures

    folder = tmp_path_factory.mktemp("pictures")
    write_pictures(folder)
    return folder


@pytest.fixture(autouse=True)
def one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands start no processes of their own unless a test asks for some (-j 2): each costs seconds of imports."""
    monkeypatch.setattr("os.cpu_count", lambda: 1)
