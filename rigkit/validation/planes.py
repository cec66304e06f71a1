"""Planes through the points of a board, the angles between them, and how far normals are from them.

A plane is n . x = offset with a unit normal that faces the camera at the origin. PCA is Open3D's. Where the points'
uncertainty across the plane is known, the fit is repeated with those weights. Points that lie far off in spite of it
(the edge of something in front of a board, taken for a corner) are left out: Open3D's RANSAC finds the plane of the
others.

A point is uncertain by its own noise, and by errors that it shares with all others: those of the pose and of the
calibrations. What these do to the whole plane is no reason to trust a point less, but what they bend it by is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, Mat3, Normals, Points, as_array
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.printing import brief
from rigkit.geometry.rotation import angle_between
from rigkit.interop.open3d import mean_and_covariance, plane_inliers
from rigkit.optim.robust_scale import SIGMA_OF_MEDIAN

MIN_POINTS = 4
"""Three points always lie in a plane and say nothing about how flat it is."""
MIN_WIDTH = 1e-3
"""Points whose second principal extent is below this part of the first lie on a line: the plane could turn about it."""
GROSS = 8.0
"""A point this many standard deviations off, noise and bending together, is no corner of the board: chance never does
that."""
MAX_SIGMA_RATIO = 8.0
"""A point this many times as uncertain as the middle one of its board has a sixty-fourth of its say. Nothing is lost
without it, and beside an epipole errors are so large that they are no longer linear: nobody knows its true variance."""
ROUNDING = 1e-9
"""Of the distance: exact points have no scatter to judge by."""
RANSAC_ROUNDS = 2
"""The first takes its distance from the scatter about the tilted plane, the second from that about the common one."""
RANSAC_ITERATIONS = 60
"""With a third of the points bad, no good sample of three is found once in a billion."""
WEIGHT_ROUNDS = 3
"""Weights follow from the plane and the plane from the weights: a third round changes nothing that shows."""
NOISE_STEPS, NOISE_TOLERANCE = 100, 1e-10
"""Until it is near, a step doubles the noise's variance at least; then convergence is quadratic."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Plane:
    """The plane of a board.

    Attributes
    ----------
    normal : (3,) unit, facing the origin (camera 1).
    offset_mm : n . x of its points; negative, because the normal faces the origin.
    centroid_mm : (3,) weighted mean of the points.
    rms_mm, peak_mm : root mean square and largest distance of the points from the plane: flatness.
    count : how many points it goes through.
    tangents : (3, 2) unit vectors along the plane.
    scatter : (3, 3) covariance of the plane's height at the centroid (mm) and of its slopes along the tangents (rad),
        from the points' independent noise alone.
    weights : (count,) of the points, summing to one.
    noise_mm2 : (count,) variance of each point across the plane, from its own noise as observed.
    used : (N,) which of the points given; the others are part of no figure here.
    gross : how many of those are gross outliers; of the rest it is not known where they are.
    """

    normal: FloatArray
    offset_mm: float
    centroid_mm: FloatArray
    rms_mm: float
    peak_mm: float
    count: int
    tangents: FloatArray
    scatter: Mat3
    weights: FloatArray
    noise_mm2: FloatArray
    used: BoolArray
    gross: int = 0

    __repr__ = brief

    def distances(self, points: Points) -> FloatArray:
        """Return the signed distances (...) of points (..., 3) in mm, positive on the camera's side."""
        return np.asarray(np.asarray(points) @ self.normal - self.offset_mm)

    def variance_at(self, point: FloatArray) -> float:
        """Return the variance (mm^2) of where the plane passes a point (3,), from the noise alone."""
        row = np.array([1.0, *((point - self.centroid_mm) @ self.tangents)])
        return float(row @ self.scatter @ row)

    @property
    def normal_covariance(self) -> Mat3:
        """(3, 3) rad^2, of the normal's tilt from the points' independent noise; rank 2."""
        return np.asarray(self.tangents @ self.scatter[1:, 1:] @ self.tangents.T)

    @property
    def sigma_rad(self) -> float:
        """Root mean square tilt of the normal."""
        return float(np.sqrt(np.trace(self.normal_covariance)))


