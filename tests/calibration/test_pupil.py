"""A lens that does not look from one point is told from one that does, and by how much what is far away is off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.calibration_scenes import REACH_DEG, SIZE, lens, random_views

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.coverage import covered_by_boards
from rigkit.calibration.judging.changing import changing
from rigkit.calibration.judging.pupil import BY_CHANCE, MovingPupil
from rigkit.calibration.judging.verdicts import judge
from rigkit.calibration.neighbours import neighbour_correlation
from rigkit.calibration.result import Calibration
from rigkit.calibration.uncertainty import FarProjection
from rigkit.cameras.compare import best_rotation, grid_pixels
from rigkit.core.arrays import FloatArray, Points
from rigkit.core.boards import Board

NEAR, FAR = Board("near", 9, 6, 12.0, 12.0), Board("far", 9, 6, 120.0, 120.0)
"""They fill the image at 90 to 210 mm, and at ten times that."""
MM_PER_RAD2, NOISE_PX = 1.5, 0.03
TOLD = "the lens does not look from one point"


def from_the_pupil(points_mm: Points, mm_per_rad2: float) -> Points:
    """Return points as they lie before a pupil that moves forward by so much times the squared angle at which it sees
    them."""
    seen = np.array(points_mm, dtype=np.float64)
    for _ in range(20):
        angle = np.arctan2(np.hypot(seen[..., 0], seen[..., 1]), seen[..., 2])
        seen[..., 2] = points_mm[..., 2] - mm_per_rad2 * angle**2
    return seen


def session(board: Board, mm_per_rad2: float, seed: int, shape: str = "flat") -> Calibration:
    """Return a calibration from 20 images of a fisheye with such a pupil."""
    rng, camera = np.random.default_rng(seed), lens("fish")
    views, turns, shifts = random_views(camera, 20, rng, reach_deg=80.0, board=board, noise_px=0.0)
    noisy = []
    for view, turn, shift in zip(views, turns, shifts, strict=True):
        pixels, valid = camera.project(from_the_pupil(board.points() @ turn.T + shift, mm_per_rad2))
        assert valid.all()
        pixels = np.clip(pixels + NOISE_PX * rng.normal(size=pixels.shape), -0.5, np.array(SIZE) - 0.5)
        noisy.append(replace(view, pixels=pixels, sigma_px=np.full(len(pixels), NOISE_PX)))
    return calibrate(noisy, SIZE, model="kannala_brandt", board=shape, folds=0)


def pupil_of(found: Calibration) -> MovingPupil:
    pupil = MovingPupil.of(found)
    assert pupil is not None
    return pupil


def off_far_away(found: Calibration) -> float:
    """Return by how much (rms px where boards were) the lens projects what is far away elsewhere than it should."""
    pixels = grid_pixels(SIZE, (24, 18)).reshape(-1, 2)
    rays, valid = lens("fish").unproject(pixels)
    inside = valid & covered_by_boards(found, pixels)
    rays, pixels = rays[inside], pixels[inside]
    turn = best_rotation(rays, pixels, np.ones(len(rays)), found.camera)
    error: FloatArray = found.camera.project(rays @ turn.T)[0] - pixels
    return float(np.sqrt((error**2).sum(axis=-1).mean()))


@pytest.mark.parametrize("shape", ["flat", "released"])
def test_a_pupil_that_moves_is_found_and_what_it_does_far_away(shape: str) -> None:
    """Half of it, and no more than there is: corners that fit least are left out, and boards of free shape follow."""
    found = session(NEAR, MM_PER_RAD2, 0, shape)
    assert found.verdicts[0].message.startswith("training RMS") and TOLD in found.verdicts[0].message
    # The images all say the same: that something differs between them would be another cause.
    said = judge(found, in_force=("model", "board_shape"))
    assert not any("something differs between images" in one.message for one in said)
    pupil, true = pupil_of(found), off_far_away(found)
    assert 0.4 * MM_PER_RAD2 < pupil.mm_per_rad2 < 1.1 * MM_PER_RAD2
    assert true > 1.0
    assert 0.35 * true < pupil.far_px(FarProjection.of(found)) < 1.1 * true


def test_a_lens_that_looks_from_one_point_is_not_accused() -> None:
    for seed in range(4):
        found = session(NEAR, 0.0, seed)
        assert TOLD not in str(found.verdicts)
        pupil = pupil_of(found)
        assert pupil.chance > BY_CHANCE
        assert abs(pupil.mm_per_rad2) < 0.1


@pytest.mark.parametrize("model", ["pinhole", "ucm"])
def test_a_lens_unlike_its_model_is_no_pupil_that_moves(model: str, rng: np.random.Generator) -> None:
    """What no parameter follows is there at all distances alike."""
    views = random_views(lens("reg"), 20, rng, reach_deg=REACH_DEG["reg"], noise_px=0.05)[0]
    found = calibrate(views, SIZE, model=model, board="flat", folds=0)
    assert found.rms_px > 0.1
    assert TOLD not in str(found.verdicts)


def test_a_pupil_that_moves_is_not_taken_for_what_changes_from_image_to_image() -> None:
    """A pupil of 4 mm per rad^2 leaves residuals that each image's own shear follows as well as that of a motion."""
    found = session(NEAR, 4.0, 4)
    assert "row by row" in str(changing(found, neighbour_correlation(found)))
    assert TOLD in found.verdicts[0].message and "row by row" not in str(found.verdicts)


def test_boards_far_away_do_not_show_a_pupil_that_moves() -> None:
    found = session(FAR, MM_PER_RAD2, 0)
    assert TOLD not in str(found.verdicts)
    assert off_far_away(found) < 0.2


def test_a_narrow_lens_leaves_its_pupil_open() -> None:
    rng = np.random.default_rng(0)
    views = random_views(lens("reg"), 12, rng, reach_deg=REACH_DEG["reg"], noise_px=0.05)[0]
    found = calibrate(views, SIZE, model="brown", board="flat", folds=0)
    pupil = pupil_of(found)
    assert pupil.sigma_mm_per_rad2 > 0.1 and TOLD not in str(found.verdicts)
