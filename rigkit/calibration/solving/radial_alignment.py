"""The radial alignment constraint: two rows of a board's pose, without knowing the lens.

Around the centre of distortion c every radially symmetric lens, however wide, images a point of the camera frame
(X, Y, Z) along the direction (X, Y): with (u, v) = pixel - c,   u Y - v X = 0. That is linear in two rows of the pose,
h = (r11, r12, t1, r21, r22, t2). Orthonormality gives r31 and r32 up to a common sign.

References: R. Y. Tsai, "A versatile camera calibration technique", 1987; D. Scaramuzza et al., "A toolbox for easily
calibrating omnidirectional cameras", IROS 2006; R. Hartley, S. B. Kang, "Parameter-free radial distortion correction
with center of distortion estimation", PAMI 2007 (the centre).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.optim.robust_scale import SIGMA_OF_MEDIAN

ALIGNMENT_ROUNDS = 4
SUBSETS = 16
SUBSET_SIZE = 7
"""With 5 % outliers 70 % of such subsets have none; all 16 contain one in one of 10^8 views."""
SUSPICIOUS = 8.0
"""A view whose largest residual exceeds this many robust standard deviations is fitted to random subsets."""
TRACE_SHIFT = 1e-13
"""Of the trace, keeps the normal matrix of exact corners invertible."""
TURN_SIGMAS = 2.5
"""Residual, in robust standard deviations, with half the weight."""
EXACT_SCATTER_PX = 1e-6
"""Smallest scatter, that of exact corners: weights are its inverse."""
MIN_RADIUS_SHARE = 1e-3
"""Smallest radius as a part of a view's largest: closer to the axis the direction is undefined and weights diverge."""
FAR_EPIPOLE = 1e-9
"""Homogeneous coordinate of a unit vector below which the epipole is at infinity."""
INVERSE_STEPS = 3
"""Steps of inverse iteration: each lowers the error by the ratio of the two smallest eigenvalues."""
SQUARE_ROW, SQUARE_COLUMN = np.triu_indices(3)
"""Indices of the six different products of two of three numbers."""
NORMAL_ENTRIES = 3 * np.tile([[0, 1, 2], [1, 3, 4], [2, 4, 5]], (2, 2)) + np.kron(
    [[0, 1], [1, 2]], np.ones((3, 3), dtype=int)
)
"""Index of each entry of the 6x6 normal matrix in the (6, 3) moments, of products of (x, y, 1) and of (-v, u)."""


@dataclass(frozen=True, eq=False, slots=True)
class Alignment:
    """Two rows of each pose, and the third up to a sign.

    Attributes
    ----------
    rows : (V, 2, 3) r1 = (r11, r12, t1) and r2, scaled to a rotation, t in mm for the board's origin.
    tilt : (V, 2) r31, r32 up to a common sign.
    weight : (V, C) in [0, 1], robust weight of each corner.
    """

    rows: FloatArray
    tilt: FloatArray
    weight: FloatArray

    def camera_xy(self, board: FloatArray) -> FloatArray:
        """Return (X, Y) in the camera frame (V, 2, C) of the corners (V, 2, C), mm."""
        return np.asarray(self.rows[..., :2] @ board + self.rows[..., 2:])


