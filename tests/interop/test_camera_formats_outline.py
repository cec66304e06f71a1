"""A refit for a format without the lens's model is weighted by the outline of the boards, which mrcal's files hold."""

from __future__ import annotations

import ast

import numpy as np
import pytest

from rigkit.cameras.brown import Brown
from rigkit.cameras.convert import convert_camera
from rigkit.core.arrays import Pixels
from rigkit.interop.kalibr import read_kalibr, write_kalibr
from rigkit.interop.mrcal import read_cameramodel, write_cameramodel

CAMERA = Brown((640, 480), np.array([533.5, 534.0, 341.6, 235.2, -0.288, 0.11, 0.001, -0.0003, 0.1]))
OUTLINE = np.array([[140.0, 90.0], [500.0, 90.0], [500.0, 390.0], [320.0, 430.0], [140.0, 390.0]])
SAMPLED = 1.3
"""Between the samples of the refit the error may be so much larger."""


def pixels_inside() -> Pixels:
    """Pixels of a grid of another spacing than that of the refit, well inside the outline."""
    u, v = np.meshgrid(np.linspace(150.0, 490.0, 57), np.linspace(100.0, 380.0, 43))
    return np.stack([u, v], axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("outline", [OUTLINE, OUTLINE[::-1]])
def test_a_refit_is_good_where_boards_were(outline: Pixels) -> None:
    pixels = pixels_inside()
    rays, valid = CAMERA.unproject(pixels)
    assert valid.all()
    errors = {}
    for known in (None, outline):
        written = write_kalibr([CAMERA], outlines=[known])
        (read,), _ = read_kalibr(written.text)
        errors[known is None] = np.linalg.norm(read.project(rays)[0] - pixels, axis=-1).max()
        if known is None:
            assert "elsewhere" not in written.cameras[0].note
            assert "with --model kannala_brandt nothing is lost" in written.cameras[0].note
            continue
        assert errors[False] < SAMPLED * written.cameras[0].max_error_px
        assert "where boards were" in written.cameras[0].note
        assert 'with model = "brown" and degree = 4 in the session' in written.cameras[0].note
    assert errors[False] < 0.7 * errors[True]


def test_a_refit_keeps_the_lens_outside_the_outline() -> None:
    """A refit to the middle alone could go anywhere at the border: its error there is stated, and weighed."""
    c = convert_camera(CAMERA, "brown", order=4, outline=OUTLINE)
    corners = np.array([[0.0, 0.0], [639.0, 0.0], [0.0, 479.0], [639.0, 479.0]])
    off = np.linalg.norm(c.camera.project(CAMERA.unproject(corners)[0])[0] - corners, axis=-1)
    assert c.max_px < c.outside_px
    assert off.max() == pytest.approx(c.outside_px, rel=1e-9)


def test_the_outline_is_written_to_mrcal() -> None:
    text = write_cameramodel(CAMERA, outline=OUTLINE).text
    region = ast.literal_eval(text[text.index("{") :])["valid_intrinsics_region"]
    np.testing.assert_allclose(region, [*OUTLINE, OUTLINE[0]])
    assert read_cameramodel(text)[0].parameters.tolist() == CAMERA.parameters.tolist()
    assert "valid_intrinsics_region" not in write_cameramodel(CAMERA).text
