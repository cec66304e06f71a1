"""The register of calibrations and checks over months, and its control limits."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from helpers.calibration_scenes import lens
from helpers.monitoring_scenes import checked

from rigkit.calibration.result import Calibration
from rigkit.core.errors import InputError
from rigkit.io.calibrations.calibration_file import save_calibration
from rigkit.io.calibrations.history_file import (
    HistoryEntry,
    add_entry,
    ensure_register,
    load_history,
    path_from_register,
)
from rigkit.report.pages.history_page import drift_svg, history_facts, history_page
from rigkit.workflows.checks.history import add_to_history, show_history


def test_the_register_grows_and_is_drawn(calibration: Calibration, tmp_path: Path) -> None:
    register = tmp_path / "cam.jsonl"
    for seed in range(3):
        check = checked(calibration, lens("reg"), np.random.default_rng(seed))
        add_entry(register, HistoryEntry.of_check(check, tmp_path / "c.json", temperature_c=21.0))
    entries = load_history(register)
    assert len(entries) == 3 and all(entry.holds for entry in entries)
    assert set(entries[0].amounts) == {
        "focus, %", "principal point 1, px", "principal point 2, px", "distortion 1, px", "distortion 2, px",
        "distortion 3, px",
    }  # fmt: skip
    page = history_page(entries, "t", {})
    assert page.count("<svg") == 6 and "21.0" in page
    register.write_text(register.read_text() + json.dumps({"schema": "other"}) + "\n")
    with pytest.raises(InputError, match=r"line 4.*another schema"):
        load_history(register)


def test_a_register_of_months(calibration: Calibration, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Two cameras, more and fewer pictures, clocks that went back, dates of other zones and files that moved."""
    check = checked(calibration, lens("reg"), np.random.default_rng(3))
    register = tmp_path / "lab" / "register.jsonl"
    for camera, day in (("left", 3), ("right", 4), ("left", 1), ("left", 5)):
        source = path_from_register(register, tmp_path / "lab" / camera / "calibration.json")
        add_entry(register, HistoryEntry.of_check(check, source, now=datetime(2026, 3, day, tzinfo=UTC)))
    save_calibration(tmp_path / "c.json", calibration)
    add_to_history(register, tmp_path / "c.json", tmp_path / "c.json", temperature_c=19.0)
    # Two hours east, this is before the entry of 3 March; a former version said nothing of the reference.
    older = json.loads(register.read_text().splitlines()[0]) | {"date": "2026-03-03T01:00:00+02:00"}
    del older["reference"]
    register.write_text(register.read_text() + json.dumps(older) + "\n")
    entries, _ = show_history(register, report=tmp_path / "page.html")
    assert [entry.date[5:10] for entry in entries[:5]] == ["03-01", "03-03", "03-03", "03-04", "03-05"]
    assert entries[1].date.endswith("+02:00") and entries[-1].reference == "../c.json" == entries[-1].source
    assert {entry.source for entry in entries[:5]} == {"left/calibration.json", "right/calibration.json"}
    assert "2 entries follow one of a later day" in caplog.text
    page = (tmp_path / "page.html").read_text()
    assert history_facts(entries).passed and "of each file holds" in history_facts(entries).headline
    alarm = replace(entries[3], holds=False)
    assert "of right/calibration.json is an alarm" in history_facts([*entries[:3], alarm, *entries[4:]]).headline
    # The amounts of one camera are no drift of another.
    assert page.count("<svg") == 18 and page.count("left/calibration.json: focus, %") == 1


def test_a_register_that_the_work_reads_is_not_added_to(tmp_path: Path) -> None:
    register = tmp_path / "cam.jsonl"
    register.touch()
    with pytest.raises(InputError, match="nothing in it"):
        ensure_register(register, [tmp_path / "other.json"])
    with pytest.raises(InputError, match="this command reads it"):
        ensure_register(register, [tmp_path / "lab" / ".." / "cam.jsonl"])


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"frames": -3}, "not negative"),
        ({"rms_px": -0.1}, "not negative"),
        ({"temperature_c": -400.0}, "no temperature is -400 C"),
    ],
)
def test_impossible_entries_are_refused(
    changed: dict[str, float], words: str, calibration: Calibration, tmp_path: Path
) -> None:
    register = tmp_path / "cam.jsonl"
    check = checked(calibration, lens("reg"), np.random.default_rng(3))
    add_entry(register, HistoryEntry.of_check(check, Path("c.json")))
    register.write_text(json.dumps(json.loads(register.read_text()) | changed) + "\n")
    with pytest.raises(InputError, match=f"line 1.*{words}"):
        load_history(register)


def test_future_dates_are_warned_of(calibration: Calibration, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    register = tmp_path / "cam.jsonl"
    check = checked(calibration, lens("reg"), np.random.default_rng(3))
    add_entry(register, HistoryEntry.of_check(check, Path("c.json")))
    show_history(register)
    assert not caplog.text
    entry = json.loads(register.read_text()) | {"date": "9999-12-31T23:59:59-05:00"}
    register.write_text(register.read_text() + json.dumps(entry) + "\n")
    show_history(register)
    assert "1 entry has a date to come, '9999-12-31T23:59:59-05:00' the last" in caplog.text


def test_every_entry_has_its_own_control_limits(calibration: Calibration) -> None:
    check = checked(calibration, lens("reg"), np.random.default_rng(3))
    one = HistoryEntry.of_check(check, Path("c.json"), now=datetime(2026, 3, 1, tzinfo=UTC))
    value, sigma = one.amounts["focus, %"]
    unsure = replace(one, date="2026-03-09T00:00:00Z", amounts={"focus, %": (value, 4.0 * sigma)})
    drawn = re.findall(r'<path d="M([^"]*)"[^>]*dasharray="5 4"', drift_svg([one, unsure], "focus, %"))
    heights = [float(point.split()[1]) for point in drawn[0].split("L")]
    assert len(drawn) == 2 and heights[0] == heights[1] > heights[2] == heights[3]
    middle = 0.5 * (heights[0] + float(drawn[1].split("L")[0].split()[1]))
    assert middle - heights[2] == pytest.approx(4.0 * (middle - heights[0]), abs=0.2)
