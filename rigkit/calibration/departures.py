"""What a lens may do beyond its model: smooth displacements of its image, as large as the images leave open.

A covariance is that of the numbers of one model. Where boards were all views agree on them, though the lens departs a
little from every model; where no board was, the next term of the model that nobody asked for may be anything. Both are
one question: the image of the lens is that of the model, moved by

    d(pixel) = sum_j a_j b_j(pixel),    a_j ~ N(0, tau_j^2),

with b_j what models leave out: higher powers of the radius, decentring of two orders, thin prisms, shear and aspect
ratio, each of one px at the corners of the image. What poses and parameters take up of it in the images given is taken
out of the b_j (Schur complement), with what is left the residuals are compared: they say how large tau is, along the
radius and otherwise, and what they leave open of it is averaged over (all orders of magnitude between limits alike).
What the camera is wrong by has the covariance B E[a a^T] B^T, with B the displacements less what the fitted parameters
and the rotation of the rays have taken up of them. Images that disagree for other reasons say less of a: the variance
of residuals is that between images.

References: D. J. C. MacKay, "Bayesian interpolation", Neural Computation 4 (1992), section 4, on the evidence. M. C.
Kennedy, A. O'Hagan, "Bayesian calibration of computer models", J. R. Statist. Soc. B 63 (2001), on a model's
inadequacy as a random function beside its parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.calibration.normal_equations import pose_inverses
from rigkit.calibration.result import Calibration, ViewResult
from rigkit.cameras.base import image_center
from rigkit.core.arrays import FloatArray, IntArray, Pixels

RADIAL_POWERS = (2, 4, 6, 8, 10)
"""Powers of the radius by which the image is stretched: no model has more terms that tell."""
DISPLACEMENTS = len(RADIAL_POWERS) + 8
SMALLEST_PX, LARGEST_PX = 1e-3, 1.0
"""A departure at the corners of the image between these: lens models leave hundredths to tenths of a pixel. Residuals
smaller than the first are rounding, and tell nothing."""
SIZES_TRIED = 8
"""So many sizes between them are tried."""
ENOUGH_CORNERS, CORNERS_OF_VIEW = 4096, 16
"""Of at least so many corners every second (third ...) is taken, where as many of each view are left."""
CORNERS_AT_A_TIME = 8192
"""Their derivatives then stay in the cache, and memory does not grow with the views."""
RIDGE = 1e-12
"""Added to the information of parameters, as a part of its mean: those that do not move take up nothing."""


@dataclass(frozen=True, eq=False, slots=True)
class Departures:
    """How far a lens may depart from its model: covariance (J, J) px^2 of the J displacements (about zero, what the
    images say of them counted in), and by how much the parameters (P, J) have followed each."""

    size_px: tuple[int, int]
    covariance: FloatArray
    followed: FloatArray

    @classmethod
    def of(cls, calibration: Calibration) -> Departures:
        """Return what the images of a calibration leave open."""
        sigmas = calibration.parameter_sigmas
        p = len(sigmas)
        products, freedom = _products(calibration, sigmas)
        if not (np.isfinite(products).all() and products[-1, -1] >= 0.0):
            # A lens beyond all numbers, as a damaged file may have it.
            products = np.zeros_like(products)
        of_parameters = products[:p, :p] + RIDGE * max(np.trace(products[:p, :p]), 1.0) / p * np.eye(p)
        followed = np.linalg.solve(of_parameters, products[:p, p:])
        left = products[p:, p:] - products[p:, :p] @ followed
        variance = max(float(left[-1, -1]) / max(freedom - p, 1), SMALLEST_PX**2) * calibration.overdispersion**2
        covariance = _averaged(left[:-1, :-1] / variance, left[:-1, -1] / variance)
        return cls(calibration.camera.size_px, covariance, sigmas[:, None] * followed[:, :-1])

    def left_over(self, pixels: Pixels, design: FloatArray) -> FloatArray:
        """Return the displacements (2, J, M) at pixels (M, 2) less what the parameters have followed; `design`
        (2, K, M) are the projection's derivatives there, by the parameters first."""
        own = design[:, : len(self.followed)]
        return displacements(pixels, self.size_px) - np.swapaxes(np.swapaxes(own, 1, 2) @ self.followed, 1, 2)


def displacements(pixels: Pixels, size_px: tuple[int, int]) -> FloatArray:
    """Return the displacements (2, J, M) at pixels (M, 2), px: of about one px in the corners of the image."""
    out = np.zeros((2, DISPLACEMENTS, len(pixels)))
    _displace(out, pixels[:, 0], pixels[:, 1], size_px)
    return out


def _displace(out: FloatArray, u: FloatArray, v: FloatArray, size_px: tuple[int, int]) -> None:
    """Write the displacements at (u, v), (M,) each, into `out` (2, J, M), which is zero."""
    centre, scale = image_center(size_px), 2.0 / np.hypot(*size_px)
    x, y = (u - centre[0]) * scale, (v - centre[1]) * scale
    xx, xy, yy = x * x, x * y, y * y
    square = xx + yy
    np.multiply(square, x, out=out[0, 0])
    np.multiply(square, y, out=out[1, 0])
    for j in range(1, len(RADIAL_POWERS)):
        np.multiply(square, out[:, j - 1], out=out[:, j])
    # Decentring (tangential distortion), thin prisms, these again with the square of the radius, aspect ratio, shear.
    k = len(RADIAL_POWERS)
    out[0, k], out[1, k] = square + 2.0 * xx, 2.0 * xy
    out[0, k + 1], out[1, k + 1] = out[1, k], square + 2.0 * yy
    out[0, k + 2] = out[1, k + 3] = square
    out[0, k + 4] = out[1, k + 5] = square * square
    out[0, k + 6], out[1, k + 6] = x, -y
    out[0, k + 7], out[1, k + 7] = y, x


