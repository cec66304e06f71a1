"""`--json` has everything that the pages show."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from helpers.pages import assert_all_is_in, reported
from helpers.reconstructions import make_reconstruction
from helpers.schemas import faults
from helpers.stereo_pictures import of_one_camera

from rigkit.cli.main import main
from rigkit.report.pages.validation_page import build_page, pair_section, summary_table, validation_facts
from rigkit.report.pages.validation_verdict import verdict_of
from rigkit.validation.diagnose import diagnose

REPEATS = ("held-out RMS",)
"""Figures that the JSON has by name."""


@pytest.fixture(scope="module")
def calibrated(pictures: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = of_one_camera(pictures, tmp_path_factory.mktemp("one") / "photos")
    assert main(["calibrate", str(folder), "--board", "9x6x30", "--model", "brown"]) == 0
    return folder


def run(arguments: list[str], page: Path, capsys: pytest.CaptureFixture[str], code: int = 0) -> tuple[str, Any]:
    """Return the page that a command writes, and what it prints for programs."""
    capsys.readouterr()
    assert main([*arguments, "-r", str(page), "--json"]) == code
    answer = json.loads(capsys.readouterr().out)
    assert faults(answer["page"]) == []
    return page.read_text(encoding="utf-8"), answer


def test_one_camera(calibrated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    session, out = str(calibrated / "session.toml"), str(tmp_path / "c.json")
    html, answer = run(["calibrate", session, "-o", out], tmp_path / "c.html", capsys)
    assert_all_is_in(html, answer["page"], REPEATS)
    keys = {table["key"] for table in answer["page"]["tables"]}
    assert {"parameters", "candidates", "boards", "images", "plan"} <= keys
    assert f"{answer['heldout_rms_px']:.3f} px" in html and f"{answer['rms_px']:.3f} px" in html
    assert set(answer["sigmas"]) == set(answer["parameters"])


def test_a_rig(pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["calibrate", str(pictures), "--board", "9x6x30", "--model", "brown", "-o", str(tmp_path / "rig.json")]
    html, answer = run(command, tmp_path / "rig.html", capsys)
    assert_all_is_in(html, answer["page"], REPEATS)
    assert set(answer["page"]["parts"]) == {"left", "right"}


def test_diff_certify_check_and_plan(calibrated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    known = str(calibrated / "calibration.json")
    own = sorted(calibrated.glob("*.JPG"))[:3]
    # Saved again, as other files.
    images = [str(tmp_path / path.name) for path in own[:2]]
    for path in own[:2]:
        (tmp_path / path.name).write_bytes(path.read_bytes() + b"again")
    assert main(["check", known, *map(str, own)]) == 2
    assert "was made from these very images" in capsys.readouterr().err
    page = tmp_path / "left-out.html"
    assert main(["check", known, *images, str(own[2]), "-r", str(page)]) == 0
    left_out = capsys.readouterr().err
    assert f"{own[2]}" in left_out and "the calibration was made from it, and fits it" in left_out
    assert f"left out: {own[2].name}" in page.read_text()
    for given in ([str(calibrated)], [str(path) for path in sorted(calibrated.glob("*.JPG"), reverse=True)]):
        assert main(["check", known, *given]) == 2
        assert "was made from these very images" in capsys.readouterr().err
    commands = {
        "diff": ["diff", known, known],
        "certify": ["certify", known, "--length", "50", "--distance", "400"],
        "check": ["check", known, *images],
        "plan": ["plan", known],
    }
    for name, command in commands.items():
        html, answer = run(command, tmp_path / f"{name}.html", capsys)
        assert_all_is_in(html, answer["page"], ("Blue dots",))


def test_a_validation_that_fails() -> None:
    report = reported(88.0)
    verdict = verdict_of([report], [report], causes=diagnose([report]))
    section = pair_section(make_reconstruction(), [report], [])
    tables = [summary_table([report])]
    facts = validation_facts("lead", verdict, tables, [section], ["a remark"])
    html = build_page("title", "lead", verdict, tables, [section], {"rigkit": "x"}, ["a remark"])
    assert faults(facts.to_dict()) == []
    assert facts.badge == "a check failed" and "a remark" in facts.sentences
    assert_all_is_in(html, json.loads(json.dumps(facts.to_dict())), ("3D view:",))
