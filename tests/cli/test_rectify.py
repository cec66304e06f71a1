"""`rigkit rectify` end to end: files in, file out, one line on stdout, nothing overwritten."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.cli.main import main
from rigkit.io.calibration_file import save_camera

CAMERA = KannalaBrandt((160, 120), np.array([48.0, 48.0, 79.5, 59.5, 0.0, 0.0, 0.0, 0.0]))


@pytest.fixture(name="files")
def _files(tmp_path: Path) -> tuple[str, str]:
    save_camera(tmp_path / "camera.json", CAMERA)
    image = np.full((120, 160, 3), 40, dtype=np.uint8)
    # A bright blob 45 degrees to the right of the axis.
    blob, _ = CAMERA.project(np.array([1.0, 0.0, 1.0]))
    cv2.circle(image, tuple(int(v) for v in np.rint(blob)), 4, (10, 20, 250), -1)
    cv2.imwrite(str(tmp_path / "image.png"), image)
    return str(tmp_path / "image.png"), str(tmp_path / "camera.json")


def test_what_is_to_the_right_comes_to_the_middle(
    files: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new" / "out.png"
    options = ["--yaw-deg", "45", "--hfov-deg", "60", "--size", "81x61", "-o", str(out)]
    assert main(["rectify", files[0], "--camera", files[1], *options]) == 0
    printed = capsys.readouterr().out
    assert "81 x 61 px" in printed and "100.0 %" in printed
    image = cv2.imread(str(out))
    assert image is not None and image.shape == (61, 81, 3)
    # Colours keep their order: the blob is red.
    assert image[30, 40].tolist() == pytest.approx([10, 20, 250], abs=3)
    assert image[5, 5].tolist() == pytest.approx([40, 40, 40], abs=3)


@pytest.mark.parametrize("projection", ["perspective", "cylindrical", "equirectangular"])
def test_json_says_what_the_image_is(
    files: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str], projection: str
) -> None:
    out = tmp_path / "out.tif"
    arguments = ["rectify", files[0], "--camera", files[1], "-o", str(out), "--projection", projection, "--json"]
    assert main([*arguments, "--hfov-deg", "90", "--interpolation", "linear"]) == 0
    result = json.loads(capsys.readouterr().out)
    image = cv2.imread(str(out))
    assert image is not None
    assert result["size_px"] == [image.shape[1], image.shape[0]]
    assert result["projection"] == projection
    assert np.allclose(result["target_from_cam"], np.eye(3))
    assert 0.0 < result["covered"] <= 1.0


def test_nothing_is_overwritten_and_errors_are_one_line(
    files: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.png"
    out.write_bytes(b"mine")
    start = ["rectify", files[0], "--camera", files[1]]
    for options, words in (
        (["-o", str(out)], "exists"),
        (["-o", str(tmp_path / "a.xyz")], ".xyz"),
        (["-o", str(tmp_path / "a.png"), "--size", "12"], "--size"),
        (["-o", str(tmp_path / "a.png"), "--hfov-deg", "200"], "field of view"),
        (["-o", str(tmp_path / "a.png"), "--yaw-deg", "180", "--hfov-deg", "40"], "sees nothing"),
    ):
        assert main([*start, *options]) == 2
        err = capsys.readouterr().err
        assert words in err and len(err.strip().splitlines()) == 1
    assert out.read_bytes() == b"mine"
    assert not (tmp_path / "a.png").exists()
    assert main([*start, "-o", str(out), "--force"]) == 0
    assert cv2.imread(str(out)) is not None
