"""Model inadequacy in the uncertainty of the projection: inside the covered part of the image and outside."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.calibration_scenes import REACH_DEG, SIZE, lens, random_views

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.certainty.coverage import covered_by_boards
from rigkit.calibration.certainty.departures import Departures
from rigkit.calibration.certainty.uncertainty import Along, FarProjection, projection_uncertainty
from rigkit.calibration.result import Calibration
from rigkit.cameras.base import Camera
from rigkit.cameras.compare import best_rotation, grid_pixels
from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.io.calibrations.calibration_file import load_calibration, save_calibration
from rigkit.kernels.departures import DISPLACEMENTS, displacements

NOISE_PX = 0.02


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values)))


def errors_and_sigmas(
    found: Calibration, truth: Camera, departs: FloatArray | None = None
) -> tuple[BoolArray, FloatArray, FloatArray, FloatArray]:
    """Return over the image: where boards were, squared errors after the best rotation there, what is stated for them,
    and what of that is stated for the parameters alone. The lens is `truth` with the displacements `departs` (J,)."""
    pixels = grid_pixels(SIZE, (24, 18)).reshape(-1, 2)
    rays, known = truth.unproject(pixels if departs is None else pixels - departed(pixels, departs))
    inside = known & (rays[:, 2] > np.cos(np.radians(85.0))) & found.camera.unproject(pixels)[1]
    pixels, rays = pixels[inside], rays[inside]
    covered = covered_by_boards(found, pixels)
    turn = best_rotation(rays[covered], pixels[covered], np.ones(int(covered.sum())), found.camera)
    error = ((found.camera.project(rays @ turn.T)[0] - pixels) ** 2).sum(axis=-1)
    stated = projection_uncertainty(found, pixels).covariance.trace(axis1=1, axis2=2)
    beyond = FarProjection.of(found).beyond_model(Along.of(found.camera, found.camera.unproject(pixels)[0]))
    return covered, error, stated, stated - beyond.trace(axis1=1, axis2=2)


def departed(pixels: FloatArray, amounts: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("ijn,j->ni", displacements(pixels, SIZE), amounts))


def test_displacements_are_of_one_pixel_in_the_corners() -> None:
    corners = np.array([[-0.5, -0.5], [SIZE[0] - 0.5, -0.5], [SIZE[0] - 0.5, SIZE[1] - 0.5]])
    size = np.linalg.norm(displacements(corners, SIZE), axis=0)
    assert size.shape == (DISPLACEMENTS, 3)
    assert (size > 0.5).all() and (size < 3.1).all()


def test_model_inadequacy_widens_the_projection_uncertainty() -> None:
    """Decentring, which the model lacks: the parameters alone say too little, together they say what it is."""
    truth, departs, ratios = lens("fish"), np.zeros(DISPLACEMENTS), []
    departs[5:7] = 0.3, -0.2
    for seed in range(4):
        rng = np.random.default_rng(seed)
        views, _, _ = random_views(truth, 20, rng, reach_deg=80.0, noise_px=NOISE_PX)
        views = [replace(view, pixels=view.pixels + departed(view.pixels, departs)) for view in views]
        found = calibrate(views, SIZE, model="kannala_brandt", board="flat", folds=0)
        covered, error, stated, alone = errors_and_sigmas(found, truth, departs)
        ratios.append([rms(error[covered]) / rms(stated[covered]), rms(error[covered]) / rms(alone[covered])])
    now, before = np.exp(np.log(ratios).mean(axis=0))
    assert before > 2.0
    assert 0.6 < now < 1.3


def test_departures_are_no_noise_of_corners_or_images() -> None:
    """Decentring makes corners less sure than they are, and images disagree; it is stated once, as a departure."""
    departs, found = np.zeros(DISPLACEMENTS), []
    departs[5:7] = 0.3, -0.2
    for amounts in (np.zeros(DISPLACEMENTS), departs):
        views, _, _ = random_views(lens("fish"), 20, np.random.default_rng(3), reach_deg=80.0, noise_px=NOISE_PX)
        views = [replace(view, pixels=view.pixels + departed(view.pixels, amounts)) for view in views]
        found.append(calibrate(views, SIZE, model="kannala_brandt", board="flat", folds=0))
    central, decentred = found
    assert decentred.sigma_px > 1.03 * NOISE_PX and decentred.overdispersion > 2.0
    plain, given = (Departures.of(one) for one in found)
    for one in (plain, given):
        assert one.noise.sigma_px == pytest.approx(NOISE_PX, rel=0.04)
        assert one.noise.overdispersion < 1.25
    # The parameters are nearly as sure as those of the lens without departures, and the amounts are found.
    p = central.camera.parameters.size
    as_calibrated = np.sqrt(np.diag(decentred.covariance) / np.diag(central.covariance))
    known = np.sqrt(np.diag(given.near_covariance) / np.diag(plain.near_covariance))[:p]
    assert as_calibrated.min() > 2.0 and known.min() > 0.8 and known.max() < 1.6
    assert np.linalg.eigvalsh(given.near_covariance / np.sqrt(np.outer(*[np.diag(given.near_covariance)] * 2)))[0] > 0.0
    assert np.linalg.norm(given.mean[5:7]) > 0.1 > np.linalg.norm(plain.mean[5:7])


def test_a_lens_that_is_its_model_is_hardly_less_sure(rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("fish"), 30, rng, reach_deg=REACH_DEG["fish"], noise_px=0.1)
    found = calibrate(views, SIZE, model="kannala_brandt", board="flat", folds=0)
    covered, _, stated, alone = errors_and_sigmas(found, lens("fish"))
    assert rms(stated[covered]) < 1.2 * rms(alone[covered])


def test_rival_models_widen_the_uncertainty_where_no_board_was(tmp_path: Path) -> None:
    """Boards in the left half alone: to the right the polynomial may be of any degree."""
    truth, differ = lens("fish"), []
    for seed in range(6):
        views, _, _ = random_views(truth, 60, np.random.default_rng(seed), reach_deg=85.0, noise_px=0.1)
        views = [view for view in views if view.pixels[:, 0].max() < 0.5 * SIZE[0]][:12]
        found = calibrate(views, SIZE, model="scaramuzza", board="flat")
        covered, error, stated, alone = errors_and_sigmas(found, truth)
        differ.append([rms(part[~covered]) for part in (error, stated, alone)])
        if seed == 0:
            save_calibration(tmp_path / "c.json", found)
            again = errors_and_sigmas(load_calibration(tmp_path / "c.json"), truth)[2]
            assert again == pytest.approx(stated, rel=1e-6)
    error_px, stated_px, alone_px = np.array(differ).T
    assert (stated_px > alone_px).any()
    assert (error_px < 4.0 * stated_px).all()
    assert 0.2 < np.exp(np.log(error_px / stated_px).mean()) < 1.4


def test_what_tells_nothing_leaves_all_open(rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("reg"), 8, rng, reach_deg=REACH_DEG["reg"])
    found = calibrate(views, SIZE, model="brown", board="flat", folds=0)
    none = replace(found, views=tuple(replace(v, kept=np.zeros_like(v.kept)) for v in found.views))
    parameters = np.array(found.camera.parameters)
    parameters[4] = -9e14
    far = replace(found, camera=found.camera.with_parameters(parameters))
    sizes = [np.sqrt(np.diag(Departures.of(one).covariance)) for one in (found, none, far)]
    assert np.isfinite(sizes).all()
    # Of all sizes beforehand the largest weigh most.
    assert sizes[1] == pytest.approx(sizes[1][0]) and 0.1 < sizes[1][0] < 0.5
    assert sizes[0].min() < 0.5 * sizes[1][0]
