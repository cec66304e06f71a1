"""Model inadequacy of a lens: smooth displacements of its image that no parameter of its model describes.

The covariance of the parameters assumes that the model is right. But real lenses deviate a little from every model, and
where no board was, the next term of the model is unconstrained. So the image of the lens is that of the model,
displaced by

    d(pixel) = sum_j a_j b_j(pixel),    a_j ~ N(0, tau_j^2),

where the b_j are terms that models leave out: higher powers of the radius, decentring of two orders, thin prisms, shear
and aspect ratio, each of one px at the corners of the image. Poses and parameters absorb a part of the b_j, which the
Schur complement eliminates; the residuals are compared with the rest. They determine tau, for radial terms and for the
others; where they do not, it is integrated out with a prior that is uniform in log tau. The error of the camera has the
covariance B E[a a^T] B^T, where B are the displacements less the part that the fitted parameters and the rotation of
the rays absorb. The variance of the residuals is that between images, as other disagreements of the images make them
less informative.

Departures are in the residuals, and images share them: so corners seem less sure, and images disagree more. Both
are part of the calibration's covariance; with the departures added, they would count twice. Given the amounts a, only
the rest e - B a of the residuals e is noise. So the variances of corners and between images are those of the rest,
expected over the posterior of a, which depends on them: a fixed point (expectation-maximisation). The covariance of the
parameters given a is smaller by what corners and images no longer vary.

References: D. J. C. MacKay, "Bayesian interpolation", Neural Computation 4 (1992), section 4, on the evidence. M. C.
Kennedy, A. O'Hagan, "Bayesian calibration of computer models", J. R. Statist. Soc. B 63 (2001), on a model's
inadequacy as a random function beside its parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from rigkit.calibration.result import Calibration
from rigkit.calibration.solving.clustered import (
    effective_freedom,
    products_between,
    root_of_inverse,
    square_of_rest,
    summed_by,
    widening,
    with_block,
)
from rigkit.calibration.solving.normal_equations import pose_inverses
from rigkit.cameras.base import Camera
from rigkit.cameras.moving_pupil import NearCamera
from rigkit.core.arrays import FloatArray, IntArray, Mat3, Pixels
from rigkit.kernels.departures import DISPLACEMENTS, POSE, LensCorners, averaged_amounts, displacements

SMALLEST_PX, LARGEST_PX = 1e-3, 1.0
"""Limits of tau: lens models leave hundredths to tenths of a pixel at the image corners. Residuals below the first are
rounding."""
SIZES_TRIED = np.geomspace(SMALLEST_PX, LARGEST_PX, 17)[1::2]
"""Values of tau for the integration: the midpoints of eight equal intervals of its logarithm."""
ENOUGH_CORNERS, CORNERS_OF_VIEW = 4096, 16
"""Every second (third ...) corner is used if so many are left in all, and in each view."""
INFORMATION_RIDGE = 1e-12
"""Added to the information of the parameters, as a part of its mean: unused parameters absorb nothing."""
NOISE_ROUNDS, SETTLED_NOISE = 12, 1e-3
"""Rounds of amounts and noise, and the relative change of the noise at which they end. SIMULATED (departures of 0 to 1
px, 12 images, 2026-11-30): 2 to 7 rounds, with the same result from a noise several times too large or too small."""

Fields = Callable[[FloatArray], FloatArray]
"""Displacements (2, F, N) px, from the derivatives (2, P + 3, N) by parameters and rotations of the rays."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Departures:
    """How far a lens may deviate from its model.

    Attributes
    ----------
    size_px : (width, height) of the images.
    covariance : (J, J) px^2, second moments about zero of the amounts of the J displacements, given the images.
    mean : (J,) px, the expected amounts.
    parameter_changes : (P, J) change of the fitted parameters with each displacement.
    pupil_changes : (2, J) the same of the pupil's terms; (0, J) for a central lens.
    noise : what corners and images vary by besides.
    near_covariance : `Calibration.near_covariance`, given the amounts.
    """

    size_px: tuple[int, int]
    covariance: FloatArray
    mean: FloatArray
    parameter_changes: FloatArray
    pupil_changes: FloatArray
    noise: Noise
    near_covariance: FloatArray

    @classmethod
    def of(cls, calibration: Calibration) -> Departures:
        """Return those of a calibrated lens."""
        sigmas = _sigmas(calibration)
        products, freedom = _products(calibration, calibration.near, sigmas, np.eye(3))
        if not (np.isfinite(products).all() and (products[:, -1, -1] >= 0.0).all()):
            # A lens beyond the range of floating-point numbers, from a damaged file.
            products = np.zeros_like(products)
        images = _by_image(calibration, products)
        changes, left, variance = _without_parameters(calibration, images.sum(axis=0), len(sigmas), freedom)
        p = len(sigmas)
        root = root_of_inverse(images[:, :p, :p].sum(axis=0))
        scores = images[:, :p, p:] - images[:, :p, :p] @ changes
        mean_products = _MeanProducts(left / max(freedom - p, 1), products_between(root, images[:, :p, :p], scores) / p)
        before, share = mean_products.without(np.zeros((DISPLACEMENTS,) * 2), np.zeros(DISPLACEMENTS)), np.ones(2)
        second, mean = _averaged(left / before[1])
        for _ in range(NOISE_ROUNDS):
            last, share = share, np.minimum(mean_products.without(second, mean) / before, 1.0)
            second, mean = _averaged(left / (share[1] * before[1]))
            if abs(share[1] - last[1]) <= SETTLED_NOISE * last[1]:
                break
        moved = sigmas[:, None] * changes[:, :-1]
        own = calibration.camera.parameters.size
        return cls(
            size_px=calibration.camera.size_px,
            covariance=second,
            mean=mean,
            parameter_changes=moved[:own],
            pupil_changes=moved[own:],
            noise=Noise.of(calibration, float(share[0]), float(share[1])),
            near_covariance=_less_noise(calibration, sigmas[:, None] * root, variance, float(share[1])),
        )

    def unabsorbed(self, pixels: Pixels, design: FloatArray) -> FloatArray:
        """Return the displacements (2, J, M) at pixels (M, 2) less the part that the parameters absorb; `design`
        (2, K, M) are the projection's derivatives there, those by the parameters first."""
        own = design[:, : len(self.parameter_changes)]
        return displacements(pixels, self.size_px) - np.swapaxes(np.swapaxes(own, 1, 2) @ self.parameter_changes, 1, 2)


