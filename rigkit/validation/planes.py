"""Fit planes to the points of a board; compute angles between planes, and errors of normals.

A plane is n . x = offset with a unit normal that faces the camera at the origin. PCA is Open3D's. If the points'
covariances are known, the fit is weighted by their variances along the normal. Outliers (e.g. the edge of an object in
front of the board, detected as a corner) are found with Open3D's RANSAC and left out.

A point has its own noise, and errors common to all points: those of the pose and of the calibrations. Of a common error
only the part that bends the plane reduces a point's weight, not the part that moves the whole plane.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, Mat3, Normals, Points, as_array
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.printing import brief
from rigkit.geometry.rotation import angle_between
from rigkit.interop.open3d import mean_and_covariance, plane_inliers
from rigkit.optim.robust_scale import robust_sigma

MIN_PLANE_POINTS = 4
"""Three points are always in a plane and do not determine its flatness."""
MIN_WIDTH = 1e-3
"""Least ratio of the second to the first principal extent; below, the points are on a line."""
GROSS = 8.0
"""Residual, in standard deviations of noise and bending, from which a point is an outlier."""
MAX_SIGMA_RATIO = 8.0
"""Points with more than this times the median sigma are left out. Their weight would be 1/64 at most, and close to an
epipole errors are so large that their linearised variance is wrong."""
ROUNDING = 1e-9
"""Floor of residuals, as a part of the distance: exact points have no scatter."""
RANSAC_ROUNDS = 2
"""The first inlier distance is from the scatter about a plane tilted by outliers, the second from the common plane."""
RANSAC_ITERATIONS = 60
"""With a third of the points bad, the probability of no good sample of three is 1e-9."""
WEIGHT_ROUNDS = 3
"""Weights depend on the plane and the plane on the weights: the third round changes nothing visible."""
NOISE_STEPS, NOISE_TOLERANCE = 100, 1e-10
"""Far from the solution each step at least doubles the variance; close to it convergence is quadratic."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Plane:
    """The plane of a board.

    Attributes
    ----------
    normal : (3,) unit, facing the origin (camera 1).
    offset_mm : n . x of its points; negative, because the normal faces the origin.
    centroid_mm : (3,) weighted mean of the points.
    rms_mm, peak_mm : RMS and largest distance of the points from the plane: flatness.
    count : number of points used.
    tangents : (3, 2) unit vectors along the plane.
    scatter : (3, 3) covariance of the plane's height at the centroid (mm) and of its slopes along the tangents (rad),
        from the points' independent noise only.
    weights : (count,) of the points, summing to one.
    noise_mm2 : (count,) variance of each point along the normal, from its own noise, scaled to the residuals.
    used : (N,) mask of the points used.
    gross : number of outliers; other points that were not used were too uncertain.
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
        """Return the variance (mm^2) of the plane's height at a point (3,), from the noise only."""
        row = np.array([1.0, *((point - self.centroid_mm) @ self.tangents)])
        return float(row @ self.scatter @ row)

    @property
    def normal_covariance(self) -> Mat3:
        """Covariance (3, 3) rad^2 of the normal from the points' independent noise; rank 2."""
        return np.asarray(self.tangents @ self.scatter[1:, 1:] @ self.tangents.T)

    @property
    def sigma_rad(self) -> float:
        """RMS error of the normal from the points' independent noise."""
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

    Raises DegenerateError for fewer than four points, or points on a line.

    Parameters
    ----------
    points_mm : (N, 3)
    covariance_mm2 : (N, 3, 3) of each point's own noise, or None. Only the ratios of the variances along the normal
        matter: the scale is estimated from the residuals. Without it all points are used with equal weights.
    common_mm : (K, N, 3) displacement of the points by one standard deviation of each of K independent errors common to
        all (pose, calibrations), or None. A point with NaN is left out: its error is unknown.

    Notes
    -----
    Weights are 1 / (s^2 n^T C_k n + sum b^2): s^2 scales the noise to the residuals, and b is the residual of the
    weighted fit to each common displacement. A plane's height and slopes are T e, with e the residuals along the
    normal, T = (A^T W A)^-1 A^T W and rows (1, t1 . (x_k - c), t2 . (x_k - c)) of A. Their covariance from the noise is
    T diag(s^2 n^T C_k n) T^T; their error from the common errors is T times the displacements: see `fit_moved`.
    """
    points = as_array(points_mm, (None, 3), "points_mm")
    common = np.zeros((0, *points.shape)) if common_mm is None else np.asarray(common_mm, dtype=np.float64)
    used = np.array(np.isfinite(common).all(axis=(0, 2)), dtype=bool)
    if covariance_mm2 is None:
        return _plane(points[used], np.full(int(used.sum()), 1.0 / max(used.sum(), 1)), None, used)
    covariance = np.asarray(covariance_mm2, dtype=np.float64)
    gross = 0
    if used.sum() > 2 * MIN_PLANE_POINTS:
        near, telling = _inliers_and_certain(points[used], covariance[used], common[:, used])
        gross = int((~near).sum())
        used[used] = near & telling
    weights, noise = _weights(points[used], covariance[used], common[:, used])
    return replace(_plane(points[used], weights, noise, used), gross=gross)


def fit_moved(points_mm: Points, like: Plane) -> tuple[Normals, FloatArray]:
    """Return the normal (..., 3) and the offset (...), mm, of the planes of points (..., N, 3).

    These are perturbed copies of the points that `like` was fitted to, and keep their weights.
    """
    centroid, axes = _principal(np.asarray(points_mm)[..., like.used, :], like.weights)
    normal = _facing(axes[..., 0], centroid)
    return normal, np.asarray(np.sum(normal * centroid, axis=-1))


def _principal(points: Points, weights: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
    """Return centroid and principal axes (columns, the normal first) of points (..., N, 3).

    `weights` (N,) sum to one; without them weights are equal, and the points must be one set (N, 3).
    """
    n = points.shape[-2]
    if n < MIN_PLANE_POINTS:
        raise DegenerateError(f"plane: {n} points; at least {MIN_PLANE_POINTS} are needed to fit one and judge it")
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
    """Return the points' weights, summing to one, and the variance of each along the normal from its noise, mm^2."""
    centroid, axes = _principal(points)
    # With zero weights the whole common displacement counts in the first round: a point with a large one would attract
    # the first plane, and so seem to have a small one.
    weights = np.zeros(len(points))
    for _ in range(WEIGHT_ROUNDS):
        seen = _NormalResiduals.of(points, covariance, common, centroid, axes)
        noise = seen.noise_variance() * seen.variance
        weights = 1.0 / (noise + np.sum(seen.bending(weights) ** 2, axis=1))
        weights /= weights.sum()
        centroid, axes = _principal(points, weights)
    return weights, noise


