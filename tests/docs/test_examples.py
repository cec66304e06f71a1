"""The scripts of examples/ run as they are."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest
from helpers.data import REPOSITORY
from helpers.stereo_pictures import of_one_camera, of_two_cameras

EXAMPLES = REPOSITORY / "examples"


def run(
    name: str, arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], folder: Path
) -> str:
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    monkeypatch.chdir(folder)
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    return capsys.readouterr().out


def test_one_camera(
    pictures: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = of_one_camera(pictures, tmp_path / "photos")
    printed = run("one_camera.py", [str(folder), "9x6x30"], monkeypatch, capsys, tmp_path)
    assert "held-out RMS" in printed and "100% of it seen" in printed
    assert (folder / "camera.yaml").is_file() and (folder / "calibration.html").is_file()


def test_stereo(
    pictures: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    sides = of_two_cameras(pictures, tmp_path)
    printed = run("stereo.py", [*map(str, sides), "9x6x30"], monkeypatch, capsys, tmp_path)
    # The cameras stand 90 mm apart.
    assert "mm apart" in printed and abs(float(printed.split(" ±")[0].split()[-1]) - 90.0) < 0.3
    assert len(list((tmp_path / "rectified").rglob("*.jpg"))) == 2 * len(list((tmp_path / "left").iterdir()))


def test_against_a_ruler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    lab = str(REPOSITORY / "datasets" / "lab-a")
    printed = run("against_a_ruler.py", [lab, "fisheye-standard"], monkeypatch, capsys, tmp_path)
    assert "baseline" in printed and "FAILS" not in printed and "144 oriented points" in printed


def test_every_example_is_listed() -> None:
    listed = (EXAMPLES / "README.md").read_text(encoding="utf-8")
    assert all(f"`{path.name} " in listed for path in EXAMPLES.glob("*.py"))
