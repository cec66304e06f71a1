"""Boards that are not flat: the shape is found, chosen by held-out error, and costs nothing on a flat board."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.calibration_scenes import (
    BOARD,
    REACH_DEG,
    SIZE,
    heldout,
    lens,
    projection_difference,
    random_views,
    with_outliers,
)

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.solving.evidence import fit_shapes
from rigkit.calibration.solving.fit import fit_model
from rigkit.calibration.views.observations import Observations
from rigkit.cameras.brown import Brown

BOW_LIMIT_PX = 0.38
"""Bow of 1.0 and 0.5 mm, 2 % outliers of 8 px, 40 views: RMS difference to the true lens. Measured 0.16; with a flat
board assumed 10."""
BUMPS_LIMIT_PX = 0.30
"""Bumps of 0.3 mm and 0.03 mm print error, 40 views. Measured 0.14 released, 0.21 warped, 0.46 flat."""
FLAT_FACTOR = 1.5
"""What releasing a flat board may cost in accuracy: chance, measured 0.7 to 1.1."""
STRAY_MM, UNEVEN_MM = 0.05, 0.2
"""In the plane: print error of single corners, and a feed that runs unevenly, at the rim of the board."""


def normalised() -> tuple[np.ndarray, np.ndarray]:
    points = BOARD.points()
    centred = points - points.mean(axis=0)
    return 2.0 * centred[:, 0] / np.ptp(points[:, 0]), 2.0 * centred[:, 1] / np.ptp(points[:, 1])


def bowed() -> np.ndarray:
    x, y = normalised()
    points = BOARD.points()
    points[:, 2] = 1.0 * (1.0 - x**2) + 0.5 * (1.0 - y**2)
    return points


def bumpy(rng: np.random.Generator) -> np.ndarray:
    x, y = normalised()
    points = BOARD.points() + 0.03 * rng.normal(size=(BOARD.corner_count, 3))
    points[:, 2] += 0.3 * np.sin(2.5 * x + 1.0) * np.cos(3.0 * y + 0.5)
    return points


def difference(camera: object, name: str) -> float:
    away = projection_difference(camera, lens(name), 0.95 * REACH_DEG[name])  # type: ignore[arg-type]
    return float(np.sqrt((away**2).mean()))


@pytest.mark.parametrize(("name", "model"), [("reg", "brown"), ("fish", "kannala_brandt")])
def test_bowed_board_with_outliers(name: str, model: str, rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens(name), 40, rng, reach_deg=REACH_DEG[name], points_mm=bowed())
    views = with_outliers(views, 0.02, 8.0, rng)
    result = calibrate(views, SIZE, model=model)
    assert result.boards[0].kind != "flat"
    assert difference(result.camera, name) < BOW_LIMIT_PX
    assert result.boards[0].bow_mm == pytest.approx(np.ptp(bowed()[:, 2]) / 2.0, rel=0.5)


def test_bumpy_board_is_released(rng: np.random.Generator) -> None:
    points = bumpy(rng)
    views, _, _ = random_views(lens("reg"), 40, rng, reach_deg=REACH_DEG["reg"], points_mm=points)
    result = calibrate(views, SIZE, model="brown")
    assert result.boards[0].kind == "released"
    assert difference(result.camera, "reg") < BUMPS_LIMIT_PX
    flat = calibrate(views, SIZE, model="brown", board="flat")
    assert heldout(result) < 0.9 * heldout(flat)
    # Heights of the corners, up to the plane that a pose can absorb.
    design = np.column_stack([BOARD.points()[:, :2], np.ones(BOARD.corner_count)])
    heights = [
        p[:, 2] - design @ np.linalg.lstsq(design, p[:, 2], rcond=None)[0] for p in (points, result.boards[0].points_mm)
    ]
    assert np.corrcoef(*heights)[0, 1] > 0.9


def test_a_flat_board_stays_flat_and_releasing_it_does_no_harm(rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("fish"), 30, rng, reach_deg=92.5)
    chosen = calibrate(views, SIZE, model="kannala_brandt")
    assert chosen.boards[0].kind == "flat"
    assert any("not tried: residuals of the warp" in c.reason for c in chosen.candidates)
    released = calibrate(views, SIZE, model="kannala_brandt", board="released")
    assert difference(released.camera, "fish") < FLAT_FACTOR * difference(chosen.camera, "fish")


def test_prior_of_released_corners_is_as_wide_as_they_stray(rng: np.random.Generator) -> None:
    points = BOARD.points() + STRAY_MM * rng.normal(size=(BOARD.corner_count, 3)) * [1.0, 1.0, 0.0]
    views, _, _ = random_views(lens("reg"), 40, rng, reach_deg=REACH_DEG["reg"], points_mm=points)
    observations = Observations.from_views(views)
    flat = fit_model(observations, SIZE, Brown, 5)
    inner = np.flatnonzero(((BOARD.grid() > 0) & (BOARD.grid() < [8, 5])).all(axis=1))
    shape = fit_shapes(observations, flat, "released")["released"].state.shape
    sizes = shape.sigma[shape.basis.shape[-1] :].reshape(-1, 3)[inner]
    # 56 coordinates know their scatter to 10 %.
    assert sizes[:, :2] == pytest.approx(STRAY_MM, rel=0.3)
    assert sizes[:, 2].max() < STRAY_MM
    exact, _, _ = random_views(lens("reg"), 40, rng, reach_deg=REACH_DEG["reg"])
    observations = Observations.from_views(exact)
    held = fit_shapes(observations, fit_model(observations, SIZE, Brown, 5), "released")["released"]
    assert np.abs(held.state.shape.points(held.state.unknowns) - BOARD.points()).max() < STRAY_MM


def test_uneven_feed_is_part_of_the_warp(rng: np.random.Generator) -> None:
    points = BOARD.points()
    points[:, 1] += UNEVEN_MM * normalised()[1] ** 2
    views, _, _ = random_views(lens("reg"), 40, rng, reach_deg=REACH_DEG["reg"], points_mm=points)
    result = calibrate(views, SIZE, model="brown")
    assert result.boards[0].kind == "warp"
    assert heldout(result) < 0.9 * heldout(calibrate(views, SIZE, model="brown", board="flat"))


def test_corners_that_scatter_more_at_the_rim_are_no_outliers(rng: np.random.Generator) -> None:
    camera = lens("fish")
    views, _, _ = random_views(camera, 40, rng, reach_deg=REACH_DEG["fish"], noise_px=0.1)
    rough = []
    for view in views:
        away = np.linalg.norm(view.pixels - camera.project(np.array([0.0, 0.0, 1.0]))[0], axis=1)
        noise = 0.4 * np.clip((away - 250.0) / 350.0, 0.0, 1.0)[:, None] * rng.normal(size=view.pixels.shape)
        rough.append(replace(view, pixels=np.clip(view.pixels + noise, 0.0, np.array(SIZE) - 1.0)))
    result = calibrate(rough, SIZE, model="kannala_brandt", board="flat")
    assert len(result.outliers) < 0.02 * result.corner_count
    wrong = with_outliers(rough, 0.02, 8.0, rng)
    count = sum(int((a.pixels != b.pixels).any(axis=1).sum()) for a, b in zip(rough, wrong, strict=True))
    found = calibrate(wrong, SIZE, model="kannala_brandt", board="flat").outliers
    assert len(found) == pytest.approx(count, rel=0.1)