@dataclass(frozen=True, slots=True)
class NormalErrors:
    """Angles between estimated normals and the normal of a plane, degrees."""

    mean_deg: float
    median_deg: float
    lower_quartile_deg: float
    upper_quartile_deg: float
    max_deg: float
    count: int


def fit_plane(
    points_mm: Points, covariance_mm2: FloatArray | None = None, common_mm: FloatArray | None = None
) -> Plane:
    """Return the plane through points (N, 3) in the frame of camera 1.

    Raises DegenerateError: fewer than four points, or points on a line.

    Parameters
    ----------
    points_mm : (N, 3)
    covariance_mm2 : (N, 3, 3) of each point's own noise, or None. Only what lies across the plane matters, and only the
        ratios: how large the noise is, the observed scatter tells. Without it all points count, as far off as they are.
    common_mm : (K, N, 3) how the points move for one standard deviation of each of K independent errors that they share
        (pose, calibrations), or None: there are none. A point with NaN is left out: how far off it is, nobody knows.

    Notes
    -----
    Weights are 1 / (s^2 n^T C_k n + sum b^2): s^2 scales the noise to what is observed, and b is what the weighted fit
    does not follow of each common move. A plane's heights and slopes are T e, with e the residuals across it,
    T = (A^T W A)^-1 A^T W and rows (1, t1 . (x_k - c), t2 . (x_k - c)) of A. Their covariance from the noise is
    T diag(s^2 n^T C_k n) T^T; their error from what is common is T times the moves: see `fit_moved`.
    """
    points = as_array(points_mm, (None, 3), "points_mm")
    common = np.zeros((0, *points.shape)) if common_mm is None else np.asarray(common_mm, dtype=np.float64)
    used = np.array(np.isfinite(common).all(axis=(0, 2)), dtype=bool)
    if covariance_mm2 is None:
        return _plane(points[used], np.full(int(used.sum()), 1.0 / max(used.sum(), 1)), None, used)
    covariance = np.asarray(covariance_mm2, dtype=np.float64)
    gross = 0
    if used.sum() > 2 * MIN_POINTS:
        near, telling = _judged(points[used], covariance[used], common[:, used])
        gross = int((~near).sum())
        used[used] = near & telling
    weights, noise = _weights(points[used], covariance[used], common[:, used])
    return replace(_plane(points[used], weights, noise, used), gross=gross)


def fit_moved(points_mm: Points, like: Plane) -> tuple[Normals, FloatArray]:
    """Return the normal (..., 3) and the offset (...), mm, of the plane of points (..., N, 3).

    They are those that `like` was fitted to, moved a little, and keep their weights.
    """
    centroid, axes = _principal(np.asarray(points_mm)[..., like.used, :], like.weights)
    normal = _facing(axes[..., 0], centroid)
    return normal, np.asarray(np.sum(normal * centroid, axis=-1))


