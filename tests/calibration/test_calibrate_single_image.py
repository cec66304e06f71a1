"""One image of three perpendicular boards is enough to calibrate a camera."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.calibration_scenes import lens

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.certainty.uncertainty import projection_uncertainty
from rigkit.calibration.views.usable import views_of_image
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection, BoardView
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import angle_between, exp_so3

NOISE_PX = 0.05
SIGMAS = 4.0
BOARD = Board("a8x6_50", 8, 6, 50.0, 50.0)
CORNER = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


def corner_of_a_room(name: str, rng: np.random.Generator) -> list[BoardView]:
    """Return the views of three boards, alike, on the floor and the walls of a corner that the camera looks into."""
    camera = lens(name)
    # The room's corner opens towards the camera: its edges run towards it at equal angles.
    look = np.array([-1.0, -1.0, -1.0]) / np.sqrt(3.0)
    right = np.cross(look, [0.0, 1.0, 0.0]) / np.linalg.norm(np.cross(look, [0.0, 1.0, 0.0]))
    room = np.stack([right, np.cross(look, right), look]) @ exp_so3(0.1 * rng.normal(size=3))
    cam_from_room = Rigid3(room, [20.0, -30.0, 1100.0 if name == "reg" else 800.0 if name == "wide" else 600.0])
    found = []
    for k in range(3):
        # In the room: the board lies 60 mm from both edges of its wall, its z axis into the wall.
        x, y = CORNER[(k + 2) % 3], CORNER[(k + 1) % 3]
        points = 60.0 * (x + y) + BOARD.points()[:, :1] * x + BOARD.points()[:, 1:2] * y
        pixels, valid = camera.project(cam_from_room.apply(points))
        assert valid.all() and camera.on_image(pixels).all()
        noisy = pixels + NOISE_PX * rng.normal(size=pixels.shape)
        found.append(BoardDetection(None, 8, 6, BOARD.grid(), noisy, np.full(48, NOISE_PX)))
    views, reason = views_of_image("one.png", found, [BOARD])
    assert reason is None
    return views


@pytest.mark.parametrize(("name", "model"), [("reg", "brown"), ("wide", "kannala_brandt"), ("fish", "kannala_brandt")])
def test_one_image_of_three_boards(name: str, model: str, rng: np.random.Generator) -> None:
    views = corner_of_a_room(name, rng)
    assert len(views) == 3
    truth = lens(name)
    result = calibrate(views, truth.size_px, model=model, board="flat")
    assert len(result.views) == 3 and result.dropped == () and result.heldout_rms_px is None
    assert result.sigma_px == pytest.approx(NOISE_PX, rel=0.2)
    pixels = np.concatenate([v.pixels for v in views])
    rays, _ = truth.unproject(pixels)
    rotation = np.eye(3)
    for _ in range(6):
        projected, seen, d_pixels_d_point, _ = result.camera.project_with_jacobians(rays @ rotation.T)
        design = np.cross((rays @ rotation.T)[:, None, :], d_pixels_d_point).reshape(-1, 3)
        rotation = exp_so3(np.linalg.lstsq(design, (pixels - projected).reshape(-1), rcond=None)[0]) @ rotation
    assert seen.all()
    off = np.sqrt(((projected - pixels) ** 2).sum(axis=1).mean())
    predicted = float(np.sqrt(np.mean(projection_uncertainty(result, pixels).worst_px ** 2)))
    assert off < SIGMAS * predicted
    # The walls stand at right angles, which the calibration was not told.
    normals = [v.cam_from_board.rotation[:, 2] for v in result.views]
    angles = [np.degrees(angle_between(normals[i], normals[j])) for i, j in ((0, 1), (0, 2), (1, 2))]
    assert np.abs(np.array(angles) - 90.0).max() < 1.0
