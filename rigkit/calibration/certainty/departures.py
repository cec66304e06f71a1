"""What a lens may do beyond its model: smooth displacements of its image, as large as the images leave open.

A covariance is that of the numbers of one model. Where boards were all views agree on them, though the lens departs a
little from every model; where no board was, the next term of the model that nobody asked for may be anything. Both are
one question: the image of the lens is that of the model, moved by

    d(pixel) = sum_j a_j b_j(pixel),    a_j ~ N(0, tau_j^2),

with b_j what models leave out: higher powers of the radius, decentring of two orders, thin prisms, shear and aspect
ratio, each of one px at the corners of the image. What poses and parameters take up of the b_j in the images given is
taken out of them (Schur complement), and the residuals are compared with what is left. They say how large tau is, along
the radius and otherwise; what they leave open of it is averaged over, all orders of magnitude between limits alike.
What the camera is wrong by has the covariance B E[a a^T] B^T, with B the displacements less what the fitted parameters
and the rotation of the rays have taken up of them. Images that disagree for other reasons say less of a: the variance
of residuals is that between images.

References: D. J. C. MacKay, "Bayesian interpolation", Neural Computation 4 (1992), section 4, on the evidence. M. C.
Kennedy, A. O'Hagan, "Bayesian calibration of computer models", J. R. Statist. Soc. B 63 (2001), on a model's
inadequacy as a random function beside its parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rigkit.calibration.result import Calibration
from rigkit.calibration.solving.normal_equations import pose_inverses
from rigkit.cameras.base import Camera
from rigkit.cameras.moving_pupil import NearCamera
from rigkit.core.arrays import FloatArray, IntArray, Mat3, Pixels
from rigkit.kernels.departures import DISPLACEMENTS, POSE, LensCorners, averaged_amounts, displacements

SMALLEST_PX, LARGEST_PX = 1e-3, 1.0
"""A departure at the corners of the image between these: lens models leave hundredths to tenths of a pixel. Residuals
smaller than the first are rounding, and tell nothing."""
SIZES_TRIED = np.geomspace(SMALLEST_PX, LARGEST_PX, 17)[1::2]
"""The sizes between them that are tried: the middles of eight equal parts of their logarithm."""
ENOUGH_CORNERS, CORNERS_OF_VIEW = 4096, 16
"""Of at least so many corners every second (third ...) is taken, where as many of each view are left."""
RIDGE = 1e-12
"""Added to the information of parameters, as a part of its mean: those that do not move take up nothing."""

Fields = Callable[[FloatArray], FloatArray]
"""Displacements (2, F, N) px at places with the derivatives (2, P + 3, N) by parameters and turns of the rays."""


@dataclass(frozen=True, eq=False, slots=True)
class Departures:
    """How far a lens may depart from its model: covariance (J, J) px^2 of the J displacements (about zero, what the
    images say of them counted in), by how much the parameters (P, J) have followed each, and the pupil's terms (2, J),
    where that moves."""

    size_px: tuple[int, int]
    covariance: FloatArray
    followed: FloatArray
    followed_by_pupil: FloatArray

    @classmethod
    def of(cls, calibration: Calibration) -> Departures:
        """Return what the images of a calibration leave open."""
        sigmas = _sigmas(calibration)
        p = len(sigmas)
        products, freedom = _products(calibration, calibration.near, sigmas, np.eye(3))
        if not (np.isfinite(products).all() and products[-1, -1] >= 0.0):
            # A lens beyond all numbers, as a damaged file may have it.
            products = np.zeros_like(products)
        of_parameters = products[:p, :p] + RIDGE * max(np.trace(products[:p, :p]), 1.0) / p * np.eye(p)
        followed = np.linalg.solve(of_parameters, products[:p, p:])
        left = products[p:, p:] - products[p:, :p] @ followed
        variance = max(float(left[-1, -1]) / max(freedom - p, 1), SMALLEST_PX**2) * calibration.overdispersion**2
        covariance = _averaged(left[:-1, :-1] / variance, left[:-1, -1] / variance)
        moved = sigmas[:, None] * followed[:, :-1]
        own = calibration.camera.parameters.size
        return cls(calibration.camera.size_px, covariance, moved[:own], moved[own:])

    def left_over(self, pixels: Pixels, design: FloatArray) -> FloatArray:
        """Return the displacements (2, J, M) at pixels (M, 2) less what the parameters have followed; `design`
        (2, K, M) are the projection's derivatives there, by the parameters first."""
        own = design[:, : len(self.followed)]
        return displacements(pixels, self.size_px) - np.swapaxes(np.swapaxes(own, 1, 2) @ self.followed, 1, 2)


def _averaged(information: FloatArray, score: FloatArray) -> FloatArray:
    """Return E[a a^T] (J, J) of amounts a of which the images give the information (J, J) and the score (J,), averaged
    over the sizes that those along the radius, and the others, may have beforehand."""
    # Where nothing is known, rounding may say less than nothing.
    values, axes = np.linalg.eigh(information)
    information = (axes * np.maximum(values, 0.0)) @ axes.T
    return averaged_amounts(information, score, SIZES_TRIED)