@dataclass(frozen=True, slots=True)
class Noise:
    """What corners and images vary by, the departures of the lens taken out.

    Attributes
    ----------
    sigma_px, overdispersion : as of a `Calibration`.
    widening : of the covariance of the parameters, as of a `Calibration`.
    corners, images : variance of corners, and between images, relative to that of the calibration; at most 1.
    """

    sigma_px: float
    overdispersion: float
    widening: float
    corners: float
    images: float

    @property
    def between_images_px(self) -> float:
        """Standard deviation of corners for what rests on many images, widened."""
        return self.sigma_px * self.overdispersion * self.widening

    @classmethod
    def of(cls, calibration: Calibration, corners: float, images: float) -> Noise:
        """Return the noise of a calibration in which variances are smaller by these factors."""
        overdispersion = max(calibration.overdispersion * float(np.sqrt(images / corners)), 1.0)
        freedom = effective_freedom(calibration.freedom, overdispersion, len(calibration.covariance))
        return cls(calibration.sigma_px * float(np.sqrt(corners)), overdispersion, widening(freedom), corners, images)


@dataclass(frozen=True, eq=False, slots=True)
class _MeanProducts:
    """Mean products (J + 1, J + 1) of displacements and residuals, without what the parameters absorb: of corners, and
    of the images' scores with unit information."""

    corners: FloatArray
    images: FloatArray

    def without(self, second: FloatArray, mean: FloatArray) -> FloatArray:
        """Return the variances (2,) of corners and between images, px^2, of the residuals less displacements with these
        posterior moments. Images vary at least as much as corners do."""
        corners, images = (square_of_rest(own, second, mean) for own in (self.corners, self.images))
        corners = max(corners, SMALLEST_PX**2)
        return np.array([corners, max(images, corners)])


