"""Fixtures shared by all tests."""

from __future__ import annotations

import gc
import zlib
from pathlib import Path

import numpy as np
import pytest

THOROUGH = Path(__file__).with_name("thorough.txt")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark the tests of thorough.txt, which `./scripts/test` leaves out."""
    names = {line for line in THOROUGH.read_text(encoding="utf-8").splitlines() if not line.startswith("#")}
    for item in items:
        if item.nodeid in names:
            item.add_marker("thorough")
    if config.args_source is config.ArgsSource.TESTPATHS and (gone := names - {item.nodeid for item in items}):
        words = f"{THOROUGH.name} names tests that are not there: {', '.join(sorted(gone))}"
        config.issue_config_time_warning(pytest.PytestWarning(words), stacklevel=2)


def pytest_configure() -> None:
    """Collecting makes very many objects that stay: nobody looks for circles among them again and again."""
    gc.disable()


def pytest_collection_finish() -> None:
    """From here on memory is cleared as ever, of what comes now."""
    gc.freeze()
    gc.enable()


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
