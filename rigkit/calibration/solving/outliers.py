"""Which corners are outliers: by a stated rule, against what corners there in the image leave, and what those around
them on the board do."""

from __future__ import annotations

import numpy as np

from rigkit.calibration.views.observations import Observations
from rigkit.cameras.base import image_center
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, median_of
from rigkit.optim.robust_scale import MEDIAN_OF_RAYLEIGH

OUTLIER_SIGMAS = 5.0
"""A corner is an outlier when its weighted 2-D residual exceeds this many robust standard deviations per coordinate,
sigma = median |r| / 1.177: by chance alone 4 corners in a million do."""
MAX_RINGS, RING_CORNERS = 8, 50
"""Corners scatter more towards the rim of the image, where squares are small and blurred: the rule takes the scatter of
the ring around the middle that a corner lies in, of so many with as many corners each, but no fewer than 50."""
RING_FACTOR = 4.0
"""No ring scatters more than this many times as much as all corners: beyond it the corners in it are bad ones."""
SIGMA_FLOOR_PX = 1e-4
"""Exact corners have no scatter to judge outliers by: below this rounding would make them."""
TURN_SIGMAS = 2.5
"""Corners so many robust sigmas off a field count half in it."""
FIELD_NUMBERS, FIELD_ROUNDS, FIELD_RIDGE = 6, 5, 1e-9
"""Of a quadratic field over a view, each axis; of the rounds in which it is made robust; and, of weights of about one,
what keeps it solvable."""


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
    """Return which corners the rule keeps, (V, C), from their weighted residuals `norm` (V, C). With the residuals `px`
    (V, C, 2) corners that lie off together with all around them are kept."""
    present = observations.present
    kept = present & (norm <= OUTLIER_SIGMAS * sigma_px)
    if (kept == present).all():
        return kept
    own = norm[present]
    middle = image_center(size_px)
    order = np.argsort(((observations.pixels[present] - middle) ** 2).sum(axis=-1))
    limit = np.empty(len(own))
    for ring in np.array_split(order, min(max(len(own) // RING_CORNERS, 1), MAX_RINGS)):
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
    """Add to the corners `kept` (V, C) those that lie off together with all around them.

    A board that bends, or moves, in one picture takes its corners along: they were found where they are. So in views
    most of whose corners agree the `limit` (V, C) is for what a quadratic field over the view leaves of the residuals;
    of these themselves it is RING_FACTOR times as high. A view most of whose corners disagree is for other rules.
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
