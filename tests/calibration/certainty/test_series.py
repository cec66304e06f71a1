"""Terms that a lens model truncates widen the uncertainty outside the part of the image that boards covered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.calibration_scenes import REACH_DEG, SIZE, lens, random_views

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.certainty.coverage import covered_by_boards
from rigkit.calibration.certainty.departures import amounts_of
from rigkit.calibration.certainty.series import LEFT_OUT
from rigkit.calibration.certainty.uncertainty import FarProjection
from rigkit.calibration.result import Calibration
from rigkit.cameras.compare import best_rotation, grid_pixels
from rigkit.core.arrays import FloatArray
from rigkit.core.detections import BoardView

MIDDLE = 0.7
"""Corners are kept in an ellipse of this part of the image."""
NEAR = 0.25
"""Pixels are judged up to this part of half the diagonal beyond the boards."""


@pytest.fixture(scope="module")
def sessions() -> list[Calibration]:
    """A lens of 110 degrees, of which only the middle was seen: a polynomial of degree four shows all there is."""
    found = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        views, _, _ = random_views(lens("wide"), 20, rng, reach_deg=REACH_DEG["wide"], noise_px=0.01)
        found.append(calibrate(in_middle(views), SIZE, model="scaramuzza", board="flat", folds=0))
    return found


def in_middle(views: list[BoardView]) -> list[BoardView]:
    half = 0.5 * np.array(SIZE)
    out = []
    for view in views:
        inside = np.linalg.norm((view.pixels - half) / half, axis=1) < MIDDLE
        if inside.sum() >= 12:
            grid, pixels, sigma_px = view.grid[inside], view.pixels[inside], view.sigma_px[inside]
            out.append(replace(view, grid=grid, pixels=pixels, sigma_px=sigma_px))
    return out


def beside_the_boards(found: Calibration) -> tuple[FloatArray, FloatArray]:
    """Return rms errors and what is stated for them, (2,) px each: where boards were, and next to that."""
    truth, pixels = lens("wide"), grid_pixels(SIZE, (24, 18)).reshape(-1, 2)
    covered = covered_by_boards(found, pixels)
    off = np.linalg.norm(pixels[:, None] - pixels[covered], axis=-1).min(axis=1) / (0.5 * np.hypot(*SIZE))
    rays = truth.unproject(pixels)[0]
    turn = best_rotation(rays[covered], pixels[covered], np.ones(int(covered.sum())), found.camera)
    error = ((found.camera.project(rays @ turn.T)[0] - pixels) ** 2).sum(axis=-1)
    stated = np.trace(FarProjection.of(found).covariance(found.camera.unproject(pixels)[0]), axis1=1, axis2=2)
    parts = covered, ~covered & (off < NEAR)
    rms = np.array([[np.sqrt(np.mean(values[part])) for part in parts] for values in (error, stated)])
    return rms[0], rms[1]


def test_terms_left_out_are_stated_beyond_the_boards(sessions: list[Calibration]) -> None:
    error, stated = np.array([beside_the_boards(found) for found in sessions]).transpose(1, 0, 2)
    assert found_degree(sessions) <= 6
    # Without the terms left out errors are 4.1 times what is stated next to the boards.
    assert 0.5 < np.exp(np.log(error / stated)[:, 1].mean()) < 2.0
    assert (stated[:, 1] > 3.0 * stated[:, 0]).all()


def found_degree(sessions: list[Calibration]) -> int:
    return max(found.camera.parameters.size - 4 for found in sessions)


def test_terms_left_out_add_little_where_boards_were(sessions: list[Calibration]) -> None:
    for found in sessions:
        with_terms = FarProjection.of(found)
        assert with_terms.remainder is not None
        alone = replace(with_terms, remainder=None)
        assert alone.typical_px <= with_terms.typical_px < 1.3 * alone.typical_px


def test_a_displacement_keeps_the_part_that_images_cannot_determine(sessions: list[Calibration]) -> None:
    """A displacement that no corner shows keeps its variance; of one that no residual bears out little is left."""
    found = sessions[0]

    def fields(design: FloatArray) -> FloatArray:
        bent = np.zeros((2, 2, design.shape[-1]))
        bent[:, 1] = np.sin(np.arange(design.shape[-1]))
        return bent

    amounts = amounts_of(found, fields)
    assert amounts[0, 0] == pytest.approx(1.0)
    assert amounts[1, 1] < 0.05
    assert amounts[0, 1] == pytest.approx(0.0, abs=1e-6)


def test_a_model_without_a_series_has_no_terms_left_out() -> None:
    views, _, _ = random_views(lens("reg"), 10, np.random.default_rng(1), reach_deg=REACH_DEG["reg"], noise_px=0.05)
    for model, series in (("eucm", 0), ("pinhole", 0), ("brown", 3)):
        found = calibrate(views, SIZE, model=model, board="flat", folds=0)
        assert len(found.camera.series) == series
        if not series:
            assert FarProjection.of(found).remainder is None


def test_terms_left_out_are_fields_of_their_own(sessions: list[Calibration]) -> None:
    far = FarProjection.of(sessions[0])
    assert far.remainder is not None
    assert far.remainder.shifts_px(far.corners.design).shape == (LEFT_OUT, len(far.corners.rays), 2)