def _principal(points: Points, weights: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
    """Return centroid and principal axes (columns, the normal first) of points (..., N, 3).

    Their `weights` (N,) sum to one; without, all points are alike, and there is one set (N, 3) of them.
    """
    n = points.shape[-2]
    if n < MIN_POINTS:
        raise DegenerateError(f"plane: {n} points; at least {MIN_POINTS} are needed to fit one and judge it")
    if weights is None:
        centroid, scatter = mean_and_covariance(points)
    else:
        centroid = weights @ points
        offsets = points - centroid[..., None, :]
        scatter = np.swapaxes(offsets, -1, -2) @ (weights[:, None] * offsets)
    values, axes = np.linalg.eigh(scatter)
    if (values[..., 1] < MIN_WIDTH**2 * values[..., 2]).any():
        raise DegenerateError(f"plane: its {n} points lie on a line; more of the board must be seen")
    return centroid, axes


def _weights(points: Points, covariance: FloatArray, common: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the points' weights, summing to one, and the variance of each across the plane from its noise, mm^2."""
    centroid, axes = _principal(points)
    # A point that the common errors move far would pull the first plane to itself, and look unmoved from there: so the
    # whole move counts in the first round.
    weights = np.zeros(len(points))
    for _ in range(WEIGHT_ROUNDS):
        seen = _Across.of(points, covariance, common, centroid, axes)
        noise = seen.noise_variance() * seen.variance
        weights = 1.0 / (noise + np.sum(seen.bending(weights) ** 2, axis=1))
        weights /= weights.sum()
        centroid, axes = _principal(points, weights)
    return weights, noise


@dataclass(frozen=True, eq=False, slots=True)
class _Across:
    """What is seen of points across a plane near theirs.

    Attributes
    ----------
    residuals : (N,) mm.
    variance : (N,) mm^2, of their noise as it was given.
    design : (N, 3) rows (1, t1 . (x - c), t2 . (x - c)).
    common : (N, K) mm, the common moves.
    floor_mm : rounding.
    """

    residuals: FloatArray
    variance: FloatArray
    design: FloatArray
    common: FloatArray
    floor_mm: float

    @classmethod
    def of(
        cls, points: Points, covariance: FloatArray, common: FloatArray, centroid: FloatArray, axes: FloatArray
    ) -> _Across:
        offsets = points - centroid
        return cls(
            offsets @ axes[:, 0],
            _variance_across(axes[:, 0], covariance),
            np.concatenate([np.ones((len(points), 1)), offsets @ axes[:, 1:]], axis=1),
            (common @ axes[:, 0]).T,
            ROUNDING * float(np.linalg.norm(centroid)),
        )

    def bending(self, weights: FloatArray) -> FloatArray:
        """Return what a fit with these weights (N,) leaves of the common moves, (N, K) mm; all if they are zero."""
        root = np.sqrt(weights)[:, None]
        follows, *_ = np.linalg.lstsq(root * self.design, root * self.common, rcond=None)
        return np.asarray(self.common - self.design @ follows)

    def noise_variance(self) -> float:
        """Return s^2: of the noise alone, in units of `variance`; what is common bends the points, but is no noise.

        Divided by the root of `variance`, the residuals have the covariance V = s^2 1 + H H^T. s^2 is that at which
        e^T V^-1 e, in the space that no plane follows, has its expectation.
        """
        sigma = np.sqrt(self.variance)
        basis, _ = np.linalg.qr(self.design / sigma[:, None])
        both = np.concatenate([self.residuals[:, None], self.common], axis=1) / sigma[:, None]
        both -= basis @ (basis.T @ both)
        modes, sizes, _ = np.linalg.svd(both[:, 1:], full_matrices=False)
        along, free = (modes.T @ both[:, 0]) ** 2, len(both) - 3
        rest = max(float(both[:, 0] @ both[:, 0] - along.sum()), 0.0)
        # rest / s^2 + sum along / (s^2 + sizes^2) = free. The left side falls and is convex: Newton's steps from below
        # the root stay below. Where the common errors can explain everything, there is no rest.
        variance = max(rest / free, float(np.mean(self.floor_mm / sigma)) ** 2)
        for _ in range(NOISE_STEPS):
            spread = variance + sizes**2
            excess = rest / variance + float(np.sum(along / spread)) - free
            if excess <= NOISE_TOLERANCE * free:
                break
            variance += excess / (rest / variance**2 + float(np.sum(along / spread**2)))
        return variance


def _variance_across(normal: FloatArray, covariance: FloatArray) -> FloatArray:
    variance = np.einsum("i,nij,j->n", normal, covariance, normal)
    if not (np.isfinite(variance) & (variance > 0.0)).all():
        raise InputError("plane: a point's covariance is not positive; leave it out or give none")
    return np.asarray(variance)


def _judged(points: Points, covariance: FloatArray, common: FloatArray) -> tuple[BoolArray, BoolArray]:
    """Return which points are no gross outliers (N,), and which are certain enough to tell something (N,).

    Outliers tilt the plane that they would be judged by: they are judged by one that most points share. How far what is
    common bends the points away from that plane is no evidence against them.
    """
    centroid, axes = _principal(points)
    floor = ROUNDING * float(np.linalg.norm(centroid))
    for _ in range(RANSAC_ROUNDS):
        off = np.abs((points - centroid) @ axes[:, 0])
        near = 2.0 * SIGMA_OF_MEDIAN * float(np.median(off)) + floor
        shared = plane_inliers(points, near, iterations=RANSAC_ITERATIONS)
        weights = np.zeros(len(points))
        weights[shared], _ = _weights(points[shared], covariance[shared], common[:, shared])
        centroid, axes = _principal(points, weights)
    seen = _Across.of(points, covariance, common, centroid, axes)
    off = np.abs(seen.residuals)
    scatter = SIGMA_OF_MEDIAN * float(np.median(off / np.sqrt(seen.variance)))
    expected = np.sqrt(scatter**2 * seen.variance + np.sum(seen.bending(weights) ** 2, axis=1))
    return np.asarray(off <= GROSS * expected + floor), np.asarray(expected <= MAX_SIGMA_RATIO * np.median(expected))


def _plane(points: Points, weights: FloatArray, noise_mm2: FloatArray | None, used: BoolArray) -> Plane:
    """Return the plane of points with weights; their noise is estimated, equal for all, where it is not given."""
    equal = noise_mm2 is None
    centroid, axes = _principal(points, None if equal else weights)
    normal = _facing(axes[:, 0], centroid)
    residuals = (points - centroid) @ normal
    if noise_mm2 is None:
        noise_mm2 = np.full(len(points), residuals @ residuals / (len(points) - 3))
    design = np.concatenate([np.ones((len(points), 1)), (points - centroid) @ axes[:, 1:]], axis=1)
    operator = np.linalg.solve((design.T * weights) @ design, design.T * weights)
    return Plane(
        normal=normal,
        offset_mm=float(normal @ centroid),
        centroid_mm=centroid,
        rms_mm=float(np.sqrt(np.mean(residuals**2))),
        peak_mm=float(np.abs(residuals).max()),
        count=len(points),
        tangents=axes[:, 1:],
        scatter=operator * noise_mm2 @ operator.T,
        weights=weights,
        noise_mm2=noise_mm2,
        used=used,
    )


def _facing(normal: Normals, point: Points) -> Normals:
    """Return normals (..., 3) that face the origin from points (..., 3)."""
    return np.asarray(np.where(np.sum(normal * point, axis=-1, keepdims=True) < 0.0, normal, -normal))


def face_angle(normal_a: Normals, normal_b: Normals) -> FloatArray:
    """Return the angle (...) between two faces with normals (..., 3), radians, as a protractor across them shows it.

    It is pi minus the angle between the normals that face the camera.
    """
    return np.asarray(np.pi - angle_between(normal_a, normal_b))


def angle_jacobian(normal_a: FloatArray, normal_b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return d face angle / d normal of `a` and of `b`, (3,) each; zero where the planes are parallel."""
    sine = float(np.linalg.norm(np.cross(normal_a, normal_b)))
    if sine < 1e-12:
        return np.zeros(3), np.zeros(3)
    cosine = float(normal_a @ normal_b)
    return (normal_b - cosine * normal_a) / sine, (normal_a - cosine * normal_b) / sine


def normal_errors(normals: Normals, plane_normal: FloatArray) -> NormalErrors:
    """Return statistics of the angles between normals (N, 3) and that of their plane (3,).

    Raises DegenerateError where there are no normals.
    """
    array = as_array(normals, (None, 3), "normals")
    if len(array) == 0:
        raise DegenerateError("normal errors: no normals to judge")
    errors = np.rad2deg(angle_between(array, plane_normal))
    lower, median, upper = np.quantile(errors, [0.25, 0.5, 0.75])
    return NormalErrors(
        float(errors.mean()), float(median), float(lower), float(upper), float(errors.max()), len(array)
    )
