"""How far a calibrated projection may be off, over the image, in pixels.

The covariance of the parameters alone says too much: a changed principal point and a turned camera are the same image
of the world. What counts is where a point that is fixed to the boards appears. The boards' solved motions, averaged,
are the motion of the world (W, T) that goes with a change dk of the parameters, and

    dq = d q / d k  dk + d q / d x (W x x + T)

has the covariance M F M^T, with F the joint covariance of (k, W, T) (`Calibration.frame_covariance`).

Reference: D. Kogan, mrcal, "Projection uncertainty" (the mean over the frames is the same; here in closed form).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.arrays import BoolArray, FloatArray, Pixels
from rigkit.calibration.result import Calibration

__all__ = ["Uncertainty", "projection_uncertainty", "uncertainty_at_corners", "uncertainty_map"]

CORNERS = 400
"""So many corners, spread over all views, are enough to see how sure the projection is where the boards were."""


@dataclass(frozen=True, eq=False, slots=True)
class Uncertainty:
    """Covariance of the projection.

    Attributes
    ----------
    pixels : (..., 2) where.
    covariance : (..., 2, 2) px^2, NaN where the pixel has no ray.
    valid : (...,)
    """

    pixels: Pixels
    covariance: FloatArray
    valid: BoolArray

    @property
    def worst_px(self) -> FloatArray:
        """Standard deviation in the worst direction, (...,) px, NaN where invalid."""
        a, b, c = self.covariance[..., 0, 0], self.covariance[..., 0, 1], self.covariance[..., 1, 1]
        return np.sqrt(0.5 * (a + c) + np.hypot(0.5 * (a - c), b))


def projection_uncertainty(calibration: Calibration, pixels: Pixels, *, range_mm: float = np.inf) -> Uncertainty:
    """Return the uncertainty of the projection at `pixels` (..., 2) of points `range_mm` away (infinity by default)."""
    camera = calibration.camera
    pixels = np.asarray(pixels, dtype=np.float64)
    rays, valid = camera.unproject(pixels)
    flat = np.where(valid[..., None], rays, [0.0, 0.0, 1.0]).reshape(-1, 3)
    _, _, by_point, by_camera = camera.project_with_jacobians(flat)
    # Unknowns first, pixels last: one matrix product for each coordinate. At infinity the world's shift shows nothing.
    p = by_camera.shape[-1]
    count = p + 3 if np.isinf(range_mm) else p + 6
    design = np.empty((2, count, len(flat)))
    design[:, :p] = np.moveaxis(by_camera, 0, -1)
    ray, by_x = flat.T, np.moveaxis(by_point, 0, -1)
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        design[:, p + k] = ray[i] * by_x[:, j] - ray[j] * by_x[:, i]
    if count > p + 3:
        design[:, p + 3 :] = by_x / range_mm
    moved = calibration.frame_covariance[:count, :count] @ design
    covariance = np.empty((len(flat), 2, 2))
    for i, j in ((0, 0), (0, 1), (1, 1)):
        covariance[:, i, j] = covariance[:, j, i] = np.einsum("kn,kn->n", design[i], moved[j])
    covariance = covariance.reshape(*valid.shape, 2, 2)
    return Uncertainty(pixels, np.where(valid[..., None, None], covariance, np.nan), valid)


def uncertainty_at_corners(calibration: Calibration) -> FloatArray:
    """Return the standard deviation in the worst direction, (M,) px, at up to 400 of the corners used."""
    kept = np.concatenate([view.kept for view in calibration.views])
    pixels = np.concatenate([view.pixels for view in calibration.views])[kept]
    chosen = np.linspace(0, len(pixels) - 1, min(CORNERS, len(pixels))).astype(np.int64)
    return projection_uncertainty(calibration, pixels[chosen]).worst_px


def uncertainty_map(
    calibration: Calibration, *, grid: tuple[int, int] = (40, 30), range_mm: float = np.inf
) -> Uncertainty:
    """Return the uncertainty over the image at `grid` (columns, rows) pixels, as arrays (rows, columns, ...)."""
    width, height = calibration.camera.size_px
    u, v = np.meshgrid(np.linspace(0.0, width - 1.0, grid[0]), np.linspace(0.0, height - 1.0, grid[1]))
    return projection_uncertainty(calibration, np.stack([u, v], axis=-1), range_mm=range_mm)
