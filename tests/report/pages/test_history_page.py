"""The register's page: overwritten calibrations are separate editions, changes over temperature."""

from __future__ import annotations

import hashlib
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rigkit.io.calibrations.history_file import HistoryEntry, add_entry, editions
from rigkit.report.pages.history_page import history_page
from rigkit.validation.monitoring.drift import heat_drift
from rigkit.workflows.checks.history import show_history


def entry(
    day: int, digest: str, amount: float = 0.0, celsius: float | None = None, name: str = "cam.json"
) -> HistoryEntry:
    return HistoryEntry(
        date=f"2026-03-{day:02d}T10:00:00Z",
        kind="check",
        source=name,
        holds=True,
        chance=0.5,
        verdict="holds",
        frames=3,
        rms_px=0.1,
        digest=digest,
        temperature_c=celsius,
        amounts={"focus, %": (amount, 0.02)},
    )


def test_overwritten_calibrations_are_separate_editions() -> None:
    entries = [
        entry(1, ""),
        entry(2, "a"),
        entry(3, "a", name="other.json"),
        entry(4, "b"),
        entry(5, ""),
        entry(6, "a"),
    ]
    found = [(e.watched, e.digest, [one.date[8:10] for one in e.entries], e.several) for e in editions(entries)]
    # What an older register says is of the first file, what says nothing of the one before; a file put back goes on.
    assert sorted(found) == [
        ("cam.json", "a", ["01", "02", "06"], True),
        ("cam.json", "b", ["04", "05"], True),
        ("other.json", "a", ["03"], False),
    ]
    assert [e.digest for e in editions([entry(1, ""), entry(2, "")])] == [""]


def test_amounts_follow_the_temperature() -> None:
    rng, slope = np.random.default_rng(3), 0.01
    celsius, sigma = np.array([18.0, 20.0, 21.0, 23.0, 26.0, 30.0]), np.array([0.02, 0.01, 0.02, 0.03, 0.01, 0.02])
    lines = [heat_drift(celsius, 0.3 + slope * celsius + sigma * rng.standard_normal(6), sigma) for _ in range(400)]
    pulls = np.array([(line.per_degree - slope) / line.sigma for line in lines if line is not None])
    assert len(pulls) == 400 and np.sqrt(np.mean(pulls**2)) == pytest.approx(0.9, abs=0.12)
    still = [heat_drift(celsius, sigma * rng.standard_normal(6), sigma) for _ in range(400)]
    assert sum(line is not None and line.chance < 0.05 for line in still) <= 30
    # Amounts that scatter tenfold are told so: the slope is as much less sure.
    wild = heat_drift(celsius, 10.0 * sigma * rng.standard_normal(6), sigma)
    assert wild is not None and lines[0] is not None and wild.sigma > 3.0 * lines[0].sigma
    assert heat_drift(celsius[:2], sigma[:2], sigma[:2]) is None
    assert heat_drift(np.full(6, 20.0), sigma, sigma) is None


def test_the_page_and_what_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    warm = [entry(k, "a", 0.01 * (k - 5), 15.0 + k) for k in range(1, 10)]
    page = history_page(warm, "cam", {})
    assert "focus, %: against temperature" in page and "0.0100 ± 0.0026 % per °C" in page
    assert "is another file" not in page and ">2026-03-01</text>" in page
    one_day = [replace(warm[0], date=f"2026-03-01T{hour:02d}:30:00Z") for hour in (8, 14)]
    assert all(label in history_page(one_day, "cam", {}) for label in (">08:30</text>", ">14:30</text>"))
    calibration, register = tmp_path / "cam.json", tmp_path / "cam.jsonl"
    calibration.write_text("one")
    one = hashlib.sha256(b"one").hexdigest()
    for k in (1, 2):
        add_entry(register, entry(k, one))
    with caplog.at_level(logging.WARNING):
        show_history(register)
    assert not caplog.messages
    calibration.write_text("two")
    with caplog.at_level(logging.WARNING):
        show_history(register)
    assert "cam.json was overwritten since its last entry of 2026-03-02" in caplog.text
    caplog.clear()
    add_entry(register, entry(3, hashlib.sha256(b"two").hexdigest()))
    drift = tmp_path / "drift.html"
    with caplog.at_level(logging.WARNING):
        show_history(register, report=drift)
    assert "another file since the entry of 2026-03-03" in caplog.text and "was overwritten" not in caplog.text
    assert "cam.json as of 2026-03-01" in drift.read_text() and "cam.json as of 2026-03-03" in drift.read_text()
