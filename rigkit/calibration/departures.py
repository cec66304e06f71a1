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

from dataclasses import dataclass

import numpy as np

from rigkit.calibration.normal_equations import pose_inverses
from rigkit.calibration.result import Calibration
from rigkit.cameras.base import image_center
from rigkit.core.arrays import FloatArray, IntArray, Pixels

RADIAL_POWERS = (2, 4, 6, 8, 10)
"""Powers of the radius by which the image is stretched: no model has more terms that tell."""
DISPLACEMENTS = len(RADIAL_POWERS) + 8
SMALLEST_PX, LARGEST_PX = 1e-3, 1.0
"""A departure at the corners of the image between these: lens models leave hundredths to tenths of a pixel. Residuals
smaller than the first are rounding, and tell nothing."""
SIZES_TRIED = 12
"""So many sizes between them are tried."""
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
        products, freedom = _products(calibration, sigmas)
        p = len(sigmas)
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
    x, y = (pixels - image_center(size_px)).T / (0.5 * np.hypot(*size_px))
    square = x * x + y * y
    out = np.empty((2, DISPLACEMENTS, len(pixels)))
    for j, power in enumerate(RADIAL_POWERS):
        stretch = square ** (power // 2)
        np.multiply(stretch, x, out=out[0, j])
        np.multiply(stretch, y, out=out[1, j])
    zero = np.zeros(len(pixels))
    k = len(RADIAL_POWERS)
    # Decentring (tangential distortion), thin prisms, both again with the square of the radius, aspect ratio, shear.
    out[0, k:], out[1, k:] = (
        (square + 2.0 * x * x, 2.0 * x * y, square, zero, square * square, zero, x, y),
        (2.0 * x * y, square + 2.0 * y * y, zero, square, zero, square * square, -y, x),
    )
    return out


def _averaged(information: FloatArray, score: FloatArray) -> FloatArray:
    """Return E[a a^T] (J, J) of amounts a of which the images give the information (J, J) and the score (J,), averaged
    over the sizes that those along the radius, and the others, may have beforehand."""
    sizes = np.geomspace(SMALLEST_PX, LARGEST_PX, SIZES_TRIED)
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
    rows, count = _rows(calibration, sigmas)
    each = rows.shape[1] - 6
    out = np.zeros((each, each))
    for part in rows:
        out += part[6:] @ part[6:].T
    stops = np.cumsum(count)
    of_views = [slice(stop - n, stop) for n, stop in zip(count.tolist(), stops.tolist(), strict=True)]
    with_pose = np.array([rows[0, :, s] @ rows[0, :6, s].T + rows[1, :, s] @ rows[1, :6, s].T for s in of_views])
    coupling = with_pose[:, 6:]
    back = pose_inverses(with_pose[:, :6]) @ np.swapaxes(coupling, 1, 2)
    out -= coupling.transpose(1, 0, 2).reshape(each, -1) @ back.reshape(-1, each)
    return out, int(2 * count.sum()) - 6 * len(count)


def _rows(calibration: Calibration, sigmas: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return for the kept corners, view by view, (2, K, N): derivatives by the view's pose (6), by the parameters, the
    displacements, the residual; and how many corners each view has (V,)."""
    views = [view for view in calibration.views if view.kept.any()]
    count = np.array([int(view.kept.sum()) for view in views])
    shapes = {board.board_id: board for board in calibration.boards}
    points = np.concatenate([shapes[v.board_id].at(v.grid[v.kept]) for v in views])
    view = np.repeat(np.arange(len(views)), count)
    rotation = np.array([one.cam_from_board.rotation for one in views])[view].transpose(1, 2, 0)
    lever = (rotation * points.T).sum(axis=1)
    in_cam = lever + np.array([one.cam_from_board.translation_mm for one in views])[view].T
    p = len(sigmas)
    rows = np.zeros((2, 6 + p + DISPLACEMENTS + 1, len(points)))
    by_point = rows[:, 3:6]
    u, v, valid = calibration.camera.derivatives(in_cam[0], in_cam[1], in_cam[2], by_point, rows[:, 6 : 6 + p])
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        np.multiply(lever[i], by_point[:, j], out=rows[:, k])
        rows[:, k] -= lever[j] * by_point[:, i]
    rows[:, 6 : 6 + p] *= sigmas[:, None]
    rows[:, 6 + p : -1] = displacements(np.stack([u, v], axis=-1), calibration.camera.size_px)
    rows[:, -1] = np.concatenate([one.residuals_px[one.kept] for one in views]).T
    told = valid & np.isfinite(rows).all(axis=(0, 1))
    if not told.all():
        rows[..., ~told] = 0.0
    return rows, count