def amounts_of(calibration: Calibration, fields: Fields) -> FloatArray:
    """Return E[a a^T] (F, F) of the amounts a of F further displacements, `fields`: independent and of variance one
    beforehand, with what the images say of them, poses and parameters eliminated."""
    sigmas = _sigmas(calibration)
    p = len(sigmas)
    products, freedom = _products(calibration, calibration.near, sigmas, np.eye(3), fields)
    count = len(products) - p - DISPLACEMENTS - 1
    if not np.isfinite(products).all():
        return np.eye(count)
    of_parameters = products[:p, :p] + RIDGE * max(np.trace(products[:p, :p]), 1.0) / p * np.eye(p)
    # The fields stand after the parameters, the residual last.
    chosen = [*range(p, p + count), -1]
    left = products[np.ix_(chosen, chosen)] - products[chosen, :p] @ np.linalg.solve(
        of_parameters, products[:p, chosen]
    )
    variance = max(float(left[-1, -1]) / max(freedom - p, 1), SMALLEST_PX**2) * calibration.overdispersion**2
    values, axes = np.linalg.eigh(left[:-1, :-1] / variance)
    known = (axes / (1.0 + np.maximum(values, 0.0))) @ axes.T
    mean = known @ left[:-1, -1] / variance
    return np.asarray(known + np.outer(mean, mean))


def information_of_lens(calibration: Calibration, camera: Camera, turn: Mat3) -> FloatArray:
    """Return what the corners of a calibration would tell of the parameters (P,) of another `camera`, poses eliminated,
    (P, P) for corners of unit variance; `turn` takes rays of the calibrated camera to its own."""
    p = camera.parameters.size
    return _products(calibration, camera, np.ones(p), turn)[0][:p, :p]


def _sigmas(calibration: Calibration) -> FloatArray:
    """Return the standard deviations of the parameters of a calibrated camera, and of its pupil where that moves."""
    sigmas, pupil = calibration.parameter_sigmas, calibration.pupil
    if pupil is None:
        return sigmas
    return np.append(sigmas, calibration.widening * np.sqrt(np.maximum(np.diag(pupil.covariance), 0.0)))


def _products(
    calibration: Calibration, camera: Camera, sigmas: FloatArray, turn: Mat3, fields: Fields | None = None
) -> tuple[FloatArray, int]:
    """Return the sums of products (K, K) of derivatives by the parameters of a camera in units of `sigmas` (P,), the
    `fields` if given, the displacements and the residuals, of all kept corners, poses eliminated; and how many
    residuals there are for the parameters. `turn` takes rays of the calibrated camera to those of `camera`."""
    corners = calibration.corners
    used, count = _enough(np.flatnonzero(corners.kept), corners.view)
    view = corners.view[used]
    lever = np.einsum("nij,nj->in", corners.rotation[view], corners.points_mm[used])
    centre = corners.translation_mm.T[:, view]
    if isinstance(calibration.near, NearCamera) and camera is not calibration.near:
        # Other lenses are shown what this one sees as from its pupil.
        centre = calibration.near.seen((lever + centre).T).T - lever
    lever = turn @ lever
    x, y, z = lever + turn @ centre
    d_pixels_d_point, d_pixels_d_parameters = np.zeros((2, 3, len(used))), np.zeros((2, len(sigmas), len(used)))
    u, v, valid = camera.derivatives(x, y, z, d_pixels_d_point, d_pixels_d_parameters)
    if fields is not None:
        of_lens = d_pixels_d_parameters[:, : calibration.camera.parameters.size]
        more = fields(np.concatenate([of_lens, turned_rays(np.stack([x, y, z]), d_pixels_d_point)], axis=1))
        d_pixels_d_parameters, sigmas = (
            np.concatenate([d_pixels_d_parameters, more], axis=1),
            np.append(sigmas, np.ones(more.shape[1])),
        )
    residuals = corners.residuals_px[used]
    # Corners that do not project tell nothing.
    usable = valid & np.isfinite(residuals[:, 0]) & np.isfinite(residuals[:, 1])
    rows = LensCorners.make(
        d_pixels_d_point, d_pixels_d_parameters, sigmas, lever, (u, v), residuals, usable, count, camera.size_px
    )
    with_pose, out = rows.products()
    coupling = with_pose[:, POSE:]
    back = pose_inverses(with_pose[:, :POSE]) @ np.swapaxes(coupling, 1, 2)
    out -= coupling.transpose(1, 0, 2).reshape(len(out), -1) @ back.reshape(-1, len(out))
    return out, 2 * len(used) - POSE * len(count)


def turned_rays(along: FloatArray, d_pixels_d_point: FloatArray) -> FloatArray:
    """Return d pixel / d W (2, 3, N) of a turn W of the rays to points `along` (3, N), from d pixel / d point there."""
    out = np.empty_like(d_pixels_d_point)
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        out[:, k] = along[i] * d_pixels_d_point[:, j] - along[j] * d_pixels_d_point[:, i]
    return out


def _enough(kept: IntArray, view: IntArray) -> tuple[IntArray, IntArray]:
    """Return the corners to take of those `kept` (N,), by their numbers, and how many they are of every view that has
    any: of very many corners some tell enough. `view` is that of each corner."""
    count = np.bincount(view[kept])
    count = count[count > 0]
    every = max(1, min(len(kept) // ENOUGH_CORNERS, int(count.min(initial=len(kept))) // CORNERS_OF_VIEW))
    if every == 1:
        return kept, count
    place = np.arange(len(kept)) - np.repeat(np.cumsum(count) - count, count)
    return kept[place % every == 0], -(-count // every)