def _by_image(calibration: Calibration, products: FloatArray) -> FloatArray:
    """Return the products (N, K, K) of N images from those of the views that have kept corners."""
    corners = calibration.corners
    number: dict[str, int] = {}
    shown = np.unique(corners.view[corners.kept]).tolist()
    image = [number.setdefault(calibration.views[k].image, len(number)) for k in shown]
    return summed_by(np.array(image), products)


def _less_noise(calibration: Calibration, root: FloatArray, variance: float, share: float) -> FloatArray:
    """Return the calibration's `near_covariance` without the part of the noise that is none: of the `variance` between
    images, px^2, only a `share` is left. `root` (p, r) is that of the inverse of the parameters' information.

    Other causes' part of the covariance (rival models) stays as it is; no variance becomes less than its `share`.
    """
    whole, p = calibration.near_covariance, len(root)
    if calibration.pupil is None and not np.array_equal(whole[:p, :p], calibration.covariance):
        # That of the parameters was replaced alone.
        whole = with_block(whole, calibration.covariance, 1.0)
    if share == 1.0 or not root.size:
        return whole
    inverse = np.linalg.pinv(root)
    values, axes = np.linalg.eigh(inverse @ whole[:p, :p] @ inverse.T / variance)
    removed = (1.0 - share) * np.clip(values, 0.0, 1.0)
    moved = root @ axes
    return with_block(whole, whole[:p, :p] - variance * (moved * removed) @ moved.T, share)


def with_own_noise(calibration: Calibration) -> Calibration:
    """Return a calibration with the `Noise` of its corners and images, for what counts departures by themselves. Its
    covariances are unchanged."""
    noise = Departures.of(calibration).noise
    return replace(calibration, sigma_px=noise.sigma_px, overdispersion=noise.overdispersion)


