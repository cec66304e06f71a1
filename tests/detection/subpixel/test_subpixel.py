"""Corners of whole lattices on rendered images, against their exact positions."""

from __future__ import annotations

import numpy as np
import pytest

from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.core.boards import Board
from rigkit.detection.detect import detect_boards
from rigkit.geometry.rigid3 import Rigid3
from rigkit.synthetic.photometry import Photometry
from rigkit.synthetic.render import Optics, render
from rigkit.synthetic.scene import place_board

MAX_PX = 0.004
"""RMS without noise: what the models of edge and renderer have apart."""

SIGMA_BAND = (0.75, 1.35)
"""Errors in sigmas: 240 errors scatter by 5 %, and a board's are not all independent."""


@pytest.mark.parametrize("noise", [0.0, 3.0])
def test_large_squares_at_the_rim_of_a_fisheye(noise: float) -> None:
    """Few corners, each a quarter of a radian on: the lattice hardly knows how its lines bend, the edges do."""
    camera = KannalaBrandt((640, 480), np.array([190.0, 190.0, 325.3, 236.1, -0.03, 0.004, -0.001, 0.0]))
    board = Board("a", 5, 4, 60.0, 60.0)
    rng = np.random.default_rng(3)
    errors: list[np.ndarray] = []
    sigmas: list[np.ndarray] = []
    while len(errors) < 6:
        angle = rng.uniform(0.0, 2.0 * np.pi)
        middle = np.array([325.0 + 156.0 * np.cos(angle), 236.0 + 130.0 * np.sin(angle)])
        placed = place_board(board, camera, middle, 45.0, 50.0, rng)
        if placed is None or not placed.see(camera, Rigid3.identity())[1].all():
            continue
        image = render(
            [placed],
            camera,
            Rigid3.identity(),
            optics=Optics(0.7, field_deg=190.0),
            photometry=Photometry(noise_levels=noise),
            rng=rng,
        )
        truth = placed.see(camera, Rigid3.identity())[0]
        (found,) = detect_boards(image, [board])
        assert len(found.pixels) == 20
        nearest = np.linalg.norm(found.pixels[:, None] - truth, axis=2).argmin(axis=1)
        errors.append(found.pixels - truth[nearest])
        sigmas.append(found.sigma_px)
    every = np.concatenate(errors)
    if noise == 0.0:
        assert np.sqrt((every**2).sum(axis=1).mean()) < MAX_PX
    else:
        ratio = np.sqrt(np.mean((every / np.concatenate(sigmas)[:, None]) ** 2))
        assert SIGMA_BAND[0] < ratio < SIGMA_BAND[1]