def align(offset: FloatArray, board: FloatArray, weight: FloatArray) -> Alignment:
    """Return the radial alignment of every view.

    Parameters
    ----------
    offset : (V, 2, C) pixel minus centre.
    board : (V, 2, C) mm, corners in the board frame.
    weight : (V, C) weight of each corner, zero to ignore.
    """
    local, mean, size = _normalised(board, weight)
    used = weight > 0.0
    views = _Views(offset, local)
    h = views.fit(weight)
    residual, radius = views.residual(h)
    sigma = _sigma(residual, used)
    bad = (np.where(used, residual, 0.0).max(axis=1) > SUSPICIOUS * sigma) & (used.sum(axis=1) > SUBSET_SIZE)
    if bad.any():
        h[bad] = _best_subset(offset[bad], local[bad], used[bad])
        residual, radius = views.residual(h)
    robust = weight
    for _ in range(ALIGNMENT_ROUNDS):
        sigma = _sigma(residual, used)
        robust = np.where(used, weight / (1.0 + (residual / (TURN_SIGMAS * sigma[:, None])) ** 2), 0.0)
        h = views.fit(robust / radius, h)
        residual, radius = views.residual(h)
        if not bad.any():
            break
    agree = (robust * (views.camera_xy(h) * offset).sum(axis=1)).sum(axis=1)
    h *= np.where(agree < 0.0, -1.0, 1.0)[:, None]
    share = np.divide(robust, weight, out=np.zeros_like(weight), where=used)
    rows, tilt = _orthonormal(h, mean, size)
    return Alignment(rows, tilt, share)