def _averaged(products: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return E[a a^T] (J, J) and E[a] (J,) of amounts a from the `products` (J + 1, J + 1) of displacements and
    residuals, in units of the residuals' variance, averaged over the prior widths of radial and of other
    displacements."""
    # Eigenvalues that should be zero may be negative by rounding.
    values, axes = np.linalg.eigh(products[:-1, :-1])
    return averaged_amounts((axes * np.maximum(values, 0.0)) @ axes.T, products[:-1, -1], SIZES_TRIED)


def amounts_of(calibration: Calibration, fields: Fields) -> FloatArray:
    """Return E[a a^T] (F, F) of the amounts a of F further displacements `fields`, given the images, with poses and
    parameters eliminated; a priori they are independent with unit variance."""
    sigmas = _sigmas(calibration)
    p = len(sigmas)
    products, freedom = _products(calibration, calibration.near, sigmas, np.eye(3), fields)
    products = products.sum(axis=0)
    count = len(products) - p - DISPLACEMENTS - 1
    if not np.isfinite(products).all():
        return np.eye(count)
    # The fields are after the parameters, the residual is last.
    chosen = [*range(p + count), -1]
    _, left, variance = _without_parameters(calibration, products[np.ix_(chosen, chosen)], p, freedom)
    values, axes = np.linalg.eigh(left[:-1, :-1] / variance)
    known = (axes / (1.0 + np.maximum(values, 0.0))) @ axes.T
    mean = known @ left[:-1, -1] / variance
    return np.asarray(known + np.outer(mean, mean))


def _without_parameters(
    calibration: Calibration, products: FloatArray, p: int, freedom: int
) -> tuple[FloatArray, FloatArray, float]:
    """Return the regression (p, K - p) of the other rows on the first p of `products` (K, K), the parameters, the
    products (K - p, K - p) of the others without those, and the variance of the residuals, the last row, between
    images."""
    of_parameters = products[:p, :p] + INFORMATION_RIDGE * max(np.trace(products[:p, :p]), 1.0) / p * np.eye(p)
    changes = np.linalg.solve(of_parameters, products[:p, p:])
    left = products[p:, p:] - products[p:, :p] @ changes
    variance = max(float(left[-1, -1]) / max(freedom - p, 1), SMALLEST_PX**2) * calibration.overdispersion**2
    return changes, left, variance


def information_of_lens(calibration: Calibration, camera: Camera, turn: Mat3) -> FloatArray:
    """Return the information (P, P) of the calibration's corners, of unit variance, on the parameters of another
    `camera`, with poses eliminated; `turn` rotates rays of the calibrated camera to those of `camera`."""
    p = camera.parameters.size
    return np.asarray(_products(calibration, camera, np.ones(p), turn)[0][:, :p, :p].sum(axis=0))


def _sigmas(calibration: Calibration) -> FloatArray:
    """Return the standard deviations of the parameters of a calibrated camera, and of a moving pupil."""
    sigmas, pupil = calibration.parameter_sigmas, calibration.pupil
    if pupil is None:
        return sigmas
    return np.append(sigmas, calibration.widening * np.sqrt(np.maximum(np.diag(pupil.covariance), 0.0)))


def _products(
    calibration: Calibration, camera: Camera, sigmas: FloatArray, turn: Mat3, fields: Fields | None = None
) -> tuple[FloatArray, int]:
    """Return J^T J (V, K, K) of the kept corners of each view that has any, with poses eliminated, and the degrees of
    freedom of all. The columns of J are derivatives by the parameters of a camera in units of `sigmas` (P,), the
    `fields` if given, the displacements and the residuals. `turn` rotates rays of the calibrated camera to those of
    `camera`."""
    corners = calibration.corners
    used, count = _thinned(np.flatnonzero(corners.kept), corners.view)
    view = corners.view[used]
    lever = np.einsum("nij,nj->in", corners.rotation[view], corners.points_mm[used])
    centre = corners.translation_mm.T[:, view]
    if isinstance(calibration.near, NearCamera) and camera is not calibration.near:
        # A central lens gets the points relative to the pupil of this one.
        centre = calibration.near.seen((lever + centre).T).T - lever
    lever = turn @ lever
    x, y, z = lever + turn @ centre
    d_pixels_d_point, d_pixels_d_parameters = np.zeros((2, 3, len(used))), np.zeros((2, len(sigmas), len(used)))
    u, v, valid = camera.derivatives(x, y, z, d_pixels_d_point, d_pixels_d_parameters)
    if fields is not None:
        of_lens = d_pixels_d_parameters[:, : calibration.camera.parameters.size]
        more = fields(np.concatenate([of_lens, rotation_derivatives(np.stack([x, y, z]), d_pixels_d_point)], axis=1))
        d_pixels_d_parameters, sigmas = (
            np.concatenate([d_pixels_d_parameters, more], axis=1),
            np.append(sigmas, np.ones(more.shape[1])),
        )
    residuals = corners.residuals_px[used]
    usable = valid & np.isfinite(residuals[:, 0]) & np.isfinite(residuals[:, 1])
    rows = LensCorners.make(
        d_pixels_d_point, d_pixels_d_parameters, sigmas, lever, (u, v), residuals, usable, count, camera.size_px
    )
    products = rows.products()
    coupling = products[:, POSE:, :POSE]
    out = products[:, POSE:, POSE:] - coupling @ pose_inverses(products[:, :POSE, :POSE]) @ np.swapaxes(coupling, 1, 2)
    return out, 2 * len(used) - POSE * len(count)


def rotation_derivatives(along: FloatArray, d_pixels_d_point: FloatArray) -> FloatArray:
    """Return d pixel / d W (2, 3, N) for a rotation W of the points `along` (3, N), from d pixel / d point there."""
    out = np.empty_like(d_pixels_d_point)
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        out[:, k] = along[i] * d_pixels_d_point[:, j] - along[j] * d_pixels_d_point[:, i]
    return out


def _thinned(kept: IntArray, view: IntArray) -> tuple[IntArray, IntArray]:
    """Return the indices of a subset of the corners `kept` (N,), all unless there are very many, and the number in
    every view that has any. `view` is that of each corner."""
    count = np.bincount(view[kept])
    count = count[count > 0]
    every = max(1, min(len(kept) // ENOUGH_CORNERS, int(count.min(initial=len(kept))) // CORNERS_OF_VIEW))
    if every == 1:
        return kept, count
    place = np.arange(len(kept)) - np.repeat(np.cumsum(count) - count, count)
    return kept[place % every == 0], -(-count // every)
