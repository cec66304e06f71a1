"""Nonsensical values are refused with a message where they are passed in."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.calibration_scenes import REACH_DEG, SIZE, lens, random_views

import rigkit
import rigkit.io.calibrations.calibration_file
from rigkit.cameras.registry import camera_model
from rigkit.cli.main import main
from rigkit.core.errors import InputError
from rigkit.core.matches import Matches

PINHOLE = camera_model("pinhole")((640, 480), np.array([500.0, 500.0, 320.0, 240.0]))


@pytest.mark.parametrize("focal", ["-500.0", "0.0"])
def test_no_file_s_camera_has_a_focal_length_that_is_not_positive(
    focal: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As programs with y up write it: pixels would come out mirrored."""
    ours, theirs = tmp_path / "camera.json", tmp_path / "camera.yml"
    rigkit.io.calibrations.calibration_file.save_camera(ours, PINHOLE)
    ours.write_text(ours.read_text().replace('"fy": 500.0', f'"fy": {focal}'))
    with pytest.raises(InputError, match=r"camera.json': .*focal lengths are 500 and .*positive"):
        rigkit.load_camera(ours)
    matrix = f"[500.0, 0.0, 320.0, 0.0, {focal}, 240.0, 0.0, 0.0, 1.0]"
    theirs.write_text(f"image_width: 640\nimage_height: 480\ncamera_matrix: {matrix}\n")
    assert main(["export", str(theirs), "--from", "opencv", "-o", str(tmp_path / "new.json")]) == 2
    assert "camera.yml': its focal lengths are 500 and " in capsys.readouterr().err
    assert not (tmp_path / "new.json").exists()


@pytest.mark.parametrize(
    ("make", "printed"),
    [
        (lambda: camera_model("pinhole")((640.5, 480), PINHOLE.parameters), "whole numbers"),  # type: ignore[arg-type]
        (lambda: camera_model("pinhole")((float("nan"), 480), PINHOLE.parameters), "camera size"),  # type: ignore[arg-type]
        (lambda: PINHOLE.project(np.zeros((3, 7))), r"\(3, 7\)"),
        (lambda: PINHOLE.project(np.zeros((5, 2))), r"\(5, 2\)"),
        (lambda: PINHOLE.project_with_jacobians(np.zeros(4)), r"\(4,\)"),
        (lambda: PINHOLE.unproject(np.zeros((2, 5))), r"\(2, 5\)"),
        (lambda: PINHOLE.on_image(np.zeros((4, 3))), r"\(4, 3\)"),
        (lambda: Matches.from_cameras(PINHOLE, PINHOLE, np.float64(0.0), np.zeros((1, 2))), "pixels1.*scalar"),  # type: ignore[arg-type]
        (lambda: Matches.from_cameras(PINHOLE, PINHOLE, np.zeros((3, 2)), np.zeros((2, 2))), "pixels2.*3x2"),
        (lambda: rigkit.Board("b", 9.5, 6, 30.0, 30.0), "whole numbers"),  # type: ignore[arg-type]
        (lambda: rigkit.Board("b", 9, 6, 30.0, 30.0, square_sigma_mm=-1.0), "square_sigma_mm"),
        (lambda: rigkit.PoseType("sideways"), "general, planar, standard, forward, auto"),
    ],
)
def test_nonsense_is_named(make: Callable[[], object], printed: str) -> None:
    with pytest.raises(InputError, match=printed):
        make()


@pytest.mark.parametrize("folds", [-1, 1])
def test_folds_without_a_meaning(folds: int) -> None:
    views, _, _ = random_views(lens("reg"), 4, np.random.default_rng(0), reach_deg=REACH_DEG["reg"])
    with pytest.raises(InputError, match="folds"):
        rigkit.calibrate(views, SIZE, model="brown", folds=folds)