def _normalised(board: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return (x, y, 1) of the corners (V, 3, C), normalised to zero mean and unit size of those used, and their mean
    and size."""
    present = (weight > 0.0)[:, None]
    count = np.maximum(present.sum(axis=-1), 1)
    mean = (board * present).sum(axis=-1) / count
    local = np.ones((len(board), 3, board.shape[-1]))
    xy = local[:, :2]
    np.multiply(board - mean[..., None], present, out=xy)
    size = np.sqrt((xy * xy).sum(axis=(1, 2)) / count[:, 0]) + np.finfo(float).tiny
    xy /= size[:, None, None]
    return local, mean, size


class _Views:
    """Corners of views with precomputed products: offsets (..., 2, C), (x, y, 1) (..., 3, C)."""

    def __init__(self, offset: FloatArray, local: FloatArray) -> None:
        self._u, self._v, self._local = offset[..., 0, :], offset[..., 1, :], local
        # Products of two of (x, y, 1), and of the direction (-v, u).
        self._squares = local[..., SQUARE_ROW, :] * local[..., SQUARE_COLUMN, :]
        self._direction = np.stack([self._v * self._v, -self._u * self._v, self._u * self._u], axis=-2)

    def fit(self, weight: FloatArray, start: FloatArray | None = None) -> FloatArray:
        """Return the unit h (..., 6) that minimises sum weight^2 (u Y - v X)^2. With an initial value `start` it is
        found by inverse iteration, in half the time of an eigendecomposition."""
        moments = self._squares @ np.swapaxes(self._direction * (weight * weight)[..., None, :], -1, -2)
        normal = moments.reshape(*weight.shape[:-1], -1)[..., NORMAL_ENTRIES]
        if start is None:
            return np.asarray(np.linalg.eigh(normal)[1][..., 0])
        trace = np.trace(normal, axis1=-2, axis2=-1)[..., None]
        inverse = np.linalg.inv(normal + (TRACE_SHIFT * trace + np.finfo(float).tiny)[..., None] * np.eye(6))
        h = start[..., None]
        for _ in range(INVERSE_STEPS):
            h = inverse @ h
            h /= np.sqrt((h * h).sum(axis=-2, keepdims=True))
        return np.asarray(h[..., 0])

    def camera_xy(self, h: FloatArray) -> FloatArray:
        """Return (X, Y) (..., 2, C)."""
        return np.asarray(h.reshape(*h.shape[:-1], 2, 3) @ self._local)

    def residual(self, h: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the distance in px of each pixel from the radial line of its corner, and the corner's |(X, Y)|, at
        least MIN_RADIUS_SHARE of the largest."""
        xy = self.camera_xy(h)
        x, y = xy[..., 0, :], xy[..., 1, :]
        radius = np.sqrt(x * x + y * y)
        radius = np.maximum(radius, MIN_RADIUS_SHARE * radius.max(axis=-1, keepdims=True) + np.finfo(float).tiny)
        return np.abs(self._u * y - self._v * x) / radius, radius


def _sigma(residual: FloatArray, used: np.ndarray) -> FloatArray:
    """Return a robust standard deviation of each view's residuals (V,), never zero."""
    middle = np.maximum(used.sum(axis=1) - 1, 0) // 2
    ordered = np.partition(np.where(used, residual, np.inf), np.unique(middle), axis=1)
    median = ordered[np.arange(len(used)), middle]
    return np.maximum(SIGMA_OF_MEDIAN * np.where(np.isfinite(median), median, 0.0), EXACT_SCATTER_PX)


def _best_subset(offset: FloatArray, local: FloatArray, used: np.ndarray) -> FloatArray:
    """Return, for each view, the fit to a random subset of its corners with the smallest median residual."""
    # The same random numbers for every view, so that a view's subsets do not depend on the other views.
    drawn = np.random.default_rng(0).random((SUBSETS, used.shape[1]))
    order = np.argsort(np.where(used[:, None], drawn, 2.0), axis=-1)
    chosen = order[..., None, :SUBSET_SIZE]
    offset, local = offset[:, None], local[:, None]
    subset = _Views(np.take_along_axis(offset, chosen, axis=-1), np.take_along_axis(local, chosen, axis=-1))
    h = subset.fit(np.ones((*order.shape[:-1], SUBSET_SIZE)))
    residual, _ = _Views(offset, local).residual(h)
    median = np.nanmedian(np.where(used[:, None], residual, np.nan), axis=-1)
    return np.asarray(h[np.arange(len(used)), median.argmin(axis=1)])


def _orthonormal(h: FloatArray, mean: FloatArray, size: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Scale h so that the columns complete to unit length with r31 r32 = -c1.c2, r31^2 - r32^2 = |c2|^2 - |c1|^2."""
    rows = h.reshape(-1, 2, 3).copy()
    rows[..., :2] /= size[:, None, None]
    c1, c2 = rows[..., 0], rows[..., 1]
    dot = (c1 * c2).sum(axis=-1)
    difference = (c2**2).sum(axis=-1) - (c1**2).sum(axis=-1)
    root = np.hypot(difference, 2.0 * dot)
    r31 = np.sqrt(np.maximum(0.5 * (root + difference), 0.0))
    r32 = np.sqrt(np.maximum(0.5 * (root - difference), 0.0)) * np.where(dot > 0.0, -1.0, 1.0)
    scale = np.sqrt((c1**2).sum(axis=-1) + r31**2) + np.finfo(float).tiny
    rows /= scale[:, None, None]
    rows[..., 2] -= (rows[..., :2] @ mean[..., None])[..., 0]
    return rows, np.stack([r31, r32], axis=-1) / scale[:, None]


def distortion_centre(pixels: FloatArray, board: FloatArray, weight: FloatArray, guess: FloatArray) -> FloatArray:
    """Return the centre of distortion, (2,) px, from all views (V, 2, C): the common epipole of the radial fundamental
    matrices (u, v, 1) F_v (x, y, 1)^T = 0. Undetermined without distortion."""
    local, _, _ = _normalised(board, weight)
    offset = pixels - guess[:, None]
    size = float(np.abs(np.where((weight > 0.0)[:, None], offset, 0.0)).max()) or 1.0
    left = np.concatenate([offset / size, np.ones_like(offset[:, :1])], axis=1)
    design = (left[:, :, None] * local[:, None]).reshape(len(weight), 9, -1) * weight[:, None]
    values, vectors = np.linalg.eigh(design @ np.swapaxes(design, -1, -2))
    F = vectors[..., 0].reshape(-1, 3, 3)
    # A view with two equally small eigenvalues does not determine its F.
    certain = np.clip(1.0 - np.maximum(values[:, 0], 0.0) / np.maximum(values[:, 1], np.finfo(float).tiny), 0.0, 1.0)
    epipole = np.linalg.eigh(np.einsum("v,vij,vkj->ik", certain, F, F))[1][:, 0]
    if abs(epipole[2]) < FAR_EPIPOLE:
        return guess
    return np.asarray(guess + size * epipole[:2] / epipole[2])
