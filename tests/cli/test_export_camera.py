"""The camera half of `rigkit export`, through a parser of its own."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import pytest
from helpers.cameras import sample_cameras

from rigkit.cameras.compare import compare_cameras
from rigkit.cli.export_camera import FORMATS, OWN, add_camera_arguments, run_camera
from rigkit.errors import InputError
from rigkit.interop.formats import CAMERA_FORMATS, camera_format
from rigkit.io.calibration_file import load_camera, save_camera

CAMERAS = sample_cameras()


def _run(*words: str) -> int:
    parser = argparse.ArgumentParser()
    add_camera_arguments(parser)
    parser.add_argument("-o", "--output")
    parser.add_argument("--force", action="store_true")
    parser.add_argument("--json", action="store_true")
    return run_camera(parser.parse_args(words))


def test_formats_are_those_of_the_library() -> None:
    assert (OWN, *CAMERA_FORMATS) == FORMATS
    with pytest.raises(InputError, match="known: opencv"):
        camera_format("matlab")


@pytest.mark.parametrize("name", sorted(CAMERA_FORMATS))
def test_there_and_back(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    camera = CAMERAS["scaramuzza" if name == "ocamcalib" else "brown_rational"]
    if name == "kalibr":
        camera = CAMERAS["double_sphere"]
    save_camera(tmp_path / "a.json", camera)
    assert _run("--camera", str(tmp_path / "a.json"), "--to", name, "-o", str(tmp_path / "b"), "--json") == 0
    said = json.loads(capsys.readouterr().out)
    assert said["format"] == name and said["max_error_px"] == 0.0
    assert _run("--camera", str(tmp_path / "b"), "--from", name, "-o", str(tmp_path / "c.json")) == 0
    assert capsys.readouterr().out.startswith(str(tmp_path / "c.json"))
    assert compare_cameras(camera, load_camera(tmp_path / "c.json")).max_px < 1e-6


def test_what_is_lost_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_camera(tmp_path / "a.json", CAMERAS["scaramuzza"])
    assert _run("--camera", str(tmp_path / "a.json"), "--to", "ros", "-o", str(tmp_path / "b.yaml")) == 0
    printed = capsys.readouterr()
    assert "largest error" in printed.out
    assert "refitted as kannala_brandt" in printed.err


def test_errors(tmp_path: Path) -> None:
    save_camera(tmp_path / "a.json", CAMERAS["brown"])
    arguments = ["--camera", str(tmp_path / "a.json"), "--to", "ros", "-o", str(tmp_path / "b.yaml")]
    assert _run(*arguments) == 0
    with pytest.raises(InputError, match="exists"):
        _run(*arguments)
    assert _run(*arguments, "--force") == 0
    with pytest.raises(InputError, match="cannot be read"):
        _run("--camera", str(tmp_path / "no.yaml"), "--from", "ros", "-o", str(tmp_path / "c"))
    np.save(tmp_path / "x.npy", np.arange(9.0))
    with pytest.raises(InputError, match="cannot be read"):
        _run("--camera", str(tmp_path / "x.npy"), "--from", "ros", "-o", str(tmp_path / "c"))
    two = "1 PINHOLE 4 4 1 1 1 1\n2 PINHOLE 4 4 1 1 1 1\n"
    (tmp_path / "cameras.txt").write_text(two)
    with pytest.raises(InputError, match="2 cameras"):
        _run("--camera", str(tmp_path / "cameras.txt"), "--from", "colmap", "-o", str(tmp_path / "c"))
