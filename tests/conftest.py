"""Fixtures shared by all tests."""

from __future__ import annotations

import contextlib
import gc
import importlib
import sys
import types
import zlib
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

if TYPE_CHECKING:
    from rigkit import Calibration

ROOT = Path(__file__).resolve().parents[1]
THOROUGH = Path(__file__).with_name("thorough.txt")
LEFT_OUT = {line for line in THOROUGH.read_text(encoding="utf-8").splitlines() if not line.startswith("#")}
"""Ids of tests, functions with all their parameters, or names of files with all their tests."""
NOT_MADE: set[str] = set()
"""Functions of which no test is made."""


def is_quick(config: pytest.Config) -> bool:
    return "not thorough" in config.getoption("markexpr")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Skip the import of files that the quick run leaves out completely."""
    quick = is_quick(config) and collection_path.is_relative_to(ROOT)
    return True if quick and collection_path.relative_to(ROOT).as_posix() in LEFT_OUT else None


def pytest_pycollect_makeitem(collector: pytest.Collector, name: str) -> list[pytest.Item] | None:
    """Make no tests of functions that the quick run leaves out: a quarter of all."""
    function = f"{collector.nodeid}::{name}"
    if function not in LEFT_OUT or not is_quick(collector.config):
        return None
    NOT_MADE.add(function)
    return []


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark the tests of thorough.txt, which `./scripts/test` leaves out."""
    there = NOT_MADE | {name for name in LEFT_OUT if (ROOT / name).is_file()}
    for item in items:
        names = {item.nodeid, item.nodeid.partition("[")[0], item.nodeid.partition("::")[0]}
        there |= names
        if not LEFT_OUT.isdisjoint(names):
            item.add_marker("thorough")
    whole = config.args_source is config.ArgsSource.TESTPATHS and not config.getoption("lf", False)
    if whole and (gone := LEFT_OUT - there):
        words = f"{THOROUGH.name} names tests that are not there: {', '.join(sorted(gone))}"
        config.issue_config_time_warning(pytest.PytestWarning(words), stacklevel=2)


def pytest_collection(session: pytest.Session) -> None:
    """Import the last file first in the second of two processes: code that one has compiled is cached for the other."""
    if getattr(session.config, "workerinput", {}).get("workerid") == "gw1":
        files = (file.resolve() for name in session.config.args for file in Path(name).rglob("test_*.py"))
        for file in sorted(files, reverse=True):
            if pytest_ignore_collect(file, session.config) is None:
                with contextlib.suppress(Exception, pytest.skip.Exception):
                    importlib.import_module(".".join(file.relative_to(ROOT).with_suffix("").parts))


def pytest_configure() -> None:
    """Switch garbage collection off while tests are collected: the many new objects stay, so each pass is wasted.

    Open3D imports Dash for drawings in a browser, which no test makes: 1.0 of its 1.7 s in each process.
    """
    gc.disable()
    dash = types.ModuleType("dash")
    vars(dash).update(dcc=None, html=None, Dash=None)
    sys.modules.setdefault("dash", dash)


def pytest_collection_finish() -> None:
    """Switch garbage collection on again, for objects created from now on; more seldom, which saves 3 % of the time."""
    gc.freeze()
    gc.enable()
    gc.set_threshold(20_000)


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    """A generator seeded by the test's own name: fixed for the test, different from every other test's."""
    return np.random.default_rng(zlib.crc32(request.node.name.encode()))


@pytest.fixture(scope="session")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with left01.jpg, right01.jpg, ... of `helpers.stereo_pictures`; read-only."""
    from helpers.stereo_pictures import write_pictures

    folder = tmp_path_factory.mktemp("pictures")
    write_pictures(folder)
    return folder


@pytest.fixture(scope="session")
def calibration() -> Calibration:
    """The calibration of the lens "reg" from 14 views of boards (SIMULATED)."""
    from helpers.monitoring_scenes import calibrated_lens

    return calibrated_lens()


@pytest.fixture(autouse=True)
def one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands start no worker processes unless a test asks for them (-j 2): each costs seconds of imports."""
    monkeypatch.setattr("os.cpu_count", lambda: 1)


BESIDES = ("cli", "coach", "fuzz", "workflows")
"""Folders of tests in which plans, choices of a lens model and pictures are made, but not what is tested."""
LESS: dict[str, object] = {
    # Plans choose among a third of the poses: how well they choose is for tests/planning and tests/validation.
    "rigkit.planning.candidates.CANDIDATES_DRAWN": 800,
    "rigkit.planning.candidates.CANDIDATES_KEPT": 300,
    "rigkit.validation.monitoring.frames.CANDIDATES_KEPT": 300,
    # Of each lens model one size is tried: tests/calibration/choosing is about the choice.
    "rigkit.calibration.choosing.models_tried.DEGREES_TRIED": {"scaramuzza": (6,), "brown": (5,)},
    "rigkit.calibration.choosing.models_tried.DEGREES_BEYOND": {"scaramuzza": (8,)},
    # A fifth of the pixels: tests/report looks at pictures.
    "rigkit.report.pictures.figures.DPI": 50,
    "rigkit.report.pages.certificate_page.DPI": 50,
    "rigkit.report.pages.page_facts.in_dark_colours": lambda draw: b"",
}
"""What is done less in these."""


@pytest.fixture(autouse=True)
def less_work(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.path.is_relative_to(ROOT) and request.path.relative_to(ROOT).parts[1] in BESIDES:
        # All before the first is changed: a module first imported after that would keep the changed value of another.
        for name in LESS:
            importlib.import_module(name.rpartition(".")[0])
        for name, value in LESS.items():
            monkeypatch.setattr(name, value)
