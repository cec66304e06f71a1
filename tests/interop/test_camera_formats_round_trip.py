"""A camera written in another program's format and read back is equal."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rigkit.cameras.base import Camera
from rigkit.cameras.registry import camera_model
from rigkit.core.errors import InputError
from rigkit.interop.colmap_cameras import read_colmap_cameras, write_colmap_cameras
from rigkit.interop.colmap_model import _names
from rigkit.interop.kalibr import read_kalibr, write_kalibr
from rigkit.interop.mrcal import read_cameramodel, write_cameramodel
from rigkit.interop.opencv import read_opencv, write_opencv
from rigkit.interop.ros import read_camera_info, write_camera_info

SPLINE_PX = 0.1
"""A spline of 40 knots follows these lenses to 0.01 px; what reads it may add as much again."""

RADTAN = camera_model("brown")((640, 480), np.array([420.0, 421.0, 320.0, 240.0, -0.28, 0.07, 2e-4, 1.7e-5]))
FISHEYE = camera_model("kannala_brandt")((1280, 1024), np.array([380.0, 381.0, 640.0, 512.0, 0.01, -0.005, 0.001, 0.0]))
SPHERE = camera_model("ucm")((1280, 1024), np.array([330.0, 331.0, 640.0, 512.0, 0.55]))


def largest_difference_px(a: Camera, b: Camera) -> float:
    u, v = np.meshgrid(np.linspace(0, a.size_px[0] - 1, 40), np.linspace(0, a.size_px[1] - 1, 30))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2)
    rays, valid = a.unproject(pixels)
    back, seen = b.project(rays[valid])
    assert valid.mean() > 0.9 and seen.mean() > 0.99
    return float(np.linalg.norm(back - pixels[valid], axis=-1)[seen].max())


@pytest.mark.parametrize("camera", [FISHEYE, SPHERE], ids=lambda c: c.model)
def test_through_a_spline_of_mrcal(camera: Camera) -> None:
    """Read as one polynomial these were 9.7 and 4.4 px off; the model that it was follows the spline best."""
    back, _, stated_px = read_cameramodel(write_cameramodel(camera).text)
    assert largest_difference_px(camera, back) < SPLINE_PX
    assert stated_px < SPLINE_PX


def test_radtan_of_four_numbers_is_one_camera_everywhere() -> None:
    """Kalibr's pinhole-radtan, COLMAP's OPENCV, mrcal's OPENCV4: nothing is refitted, no term is added."""
    assert RADTAN.parameter_names()[-1] == "p2"
    written = (write_kalibr([RADTAN]).cameras[0], write_colmap_cameras({1: RADTAN})[1][1], write_cameramodel(RADTAN),
               write_opencv(RADTAN), write_camera_info(RADTAN))  # fmt: skip
    assert all(one.max_error_px == 0.0 and not one.note for one in written)
    backs = (
        read_kalibr(write_kalibr([RADTAN]).text)[0][0],
        read_colmap_cameras(write_colmap_cameras({1: RADTAN})[0])[1],
        read_cameramodel(write_cameramodel(RADTAN).text)[0],
        read_opencv(write_opencv(RADTAN).text),
    )
    for back in backs:
        assert back.parameters.tolist() == pytest.approx(RADTAN.parameters.tolist(), rel=1e-15)
    assert largest_difference_px(RADTAN, read_camera_info(write_camera_info(RADTAN).text)) < 1e-9


def test_a_term_that_is_zero_is_left_out() -> None:
    longer = camera_model("brown")(RADTAN.size_px, np.append(RADTAN.parameters, 0.0))
    written = write_kalibr([longer]).cameras[0]
    assert written.max_error_px == 0.0 and not written.note
    assert read_kalibr(written.text)[0][0].parameters.tolist() == RADTAN.parameters.tolist()


@pytest.mark.parametrize(
    "text",
    [
        "1 PINHOLE " + "9" * 400 + " 480 500 500 320 240\n",
        "1 PINHOLE 640.5 480 500 500 320 240\n",
        "1 PINHOLE 640 480 500 500 320 1e300\n",
        "1 PINHOLE 640 480 500 500 320 nan\n",
        "1 PINHOLE 640 480 500 500 320 240\n1 PINHOLE 640 480 600 600 320 240\n",
    ],
)
def test_damaged_cameras_of_colmap(text: str) -> None:
    with pytest.raises(InputError, match=r"cameras\.txt"):
        read_colmap_cameras(text)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("image_width: 640", "image_width: abc"),
        ("image_width: 640", "image_width: [1]"),
        ("image_width: 640", "image_width: .inf"),
        ("image_width: 640", "image_width: true"),
        ("image_width: 640", "image_width: '640'"),
        ("image_width: 640", "image_width: 640.5"),
    ],
)
def test_damaged_yaml(old: str, new: str) -> None:
    for write, read in ((write_camera_info, read_camera_info), (write_opencv, read_opencv)):
        text = write(RADTAN).text
        assert old in text
        with pytest.raises(InputError, match="image_width"):
            read(text.replace(old, new), "file")


@pytest.mark.parametrize("xi", ["[]", "-1", "-1.5", "[1, 2]", "abc", "{data: abc}"])
def test_a_sphere_without_its_number(xi: str) -> None:
    text = write_opencv(SPHERE).text
    line = next(one for one in text.splitlines() if one.startswith("xi:"))
    with pytest.raises(InputError, match="xi"):
        read_opencv(text.replace(line, f"xi: {xi}"))


@pytest.mark.parametrize(
    ("old", "new"), [("camera_model: pinhole", "camera_model: [pinhole]"), ("cam0:", "cam²:"), ("cam0:", "cam0: 3\nx:")]
)
def test_damaged_chains(old: str, new: str) -> None:
    text = write_kalibr([RADTAN]).text
    assert old in text
    with pytest.raises(InputError):
        read_kalibr(text.replace(old, new))


SPLINE = "LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=9_Ny=9_fov_x_deg=" + "9" * 5000
REST = "'imagersize': [640, 480], 'intrinsics': [1, 2, 3, 4], 'extrinsics': [0, 0, 0, 0, 0, 0]"


@pytest.mark.parametrize("text", ["", "{1, 2}", "{[]: 1}", "{" * 9000, f"{{'lensmodel': '{SPLINE}', {REST}}}"])
def test_damaged_models_of_mrcal(text: str) -> None:
    with pytest.raises(InputError, match="cameramodel"):
        read_cameramodel(text)


def test_names_for_colmap_are_two_and_have_no_blanks(tmp_path: Path) -> None:
    names, notes = _names((tmp_path / "left" / "1.png", tmp_path / "right" / "1.png"))
    assert names == ["left/1.png", "right/1.png"] and not notes
    names, notes = _names((tmp_path / "my left" / "1.png", tmp_path / "right" / "1.png"))
    assert names == ["my_left/1.png", "right/1.png"] and "'my left/1.png'" in notes[0]
