"""Files of OCamCalib and of py-OCamCalib: equal rays in both directions."""

from __future__ import annotations

import json
import re

import cv2
import numpy as np
import pytest
from helpers.cameras import image_pixels, sample_cameras
from helpers.data import shared_data

from rigkit.cameras.scaramuzza import Scaramuzza
from rigkit.interop.ocamcalib import read_ocamcalib, read_py_ocamcalib, write_ocamcalib

CAMERAS = sample_cameras()
PUBLISHED_RMS_PX = 1.0
"""The publisher states 0.24 px for other corners of the same images; a swapped axis is hundreds of pixels off."""


def _cam2world(text: str, pixels: np.ndarray) -> np.ndarray:
    """OCamCalib's cam2world, from the toolbox's description: (row, column) to a ray, x down, y right, z backwards."""
    rows = [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    ss = np.array(rows[0][1:], dtype=float)
    xc, yc = (float(v) for v in rows[2])
    c, d, e = (float(v) for v in rows[3])
    offset = pixels[:, ::-1] - [xc, yc]
    plane = offset @ np.linalg.inv(np.array([[c, d], [e, 1.0]])).T
    rho = np.linalg.norm(plane, axis=-1)
    ray = np.concatenate([plane, np.polynomial.polynomial.polyval(rho, ss)[:, None]], axis=-1)
    return ray / np.linalg.norm(ray, axis=-1, keepdims=True)


def _world2cam(text: str, rays: np.ndarray) -> np.ndarray:
    """OCamCalib's world2cam through the inverse polynomial; returns (column, row)."""
    rows = [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    inverse = np.array(rows[1][1:], dtype=float)
    xc, yc = (float(v) for v in rows[2])
    c, d, e = (float(v) for v in rows[3])
    norm = np.linalg.norm(rays[:, :2], axis=-1)
    rho = np.polynomial.polynomial.polyval(np.arctan(rays[:, 2] / norm), inverse)
    x, y = (rays[:, :2] / norm[:, None] * rho[:, None]).T
    return np.stack([x * e + y + yc, x * c + y * d + xc], axis=-1)


OCAM_FILE = """#polynomial coefficients for the DIRECT mapping function

5 -3.377168e+02 0.000000e+00 1.223832e-03 -1.380400e-06 3.010617e-09

#polynomial coefficients for the inverse mapping function

2 1.0 2.0

#center: "row" and "column", starting from 0 (C convention)

377.648825 543.986151

#affine parameters "c", "d", "e"

1.003296 0.003148 -0.004177

#image size: "height" and "width"

778 1032
"""


def test_ocamcalib_file_gives_the_same_rays() -> None:
    camera, cam_from_ocam = read_ocamcalib(OCAM_FILE)
    assert camera.size_px == (1032, 778)
    assert np.allclose(cam_from_ocam @ cam_from_ocam.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(cam_from_ocam) == pytest.approx(1.0)
    pixels = image_pixels(camera)
    rays, valid = camera.unproject(pixels)
    assert valid.mean() > 0.9
    assert np.abs(rays - _cam2world(OCAM_FILE, pixels) @ cam_from_ocam.T)[valid].max() < 1e-12


@pytest.mark.parametrize("label", ["scaramuzza", "scaramuzza_3", "kannala_brandt_folding", "eucm", "brown"])
def test_ocamcalib_sees_the_rays_that_we_see(label: str) -> None:
    camera = CAMERAS[label]
    written = write_ocamcalib(camera)
    stated = float(re.search(r"follows to ([\d.e+-]+) px", written.note)[1])  # type: ignore[index]
    pixels = image_pixels(camera)
    rays, valid = written.camera.unproject(pixels)
    assert valid.mean() > 0.9
    pixels, rays = pixels[valid], rays[valid]
    down_right_back = rays[:, [1, 0, 2]] * [1.0, 1.0, -1.0]
    assert np.abs(_cam2world(written.text, pixels) - down_right_back).max() < 1e-10
    assert np.abs(_world2cam(written.text, down_right_back) - pixels).max() < 2.0 * stated + 1e-6
    assert stated < 0.5


@pytest.mark.real
def test_published_calibration_of_py_ocamcalib() -> None:
    """The published polynomial, evaluated by hand at the published centre and along a row."""
    text = next(shared_data("real/ocam-fisheye1").glob("calibration_fisheye_1_*.json")).read_text()
    camera, _ = read_py_ocamcalib(text, (1032, 778))
    assert isinstance(camera, Scaramuzza)
    centre, _ = camera.project(np.array([0.0, 0.0, 1.0]))
    assert centre == pytest.approx([543.986, 377.649], abs=1e-3)
    ray, _ = camera.unproject(centre + np.array([0.0, 300.0]))
    rho = 300.0
    f = 337.71684 - 1.22383e-3 * rho**2 + 1.38040e-6 * rho**3 - 3.01062e-9 * rho**4
    assert ray[2] / np.linalg.norm(ray[:2]) == pytest.approx(f / rho, rel=1e-4)


@pytest.mark.real
def test_published_poses_of_py_ocamcalib_meet_the_corners() -> None:
    """The published pose of the first board, in squares, projects onto the corners that OpenCV finds: frames agree."""
    folder = shared_data("real/ocam-fisheye1")
    text = next(folder.glob("calibration_fisheye_1_*.json")).read_text()
    camera, cam_from_file = read_py_ocamcalib(text, (1032, 778))
    file_from_board = np.array(json.loads(text)["extrinsics_t"][0])
    board = np.stack(np.meshgrid(np.arange(8.0), np.arange(6.0), [0.0]), axis=-1).reshape(-1, 3)
    points = board @ file_from_board[:, :3].T + file_from_board[:, 3]
    pixels, valid = camera.project(points @ cam_from_file.T)
    image = cv2.imread(str(folder / "Fisheye1_1.jpg"), 0)
    assert image is not None
    found, corners = cv2.findChessboardCornersSB(image, (8, 6))
    assert found and valid.all()
    distance = np.linalg.norm(pixels[:, None] - corners.reshape(1, -1, 2), axis=-1).min(axis=1)
    assert np.sqrt(np.mean(distance**2)) < PUBLISHED_RMS_PX
