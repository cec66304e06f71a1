"""Detection in threads gives the same results as in one."""

from __future__ import annotations

import threading

import pytest

from rigkit.core.processes import in_threads


def test_results_come_in_order_and_from_several_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rigkit.core.processes.available_cores", lambda: 3)
    together = threading.Barrier(3)

    def work(item: int) -> int:
        together.wait(timeout=20.0)
        return item * item

    assert list(in_threads(work, range(6))) == [0, 1, 4, 9, 16, 25]


def test_an_error_ends_the_rest() -> None:
    started: list[int] = []

    def work(item: int) -> int:
        started.append(item)
        if item == 1:
            raise ValueError("one")
        return item

    with pytest.raises(ValueError, match="one"):
        list(in_threads(work, range(10_000)))
    assert len(started) < 10_000
