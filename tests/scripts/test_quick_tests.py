"""`quick_tests.py` leaves out no test that reaches lines which the others do not."""

from __future__ import annotations

import importlib
from types import ModuleType

import numpy as np
import pytest
from helpers.data import REPOSITORY


@pytest.fixture
def chooser(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    pytest.importorskip("coverage")
    monkeypatch.syspath_prepend(str(REPOSITORY / "scripts"))
    return importlib.import_module("quick_tests")


def test_expensive_tests_are_left_out_where_others_reach_their_lines(chooser: ModuleType) -> None:
    # Name, seconds here and in processes, the fixture that it uses, and what it reaches of nine lines.
    table = (
        ("tests/a.py::short", 0.1, 0.0, None, "1........"),
        ("tests/a.py::short_of_a_dear_room", 0.1, 0.0, 0, "1........"),
        ("tests/a.py::same_as_short", 2.0, 0.0, None, "1........"),
        ("tests/a.py::two_steps", 2.0, 0.0, None, ".11......"),
        ("tests/a.py::one_of_them", 1.0, 0.0, None, ".1......."),
        ("tests/a.py::alone", 3.0, 0.0, None, "...1....."),
        ("tests/a.py::starts_processes", 3.0, 1.0, None, "1........"),
        ("tests/a.py::failed", 0.0, np.inf, None, "1........"),
        ("tests/c.py::dear_too", 2.0, 0.0, None, "1........"),
        ("tests/c.py::of_its_file_the_shortest", 1.0, 0.0, None, "1........"),
        ("tests/d.py::dear_and_alone_in_its_file", 2.0, 0.0, None, "1........"),
        ("tests/real/test_a.py::captures", 9.0, 0.0, None, "....1...."),
        ("tests/b_in_browser.py::dear", 9.0, 0.0, None, "1........"),
        ("tests/b_in_browser.py::short", 0.1, 0.0, None, ".1......."),
        ("tests/e.py::chosen_early", 1.0, 0.0, None, ".....11.."),
        ("tests/e.py::then", 1.5, 0.0, None, ".....1.1."),
        ("tests/e.py::at_last", 1.5, 0.0, None, "......1.1"),
        ("tests/contracts/test_round_trips.py::drawn", 0.1, 0.0, None, ".1......."),
        ("tests/a.py::of_a_function[long]", 0.02, 0.0, 0, "1........"),
        ("tests/a.py::of_a_function[short]", 0.01, 0.0, None, "1........"),
    )
    reach = chooser.Reach(
        tests=tuple(row[0] for row in table),
        seconds=np.array([row[1:3] for row in table]),
        shared=np.array([5.0]),
        uses=np.array([[row[3] == 0] for row in table]),
        parts=np.array([[mark == "1" for mark in row[4]] for row in table]),
        is_line=np.ones(9, dtype=bool),
    )
    out = reach.left_out(0.5)
    names = {name.split("::")[1] for name, is_out in zip(reach.tests, out, strict=True) if is_out}
    assert names == {
        "short_of_a_dear_room",
        "same_as_short",
        "one_of_them",
        "dear",
        "dear_too",
        "dear_and_alone_in_its_file",
        "chosen_early",
        "drawn",
        "of_a_function[long]",
    }
    assert reach.total_s(~out) == pytest.approx(0.1 + 2.0 + 3.0 + 4.0 + 1.0 + 9.0 + 0.1 + 1.5 + 1.5 + 0.01)
    assert reach.parts[~out].any(axis=0).all()
    assert reach.left_out(20.0).sum() == 1
    # The short test of a function stays, whatever the limit.
    below = reach.left_out(0.005)
    assert not below[reach.tests.index("tests/a.py::of_a_function[short]")]
    assert below[reach.tests.index("tests/a.py::of_a_function[long]")]
