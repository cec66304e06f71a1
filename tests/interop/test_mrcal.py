"""mrcal's files: splines of fisheyes against mrcal's own projection, poses in metres."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.cameras import sample_cameras

from rigkit.cameras.base import Camera
from rigkit.cameras.compare import compare_cameras
from rigkit.cameras.convert import fit_camera
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.interop.mrcal import _spline_of, _spline_project, read_cameramodel, write_cameramodel

CAMERAS = sample_cameras()
SAME_PX = 1e-9
"""As mrcal prints every digit of a double."""
SPLINE_PX = 0.01
"""A lens without a fold in its image is followed by knots 30 px apart to thousandths of a pixel."""

SPLINE_FOLD_PX = 0.5
"""Where the image reaches the fold, d pixel / d angle goes to zero and the spline in the angle misses a little."""

BETWEEN_SAMPLES = 1.1
"""The largest error stated is that of samples; at the very corner it may be a little larger."""


@pytest.mark.parametrize(
    ("label", "limit_px"),
    [("kannala_brandt_folding", SPLINE_FOLD_PX), ("scaramuzza", SPLINE_PX), ("double_sphere", SPLINE_PX)],
)
def test_mrcal_spline_of_a_fisheye(label: str, limit_px: float) -> None:
    """A fisheye goes into mrcal as a spline and comes back as a polynomial."""
    camera = CAMERAS[label]
    written = write_cameramodel(camera)
    assert "SPLINED_STEREOGRAPHIC" in written.text
    assert written.max_error_px < limit_px
    assert written.covered > 0.99
    again, pose, error_px = read_cameramodel(written.text)
    assert pose.allclose(Rigid3.identity())
    assert compare_cameras(camera, again, fit_rotation=False).max_px < BETWEEN_SAMPLES * error_px + limit_px


WAVY = "LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=8_Ny=6_fov_x_deg=150"
WAVY_INTRINSICS = np.concatenate([[300.0, 310.0, 640.0, 480.0], 0.05 * np.sin(np.arange(96))])


def test_a_spline_that_no_model_follows_comes_with_its_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """All models are tried, though one cannot be fitted; the error of the best is that against the spline itself."""

    def fitted(model: type[Camera], *given: Any, **more: Any) -> Camera:
        if model.model == "double_sphere":
            raise InputError("it cannot be fitted")
        return fit_camera(model, *given, **more)

    monkeypatch.setattr("rigkit.interop.nearest.fit_camera", fitted)
    monkeypatch.setattr("rigkit.interop.nearest.CHECKED", (61, 51))
    values = ", ".join(map(repr, WAVY_INTRINSICS.tolist()))
    camera, pose, error_px = read_cameramodel(
        f"{{'lensmodel': '{WAVY}', 'intrinsics': [{values}], 'extrinsics': [0, 0, 0, 0, 0, 0], "
        "'imagersize': [1280, 960]}"
    )
    assert pose.allclose(Rigid3.identity()) and error_px > 1.0
    rays = np.dstack(np.meshgrid(np.linspace(-1.0, 1.0, 60), np.linspace(-0.8, 0.8, 50), [1.0])).reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    pixels, _ = _spline_project(rays, WAVY, WAVY_INTRINSICS)
    off = np.linalg.norm(camera.project(rays)[0] - pixels, axis=-1)
    assert 0.5 * error_px < off.max() < BETWEEN_SAMPLES * error_px


def test_mrcal_spline_is_mrcals() -> None:
    """Pixels as mrcal 2.2 itself projects these rays (mrcal.project), the third near the edge of the knots."""
    rays = np.array([[0.0, 0.0, 1.0], [0.5, -0.2, 1.0], [-1.5, 0.6, 1.0]])
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    pixels, inside = _spline_project(rays, WAVY, WAVY_INTRINSICS)
    theirs = [
        [639.8924447898148, 480.6909602676],
        [781.5908149961523, 420.9743781906921],
        [331.82264976261104, 610.1345402377215],
    ]
    assert inside.all()
    assert np.abs(pixels - theirs).max() < SAME_PX


def test_a_spline_projects_as_its_camera() -> None:
    """The spline that is written, without the refit by which it comes back."""
    camera = CAMERAS["scaramuzza"]
    pixels = np.stack(np.meshgrid(*(np.linspace(0.0, n - 1.0, 23) for n in camera.size_px)), axis=-1).reshape(-1, 2)
    rays, valid = camera.unproject(pixels)
    projected, inside = _spline_project(rays[valid], *_spline_of(camera))
    assert valid.mean() > 0.5 and inside.all()
    assert np.abs(projected - pixels[valid]).max() < SPLINE_PX


def test_mrcal_pose_is_in_metres() -> None:
    pose = Rigid3(exp_so3(np.array([0.1, -0.2, 0.05])), [-300.0, 10.0, 5.0])
    camera, again, error_px = read_cameramodel(write_cameramodel(CAMERAS["brown"], pose).text)
    assert again.allclose(pose)
    assert error_px == 0.0
    assert camera.model == "brown"
    newer = write_cameramodel(CAMERAS["brown"], pose).text.replace("'extrinsics'", "'rt_cam_ref'")
    assert read_cameramodel(newer)[1].allclose(pose)
