"""Scatter of the corners of a board about the image of a flat board through any central lens with radial distortion."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.optim.batched import BatchedProblem, Values, minimise_each
from rigkit.optim.damping import Damping, Stop

PARAMETERS = 13
"""Homography to the directions of rays (8), principal point (2), focal length, two terms of the angle's series."""
FOCAL_STARTS = 0.6, 1.5
"""Focal lengths, in half extents of the board's image, from which the fit starts: most of 180 degrees, and a fifth."""
STEP = 1e-6
"""Change of a parameter for derivatives; parameters are of order 1."""
DAMPING, STOP = Damping(start=1e-3, ceiling=1e6), Stop(steps=60, gain=1e-3, predicted_gain=1e-4)
"""A cost within a thousandth of its minimum changes sigmas by less."""


def lens_scatter(pixels: FloatArray, sigma_px: FloatArray) -> float:
    """Return the rms residual of the corners (R, C, 2), NaN where unknown, in sigmas (R, C), about the best lens.

    Infinite with too few corners. The corners' scatter is never more than it, whether or not the fit has converged.
    """
    known = np.isfinite(pixels[..., 0])
    row, column = np.nonzero(known)
    if len(row) < PARAMETERS + 2:
        return np.inf
    grid = np.stack([column, row], axis=-1) - 0.5 * np.array([pixels.shape[1] - 1, pixels.shape[0] - 1])
    grid /= np.abs(grid).max()
    seen = pixels[known] - pixels[known].mean(axis=0)
    extent = float(np.abs(seen).max())
    seen, weight = seen / extent, extent / sigma_px[known][:, None]
    flat = np.linalg.lstsq(np.c_[grid, np.ones(len(grid))], seen, rcond=None)[0][:2].T
    start = np.zeros((len(FOCAL_STARTS), PARAMETERS))
    for own, focal in zip(start, FOCAL_STARTS, strict=True):
        own[[0, 1, 3, 4]], own[10] = flat.ravel() / focal, np.log(focal)

    def residuals(state: FloatArray) -> FloatArray:
        return np.asarray(weight * (_imaged(grid, state) - seen)).reshape(*state.shape[:-1], -1)

    def linearise(values: Values) -> BatchedProblem:
        moved = values[0][:, None] + STEP * np.eye(PARAMETERS + 1, PARAMETERS, -1)
        every = residuals(moved)
        left, jacobian = every[:, 0], (every[:, 1:] - every[:, :1]) / STEP
        return BatchedProblem(
            jacobian @ jacobian.swapaxes(1, 2), -np.einsum("kun,kn->ku", jacobian, left), (left**2).sum(axis=-1)
        )

    # A step too far is refused for its cost.
    with np.errstate(over="ignore", invalid="ignore"):
        _, cost = minimise_each((start,), linearise, lambda values, step: (values[0] + step,), DAMPING, STOP)
    return float(np.sqrt(cost.min() / (2 * len(row) - PARAMETERS)))


def _imaged(grid: FloatArray, state: FloatArray) -> FloatArray:
    """Return the images (..., N, 2) of points (N, 2) of a board through lenses of PARAMETERS (..., 13)."""
    lines = state[..., :6].reshape(*state.shape[:-1], 2, 3)
    across = grid @ lines[..., :2].swapaxes(-1, -2) + lines[..., None, :, 2]
    tangent = np.linalg.norm(across, axis=-1)
    angle = np.arctan2(tangent, 1.0 + (grid @ state[..., 6:8, None])[..., 0])
    focal, third, fifth = np.exp(state[..., 10, None]), state[..., 11, None], state[..., 12, None]
    radius = focal * angle * (1.0 + third * angle**2 + fifth * angle**4)
    scale = np.where(tangent > 0.0, radius / np.maximum(tangent, np.finfo(float).tiny), focal)
    return np.asarray(state[..., None, 8:10] + scale[..., None] * across)
