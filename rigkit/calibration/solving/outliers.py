"""Outlier rejection: residuals are compared with the scatter in the same part of the image, and with their neighbours
on the board."""

from __future__ import annotations

import numpy as np

from rigkit.calibration.views.observations import Observations
from rigkit.cameras.base import image_center
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, median_of
from rigkit.optim.robust_scale import MEDIAN_OF_RAYLEIGH

OUTLIER_SIGMAS = 5.0
"""A corner is an outlier when its weighted 2-D residual exceeds this many robust standard deviations per coordinate,
sigma = median |r| / 1.177: 4 in a million do by chance."""
MAX_SCATTER_RINGS, RING_CORNERS = 8, 50
"""The scatter increases towards the rim of the image, where squares are small and blurred. So it is estimated in up to
8 rings about the image centre with equally many corners, at least 50 each."""
RING_FACTOR = 4.0
"""Largest scatter of a ring, as a multiple of that of all corners: more is caused by outliers."""
SIGMA_FLOOR_PX = 1e-4
"""Smallest standard deviation: exact corners would be outliers by rounding."""
TURN_SIGMAS = 2.5
"""Residual, in robust standard deviations, of a corner with half its weight in the fit of a field."""
FIELD_NUMBERS, FIELD_ROUNDS, FIELD_RIDGE = 6, 5, 1e-9
"""Coefficients of a quadratic field per axis, rounds of its robust fit, and the ridge of its normal matrix."""


def sigma_of(norm: FloatArray, used: BoolArray | IntArray) -> float:
    """Return the robust standard deviation per coordinate, median |r| / 1.177, of the corners `used`."""
    chosen = norm[used]
    return max(median_of(chosen) / MEDIAN_OF_RAYLEIGH, SIGMA_FLOOR_PX) if chosen.size else SIGMA_FLOOR_PX


def inliers(
    norm: FloatArray,
    observations: Observations,
    sigma_px: float,
    size_px: tuple[int, int],
    px: FloatArray | None = None,
) -> BoolArray:
    """Return the inliers (V, C), from the weighted residuals `norm` (V, C). With the residuals `px` (V, C, 2), corners
    displaced together with their neighbours are inliers too."""
    present = observations.present
    kept = present & (norm <= OUTLIER_SIGMAS * sigma_px)
    if (kept == present).all():
        return kept
    own = norm[present]
    middle = image_center(size_px)
    order = np.argsort(((observations.pixels[present] - middle) ** 2).sum(axis=-1))
    limit = np.empty(len(own))
    for ring in np.array_split(order, min(max(len(own) // RING_CORNERS, 1), MAX_SCATTER_RINGS)):
        scatter = sigma_of(own, ring)
        limit[ring] = OUTLIER_SIGMAS * min(max(scatter, sigma_px), RING_FACTOR * sigma_px)
    kept[present] = own <= limit
    if px is not None:
        of_corner = np.zeros(present.shape)
        of_corner[present] = limit
        _with_neighbours(kept, px, norm, of_corner, observations)
    return kept


def _with_neighbours(
    kept: BoolArray, px: FloatArray, norm: FloatArray, limit: FloatArray, observations: Observations
) -> None:
    """Add to the inliers `kept` (V, C) the corners that are displaced together with their neighbours.

    A board that bends or moves in one image displaces its corners smoothly, and they are measured correctly. So in
    views with a majority of inliers the `limit` (V, C) applies to the residuals less a quadratic field over the view,
    and RING_FACTOR times it to the residuals themselves. Views without a majority are left to other tests.
    """
    count, agree = observations.present.sum(axis=1), kept.sum(axis=1)
    views = np.flatnonzero((agree < count) & (2 * agree > count) & (agree >= 2 * FIELD_NUMBERS))
    if not views.size:
        return
    # A corner that does not project has no residual.
    part = observations.present[views] & np.isfinite(norm[views])
    weight = np.where(part, observations.weight[views], 0.0)
    residual = np.where(part[..., None], px[views], 0.0)
    off = observations.pixels[views] - observations.pixels[views].sum(axis=1, keepdims=True) / count[views, None, None]
    off /= np.abs(off * part[..., None]).max(axis=(1, 2), keepdims=True)
    x, y = np.moveaxis(off * part[..., None], -1, 0)
    field = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    robust = weight
    for _ in range(FIELD_ROUNDS):
        design = field * robust[..., None]
        information = np.swapaxes(design, 1, 2) @ design + FIELD_RIDGE * np.eye(FIELD_NUMBERS)
        numbers = np.linalg.solve(information, np.swapaxes(design, 1, 2) @ (residual * robust[..., None]))
        left = np.linalg.norm(residual - field @ numbers, axis=-1) * weight
        scatter = [sigma_of(one, used) for one, used in zip(left, part, strict=True)]
        robust = weight / np.sqrt(1.0 + (left / (TURN_SIGMAS * np.array(scatter)[:, None])) ** 2)
    kept[views] |= part & (left <= limit[views]) & (norm[views] <= RING_FACTOR * limit[views])