@dataclass(frozen=True, eq=False, slots=True)
class _NormalResiduals:
    """Residuals of points along the normal of a plane, and their variances.

    Attributes
    ----------
    residuals : (N,) mm.
    variance : (N,) mm^2, of their noise as given.
    design : (N, 3) rows (1, t1 . (x - c), t2 . (x - c)).
    common : (N, K) mm, the common displacements.
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
    ) -> _NormalResiduals:
        offsets = points - centroid
        return cls(
            offsets @ axes[:, 0],
            _variance_across(axes[:, 0], covariance),
            np.concatenate([np.ones((len(points), 1)), offsets @ axes[:, 1:]], axis=1),
            (common @ axes[:, 0]).T,
            ROUNDING * float(np.linalg.norm(centroid)),
        )

    def bending(self, weights: FloatArray) -> FloatArray:
        """Return the residuals (N, K) mm of a fit with weights (N,) to the common displacements."""
        root = np.sqrt(weights)[:, None]
        follows, *_ = np.linalg.lstsq(root * self.design, root * self.common, rcond=None)
        return np.asarray(self.common - self.design @ follows)

    def noise_variance(self) -> float:
        """Return the variance s^2 of the noise without the common errors, in units of `variance`.

        Divided by the root of `variance`, the residuals have the covariance V = s^2 1 + H H^T. s^2 is the value for
        which e^T V^-1 e, in the space orthogonal to all planes, equals its expectation.
        """
        sigma = np.sqrt(self.variance)
        basis, _ = np.linalg.qr(self.design / sigma[:, None])
        both = np.concatenate([self.residuals[:, None], self.common], axis=1) / sigma[:, None]
        both -= basis @ (basis.T @ both)
        modes, sizes, _ = np.linalg.svd(both[:, 1:], full_matrices=False)
        along, free = (modes.T @ both[:, 0]) ** 2, len(both) - 3
        rest = max(float(both[:, 0] @ both[:, 0] - along.sum()), 0.0)
        # rest / s^2 + sum along / (s^2 + sizes^2) = free. The left side is decreasing and convex: Newton's steps from
        # below the root stay below. `rest` is 0 if the common errors can explain all residuals.
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


def _inliers_and_certain(points: Points, covariance: FloatArray, common: FloatArray) -> tuple[BoolArray, BoolArray]:
    """Return a mask (N,) of the inliers, and one (N,) of the points that are certain enough to use.

    Outliers would tilt the plane of all points, so residuals are from a plane that most points share. Bending by the
    common errors is part of the expected residual.
    """
    centroid, axes = _principal(points)
    floor = ROUNDING * float(np.linalg.norm(centroid))
    for _ in range(RANSAC_ROUNDS):
        near = 2.0 * robust_sigma((points - centroid) @ axes[:, 0]) + floor
        shared = plane_inliers(points, near, iterations=RANSAC_ITERATIONS)
        weights = np.zeros(len(points))
        weights[shared], _ = _weights(points[shared], covariance[shared], common[:, shared])
        centroid, axes = _principal(points, weights)
    seen = _NormalResiduals.of(points, covariance, common, centroid, axes)
    off = np.abs(seen.residuals)
    scatter = robust_sigma(off / np.sqrt(seen.variance))
    expected = np.sqrt(scatter**2 * seen.variance + np.sum(seen.bending(weights) ** 2, axis=1))
    return np.asarray(off <= GROSS * expected + floor), np.asarray(expected <= MAX_SIGMA_RATIO * np.median(expected))


def _plane(points: Points, weights: FloatArray, noise_mm2: FloatArray | None, used: BoolArray) -> Plane:
    """Return the plane of weighted points; if their noise is not given, equal noise is estimated."""
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
    """Return the angle (...) between two faces, radians: pi minus the angle between their normals (..., 3)."""
    return np.asarray(np.pi - angle_between(normal_a, normal_b))


def angle_jacobian(normal_a: FloatArray, normal_b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return d face angle / d normal of `a` and of `b`, (3,) each; zero for parallel planes."""
    sine = float(np.linalg.norm(np.cross(normal_a, normal_b)))
    if sine < 1e-12:
        return np.zeros(3), np.zeros(3)
    cosine = float(normal_a @ normal_b)
    return (normal_b - cosine * normal_a) / sine, (normal_a - cosine * normal_b) / sine


def normal_errors(normals: Normals, plane_normal: FloatArray) -> NormalErrors:
    """Return statistics of the angles between normals (N, 3) and that of their plane (3,).

    Raises DegenerateError without normals.
    """
    array = as_array(normals, (None, 3), "normals")
    if len(array) == 0:
        raise DegenerateError("normal errors: no normals to judge")
    errors = np.rad2deg(angle_between(array, plane_normal))
    lower, median, upper = np.quantile(errors, [0.25, 0.5, 0.75])
    return NormalErrors(
        float(errors.mean()), float(median), float(lower), float(upper), float(errors.max()), len(array)
    )