def _averaged(information: FloatArray, score: FloatArray) -> FloatArray:
    """Return E[a a^T] (J, J) of amounts a of which the images give the information (J, J) and the score (J,), averaged
    over the sizes that those along the radius, and the others, may have beforehand."""
    # Where nothing is known, rounding may say less than nothing.
    values, axes = np.linalg.eigh(information)
    information = (axes * np.maximum(values, 0.0)) @ axes.T
    # The middles of so many equal parts.
    sizes = np.geomspace(SMALLEST_PX, LARGEST_PX, 2 * SIZES_TRIED + 1)[1::2]
    along, others = (size.ravel() for size in np.meshgrid(sizes, sizes))
    prior = np.where(np.arange(DISPLACEMENTS) < len(RADIAL_POWERS), along[:, None], others[:, None])
    scaled = np.eye(DISPLACEMENTS) + prior[:, :, None] * information * prior[:, None, :]
    root = np.linalg.cholesky(scaled)
    variance = np.linalg.inv(scaled) * prior[:, :, None] * prior[:, None, :]
    mean = variance @ score
    evidence = 0.5 * mean @ score - np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
    weight = np.exp(evidence - evidence.max())
    weight /= weight.sum()
    return np.asarray(
        (weight @ variance.reshape(len(weight), -1)).reshape(DISPLACEMENTS, DISPLACEMENTS) + (mean.T * weight) @ mean
    )


def _products(calibration: Calibration, sigmas: FloatArray) -> tuple[FloatArray, int]:
    """Return the sums of products (K, K) of derivatives by the parameters in units of `sigmas` (P,), the displacements
    and the residuals, of all kept corners, poses eliminated; and how many residuals there are for the parameters."""
    views = [view for view in calibration.views if view.kept.any()]
    each = len(sigmas) + DISPLACEMENTS + 1
    if not views:
        return np.zeros((each, each)), 0
    kept = [np.flatnonzero(view.kept) for view in views]
    # Of very many corners some tell enough.
    fewest, total = min(len(own) for own in kept), sum(len(own) for own in kept)
    every = max(1, min(total // ENOUGH_CORNERS, fewest // CORNERS_OF_VIEW))
    used = [own[::every] for own in kept]
    count = np.array([len(own) for own in used])
    out, with_pose = np.zeros((each, each)), np.empty((len(views), each + 6, 6))
    block = np.cumsum(count) // CORNERS_AT_A_TIME
    for number in np.unique(block):
        chosen = np.flatnonzero(block == number)
        rows = _rows(calibration, [(views[k], used[k]) for k in chosen], sigmas)
        for part in rows:
            out += part[6:] @ part[6:].T
        stop = 0
        for k in chosen:
            own = slice(stop, stop + count[k])
            stop = own.stop
            with_pose[k] = rows[0, :, own] @ rows[0, :6, own].T + rows[1, :, own] @ rows[1, :6, own].T
    coupling = with_pose[:, 6:]
    back = pose_inverses(with_pose[:, :6]) @ np.swapaxes(coupling, 1, 2)
    out -= coupling.transpose(1, 0, 2).reshape(each, -1) @ back.reshape(-1, each)
    return out, int(2 * count.sum()) - 6 * len(count)


def _rows(calibration: Calibration, used: Sequence[tuple[ViewResult, IntArray]], sigmas: FloatArray) -> FloatArray:
    """Return for the corners used of some views (2, K, N): derivatives by the view's pose (6), by the parameters, the
    displacements, the residual. Corners that do not project are zero."""
    shapes = {board.board_id: board for board in calibration.boards}
    points = np.concatenate([shapes[v.board_id].at(v.grid[own]) for v, own in used])
    view = np.repeat(np.arange(len(used)), [len(own) for _, own in used])
    rotation = np.array([one.cam_from_board.rotation for one, _ in used]).transpose(1, 2, 0)[..., view]
    lever = (rotation * points.T).sum(axis=1)
    in_cam = lever + np.array([one.cam_from_board.translation_mm for one, _ in used]).T[:, view]
    p = len(sigmas)
    rows = np.zeros((2, 6 + p + DISPLACEMENTS + 1, len(points)))
    by_point = rows[:, 3:6]
    u, v, valid = calibration.camera.derivatives(in_cam[0], in_cam[1], in_cam[2], by_point, rows[:, 6 : 6 + p])
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        np.multiply(lever[i], by_point[:, j], out=rows[:, k])
        rows[:, k] -= lever[j] * by_point[:, i]
    rows[:, 6 : 6 + p] *= sigmas[:, None]
    _displace(rows[:, 6 + p : -1], u, v, calibration.camera.size_px)
    rows[:, -1] = np.concatenate([one.residuals_px[own] for one, own in used]).T
    told = valid & np.isfinite(rows[:, -1]).all(axis=0)
    if not told.all():
        rows[..., ~told] = 0.0
    return rows
