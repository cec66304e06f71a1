"""What a view of a flat board says without knowing the lens: the radial alignment constraint.

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

from rigkit.arrays import FloatArray

__all__ = ["Alignment", "align", "distortion_centre"]

ROUNDS = 4
SUBSETS = 16
SUBSET_SIZE = 7
"""With 5 % bad corners 70 % of such subsets are clean; 16 miss once in 10^8 views."""
SUSPICIOUS = 8.0
"""A largest residual of more than this many robust sigmas sends the view through random subsets."""


@dataclass(frozen=True, eq=False, slots=True)
class Alignment:
    """Two rows of each pose and the size of the third.

    Attributes
    ----------
    rows : (V, 2, 3) r1 = (r11, r12, t1) and r2, t in mm for the board's own origin; r's of the right length.
    tilt : (V, 2) r31, r32 up to a common sign.
    weight : (V, C) in [0, 1], how far each corner takes part.
    residual_px : (V, C) distance of each pixel from the line it should lie on.
    """

    rows: FloatArray
    tilt: FloatArray
    weight: FloatArray
    residual_px: FloatArray

    def camera_xy(self, board: FloatArray) -> FloatArray:
        """Return (X, Y) of the corners (V, C, 2) in the camera frame, mm."""
        return np.stack(_camera_xy(self.rows.reshape(-1, 6), board), axis=-1)


def align(offset: FloatArray, board: FloatArray, weight: FloatArray) -> Alignment:
    """Return the radial alignment of every view.

    Parameters
    ----------
    offset : (V, C, 2) pixel minus centre.
    board : (V, C, 2) mm, corners in the board frame.
    weight : (V, C) weight of each corner, zero to ignore.
    """
    local, mean, size = _normalised(board, weight)
    used = weight > 0.0
    h = _fit(offset, local, weight)
    residual, radius = _residual(h, offset, local)
    sigma = _sigma(residual, used)
    bad = (np.where(used, residual, 0.0).max(axis=1) > SUSPICIOUS * sigma) & (used.sum(axis=1) > SUBSET_SIZE)
    if bad.any():
        h[bad] = _best_subset(offset[bad], local[bad], used[bad])
        residual, radius = _residual(h, offset, local)
    robust = weight
    for _ in range(ROUNDS):
        sigma = _sigma(residual, used)
        robust = np.where(used, weight / (1.0 + (residual / (2.5 * sigma[:, None])) ** 2), 0.0)
        h = _fit(offset, local, robust / radius)
        residual, radius = _residual(h, offset, local)
        if not bad.any():
            break
    x, y = _camera_xy(h, local)
    agree = (robust * (x * offset[..., 0] + y * offset[..., 1])).sum(axis=1)
    h *= np.where(agree < 0.0, -1.0, 1.0)[:, None]
    share = np.divide(robust, weight, out=np.zeros_like(weight), where=used)
    rows, tilt = _orthonormal(h, mean, size)
    return Alignment(rows, tilt, share, np.where(used, residual, np.nan))


def _normalised(board: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    present = (weight > 0.0)[..., None]
    count = np.maximum(present.sum(axis=1), 1)
    mean = (board * present).sum(axis=1) / count
    local = (board - mean[:, None]) * present
    size = np.sqrt((local**2).sum(axis=(1, 2)) / count[:, 0]) + np.finfo(float).tiny
    return local / size[:, None, None], mean, size


def _fit(offset: FloatArray, local: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the unit h (V, 6) that minimises sum weight^2 (u Y - v X)^2."""
    u, v = weight * offset[..., 0], weight * offset[..., 1]
    x, y = local[..., 0], local[..., 1]
    # Unknowns before corners: every row of the design is one contiguous run.
    design = np.empty((*u.shape[:-1], 6, u.shape[-1]))
    for k, (left, right) in enumerate(((-v, x), (-v, y), (-v, None), (u, x), (u, y), (u, None))):
        design[..., k, :] = left if right is None else left * right
    return np.asarray(np.linalg.eigh(design @ np.swapaxes(design, -1, -2))[1][..., 0])


def _camera_xy(h: FloatArray, local: FloatArray) -> tuple[FloatArray, FloatArray]:
    x, y = local[..., 0], local[..., 1]
    h = h[..., None]
    return h[..., 0, :] * x + h[..., 1, :] * y + h[..., 2, :], h[..., 3, :] * x + h[..., 4, :] * y + h[..., 5, :]


def _residual(h: FloatArray, offset: FloatArray, local: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the distance in px of each pixel from the radial line through its corner, and the corner's |(X, Y)|, kept
    off zero for corners that lie on the axis."""
    x, y = _camera_xy(h, local)
    radius = np.sqrt(x * x + y * y)
    radius = np.maximum(radius, 1e-3 * radius.max(axis=-1, keepdims=True) + np.finfo(float).tiny)
    return np.abs(offset[..., 0] * y - offset[..., 1] * x) / radius, radius


def _sigma(residual: FloatArray, used: np.ndarray) -> FloatArray:
    """Return a robust standard deviation of each view's residuals (V,), never zero."""
    middle = np.maximum(used.sum(axis=1) - 1, 0) // 2
    ordered = np.partition(np.where(used, residual, np.inf), np.unique(middle), axis=1)
    median = ordered[np.arange(len(used)), middle]
    return np.maximum(1.4826 * np.where(np.isfinite(median), median, 0.0), 1e-6)


def _best_subset(offset: FloatArray, local: FloatArray, used: np.ndarray) -> FloatArray:
    """Return, for each view, the fit to a random subset of its corners with the smallest median residual."""
    rng = np.random.default_rng(0)
    order = np.argsort(np.where(used[:, None], rng.random((len(used), SUBSETS, used.shape[1])), 2.0), axis=-1)
    chosen = order[..., :SUBSET_SIZE]
    view = np.arange(len(used))[:, None, None]
    h = _fit(offset[view, chosen], local[view, chosen], np.ones(chosen.shape))
    residual, _ = _residual(h, offset[:, None], local[:, None])
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
    """Return the centre of distortion, (2,) px, from all views: the common epipole of the radial fundamental matrices
    (u, v, 1) F_v (x, y, 1)^T = 0. Meaningless without distortion, when every point of the image would do."""
    local, _, _ = _normalised(board, weight)
    used = weight > 0.0
    size = float(np.abs(np.where(used[..., None], pixels - guess, 0.0)).max()) or 1.0
    uv = (pixels - guess) / size
    one = np.ones_like(uv[..., :1])
    left, right = np.concatenate([uv, one], axis=-1), np.concatenate([local, one], axis=-1)
    design = (left[..., :, None] * right[..., None, :]).reshape(*weight.shape, 9) * weight[..., None]
    values, vectors = np.linalg.eigh(np.swapaxes(design, -1, -2) @ design)
    F = vectors[..., 0].reshape(-1, 3, 3)
    # A view whose second smallest eigenvalue is as small as the first leaves its F open.
    certain = np.clip(1.0 - np.maximum(values[:, 0], 0.0) / np.maximum(values[:, 1], np.finfo(float).tiny), 0.0, 1.0)
    epipole = np.linalg.eigh(np.einsum("v,vij,vkj->ik", certain, F, F))[1][:, 0]
    if abs(epipole[2]) < 1e-9:
        return guess
    return np.asarray(guess + size * epipole[:2] / epipole[2])
