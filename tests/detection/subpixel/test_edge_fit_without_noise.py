"""Predicted sigmas of corners in images without noise: those of rounding to whole grey levels, if values are whole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from detection_bench.scenes import BENCH_PHOTOMETRY, three_boards
from detection_bench.score import FoundBoard, Score, score
from kernels.reference import edges as reference

from rigkit.cameras.pinhole import Pinhole
from rigkit.core.boards import Board
from rigkit.detection.detect import detect_boards
from rigkit.detection.subpixel import edge_fit
from rigkit.detection.subpixel.edge_fit import ROUNDING_VARIANCE, fit_edges
from rigkit.detection.subpixel.edge_model import Geometry
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.synthetic.photometry import Photometry, develop
from rigkit.synthetic.render import Optics, radiance
from rigkit.synthetic.scene import PlacedBoard

ASKED_REL = 0.2
"""Asked of predicted sigmas over blur and noise; what the model itself leaves out is a third of the errors here."""


def upright() -> tuple[np.ndarray, np.ndarray, Geometry]:
    """Return a sharp, evenly lit board's picture of 0 to 1, its corners, and its squares' shape."""
    camera = Pinhole((200, 180), np.array([300.0, 300.0, 99.3, 89.8]))
    rotation = exp_so3(np.array([0.0, 0.0, 0.3]))
    pose = Rigid3(rotation, np.array([0.0, 0.0, 600.0]) - rotation @ [100.0, 75.0, 0.0])
    placed = PlacedBoard(Board("a", 5, 4, 50.0, 50.0), pose, 0.5)
    picture = radiance([placed], camera, Rigid3.identity(), optics=Optics(0.4))
    pixels, _ = placed.see(camera, Rigid3.identity())
    count = len(pixels)
    sides = np.broadcast_to(25.0 * rotation[:2, :2].T, (count, 2, 2)).copy()
    gaps, ends = np.full((count, 2, 2), 25.0), np.zeros((count, 2, 2), bool)
    return picture, pixels, Geometry(sides, np.zeros((count, 2)), gaps, ends)


@pytest.mark.parametrize("compiled", [True, False])
def test_rounding_is_the_least_noise_of_whole_grey_levels_only(compiled: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not compiled:
        monkeypatch.setattr(edge_fit, "fit_corners", reference.fit_corners)
    picture, pixels, shape = upright()
    whole = develop(picture, Photometry(exposure=0.95))
    finer = (develop(picture, Photometry(exposure=0.95, bits=16)) / 257.0).astype(np.float32)
    noises = []
    for image in (whole, whole.astype(np.float32), finer):
        start, expected = np.ones(len(pixels)), np.full(len(pixels), 0.5)
        fit = fit_edges(image, pixels, shape, start, expected, radius_px=18.0, iterations=12)  # type: ignore[arg-type]
        assert fit.valid.all()
        noises.append(fit.noise**2)
    assert noises[0].min() >= 0.999 * ROUNDING_VARIANCE
    assert noises[1].min() < 0.9 * ROUNDING_VARIANCE, "the levels leave less in this picture than they do at its edges"
    assert noises[2].max() < 0.5 * ROUNDING_VARIANCE


@pytest.mark.parametrize("blur_px", [0.7, 1.0])
def test_predicted_sigmas_without_noise(blur_px: float) -> None:
    scores = []
    for seed in range(3):
        scene = three_boards(np.random.default_rng(seed))
        image = develop(scene.radiance(Optics(blur_px)), replace(BENCH_PHOTOMETRY, noise_levels=0.0))
        scores.append(score(scene, [FoundBoard.of(d) for d in detect_boards(image)]))
    assert abs(Score.sum(scores).actual_over_predicted - 1.0) < ASKED_REL
