"""Work in several processes; tests/cli/test_main_interrupted.py is about their end."""

from __future__ import annotations

import math

import pytest

from rigkit.core.processes import over_items


def test_results_come_with_their_place_whichever_process_had_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rigkit.core.processes.available_cores", lambda: 2)
    squares = [1.0, 4.0, 9.0, 16.0]
    assert dict(over_items(math.sqrt, squares, jobs=2)) == {0: 1.0, 1: 2.0, 2: 3.0, 3: 4.0}
