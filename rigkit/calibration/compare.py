"""Two calibrations: is their difference what their uncertainties predict, or are these two cameras?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.calibration.result import Calibration
from rigkit.calibration.uncertainty import projection_design, projection_uncertainty
from rigkit.cameras.base import Camera
from rigkit.cameras.compare import CameraDifference, compare_cameras
from rigkit.cameras.convert import refit_camera
from rigkit.core.arrays import FloatArray, Pixels

__all__ = ["CalibrationComparison", "compare_calibrations"]

SAMPLES = 2000
"""Draws of the null distribution: the chance is then known to 0.005 near 0.05."""
REFIT_SIGMA = 0.5
"""What the models make of one lens is known from a refit to about half: poses and noise had their part in the fits."""
SAME_CHANCE = 0.01
"""A difference this unlikely for one and the same camera makes it two."""


@dataclass(frozen=True, eq=False, slots=True)
class CalibrationComparison:
    """The difference of two calibrations beside what their uncertainties predict.

    Attributes
    ----------
    difference : over the image, after the best rotation.
    predicted_px : (rows, columns) predicted rms difference of two calibrations of one camera, NaN where not covered.
    ratio : rms over the image of difference / predicted: about 1 for one and the same camera in one model.
    chance : probability of a ratio at least this large if both were calibrations of the same, unchanged camera, each in
        its own model.
    same_model : both are of one model and size.
    """

    difference: CameraDifference
    predicted_px: FloatArray
    ratio: float
    chance: float
    same_model: bool

    @property
    def same(self) -> bool:
        return self.chance >= SAME_CHANCE


def compare_calibrations(
    a: Calibration, b: Calibration, *, grid: tuple[int, int] = (40, 30), seed: int = 0
) -> CalibrationComparison:
    """Compare two calibrations over the image of `a`.

    Raises InputError or DegenerateError where the images differ in size or the cameras share no view.

    Notes
    -----
    The null distribution of the ratio is sampled: both calibrations' errors are drawn from their covariances, turned
    into differences over the image by the projection's derivatives, and the best rotation is taken out of each with the
    same weights as it is taken out of the difference found. Models of different kinds or sizes show one lens
    differently, which no covariance knows: that difference, from each camera refitted as the other is modelled, is a
    part of the null.
    """
    difference = compare_cameras(a.camera, b.camera, grid=grid)
    # The rotation is fitted where both calibrations know what they say: extrapolated corners must not turn it.
    weights = np.zeros(difference.covered.shape)
    weights[difference.covered] = 1.0 / _variance(a, b, difference)[0]
    difference = compare_cameras(a.camera, b.camera, grid=grid, weights=weights)
    covered = difference.covered
    pixels = difference.pixels[covered]
    variance, seen = _variance(a, b, difference)
    found = float(np.mean((difference.difference_px[covered] ** 2).sum(axis=-1) / variance))
    # The rotation that the comparison fits, at first order. In two calibrations of one camera both are the same.
    root = np.repeat(1.0 / np.sqrt(variance), 2)[:, None]
    designs = _design(a, pixels), _design(b, seen)
    turn = root * np.concatenate([design[:, -3:] for design in designs], axis=1)
    rng = np.random.default_rng(seed)
    drawn = root * (_draw(a, designs[0], rng) - _draw(b, designs[1], rng))
    by_model = root * _by_model(a, b, difference)[:, None]
    if by_model.any():
        drawn += by_model * (1.0 + REFIT_SIGMA * rng.normal(size=SAMPLES))
    drawn = drawn - turn @ np.linalg.lstsq(turn, drawn, rcond=None)[0]
    null = (drawn.reshape(len(pixels), 2, SAMPLES) ** 2).sum(axis=1).mean(axis=0)
    predicted = np.full(covered.shape, np.nan)
    predicted[covered] = np.sqrt(variance)
    chance = float((1 + np.count_nonzero(null >= found)) / (SAMPLES + 1))
    return CalibrationComparison(
        difference, predicted, float(np.sqrt(found)), chance, _kind(a.camera) == _kind(b.camera)
    )


def _by_model(a: Calibration, b: Calibration, difference: CameraDifference) -> FloatArray:
    """Return the difference (2 M,), px at the covered pixels, that the two models alone make of one lens."""
    pixels = difference.pixels[difference.covered]
    out = np.zeros((len(pixels), 2))
    if _kind(a.camera) == _kind(b.camera):
        return out.reshape(-1)
    for sign, lens, like, like_from_lens in ((1.0, a, b, difference.b_from_a), (-1.0, b, a, difference.b_from_a.T)):
        # The lens in the other's model, fitted as that was: where that had its corners.
        at = np.concatenate([view.pixels for view in like.views])
        rays, valid = lens.camera.unproject(at)
        refitted = refit_camera(like.camera, rays[valid] @ like_from_lens.T, at[valid])
        projected, valid = refitted.project(_rays(lens, pixels) @ like_from_lens.T)
        out += sign * np.where(valid[:, None], projected - pixels, 0.0)
    return out.reshape(-1)


def _kind(camera: Camera) -> tuple[str, int]:
    return camera.model, camera.parameters.size


def _variance(a: Calibration, b: Calibration, difference: CameraDifference) -> tuple[FloatArray, Pixels]:
    """Return the predicted variance (M,) of the difference at the covered pixels, and the pixels in `b`."""
    pixels = difference.pixels[difference.covered]
    seen, _ = b.camera.project(_rays(a, pixels) @ difference.b_from_a.T)
    covariance = projection_uncertainty(a, pixels).covariance + projection_uncertainty(b, seen).covariance
    return np.trace(covariance, axis1=-2, axis2=-1), seen


def _rays(calibration: Calibration, pixels: Pixels) -> FloatArray:
    return calibration.camera.unproject(pixels)[0]


def _design(calibration: Calibration, pixels: Pixels) -> FloatArray:
    """Return d pixel / d (parameters, turn of the rays), (2 N, P + 3)."""
    design = projection_design(calibration.camera, _rays(calibration, pixels))
    return design.transpose(2, 0, 1).reshape(2 * len(pixels), -1)


def _draw(calibration: Calibration, design: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return errors of the projection (2 N, SAMPLES), drawn from the calibration's covariance."""
    count = design.shape[1]
    covariance = calibration.frame_covariance[:count, :count]
    # Scaled to correlations first: parameters differ by twenty orders of magnitude.
    sigma = np.sqrt(np.diag(covariance))
    safe = np.where(sigma > 0.0, sigma, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(safe, safe))
    root = safe[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(design @ root @ rng.normal(size=(count, SAMPLES)))
