"""Planes through the points of a board, the angles between them, and how far normals are from them.

A plane is n . x = offset with a unit normal that faces the camera at the origin. PCA is Open3D's; where the points'
uncertainty across the plane is known, the fit is repeated with those weights, and points that lie far off in spite of
it (the edge of something in front of a board, taken for a corner) are left out: Open3D's RANSAC finds the plane of the
others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.arrays import BoolArray, FloatArray, Mat3, Normals, Points, as_array
from rigkit.errors import DegenerateError, InputError
from rigkit.geometry.rotation import angle_between
from rigkit.interop.open3d import mean_and_covariance, plane_inliers

__all__ = ["NormalErrors", "Plane", "angle_jacobian", "face_angle", "fit_plane", "normal_errors"]

MIN_POINTS = 4
"""Three points always lie in a plane and say nothing about how flat it is."""
MIN_WIDTH = 1e-3
"""Points whose second principal extent is below this part of the first lie on a line: the plane could turn about it."""
GROSS = 8.0
"""A point this many robust standard deviations off is no corner of the board: chance never does that."""
TO_SIGMA = 1.4826
"""From the median of absolute values to the standard deviation of a Gaussian."""
ROUNDING = 1e-9
"""Of the distance: exact points have no scatter to judge by."""
RANSAC_ROUNDS = 2
"""The first takes its distance from the scatter about the tilted plane, the second from that about the common one."""
RANSAC_ITERATIONS = 60
"""With a third of the points bad, no good sample of three is found once in a billion."""


@dataclass(frozen=True, eq=False, slots=True)
class Plane:
    """The plane of a board.

    Attributes
    ----------
    normal : (3,) unit, facing the origin (camera 1).
    offset_mm : n . x of its points; negative, because the normal faces the origin.
    centroid_mm : (3,) weighted mean of the points.
    rms_mm, peak_mm : root mean square and largest distance of the points from the plane: flatness.
    count : how many points it goes through.
    normal_covariance : (3, 3) rad^2, of the normal's tilt from the points' independent scatter; rank 2.
    used : (N,) which of the points given; the others are gross outliers, and part of no figure here.
    """

    normal: FloatArray
    offset_mm: float
    centroid_mm: FloatArray
    rms_mm: float
    peak_mm: float
    count: int
    normal_covariance: Mat3
    used: BoolArray

    def distances(self, points: Points) -> FloatArray:
        """Return the signed distances (...) of points (..., 3) in mm, positive on the camera's side."""
        return np.asarray(np.asarray(points) @ self.normal - self.offset_mm)

    @property
    def sigma_rad(self) -> float:
        """Root mean square tilt of the normal."""
        return float(np.sqrt(np.trace(self.normal_covariance)))


@dataclass(frozen=True, slots=True)
class NormalErrors:
    """Angles between estimated normals and the normal of the plane fitted to the points, degrees."""

    mean_deg: float
    median_deg: float
    lower_quartile_deg: float
    upper_quartile_deg: float
    max_deg: float
    count: int


def fit_plane(points_mm: Points, covariance_mm2: FloatArray | None = None, used: BoolArray | None = None) -> Plane:
    """Return the plane through points (N, 3) in the frame of camera 1.

    Parameters
    ----------
    points_mm : (N, 3)
    covariance_mm2 : (N, 3, 3) of each point, or None. Only what lies across the plane matters: weights are
        1 / (n^T C n), with n from the unweighted fit. They are used as weights only: the normal's covariance is built
        on the scatter that is observed. Without them all points count, as far off as they may be.
    used : (N,) the points to fit, where that was decided before; None: all but gross outliers.

    Raises
    ------
    DegenerateError
        Fewer than four points, or points on a line.

    Notes
    -----
    With eigenvalues l1 >= l2 >= l3 and eigenvectors t1, t2, n of the weighted covariance, a residual e_k across the
    plane tilts the normal by -sum_k w_k e_k (t_i . (x_k - c)) / l_i about the other axis: the tilt's covariance is
    s^2 (t1 t1^T / l1 + t2 t2^T / l2) / N_w with s^2 = sum w e^2 N / (N - 3), weights summing to one.
    """
    points = as_array(points_mm, (None, 3), "points_mm")
    covariance = None if covariance_mm2 is None else np.asarray(covariance_mm2, dtype=np.float64)
    if used is None:
        used = np.ones(len(points), dtype=bool)
        if covariance is not None and len(points) > 2 * MIN_POINTS:
            used = _not_gross(points, covariance)
    centroid, values, vectors, weights = _principal(points[used], None if covariance is None else covariance[used])
    return _plane(points[used], centroid, values, vectors, weights, used)


def _principal(points: Points, covariance: FloatArray | None) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return centroid, eigenvalues (rising) and eigenvectors of the (weighted) scatter, and the weights (N,)."""
    n = len(points)
    if n < MIN_POINTS:
        raise DegenerateError(f"plane: {n} points; at least {MIN_POINTS} are needed to fit one and judge it")
    centroid, scatter = mean_and_covariance(points)
    values, vectors = np.linalg.eigh(scatter)
    weights = np.full(n, 1.0 / n)
    if covariance is not None:
        weights = 1.0 / _variance_across(vectors[:, 0], covariance)
        weights /= weights.sum()
        centroid = weights @ points
        offsets = points - centroid
        values, vectors = np.linalg.eigh(np.einsum("n,ni,nj->ij", weights, offsets, offsets))
    if values[1] < MIN_WIDTH**2 * values[2]:
        raise DegenerateError(f"plane: its {n} points lie on a line; more of the board must be seen")
    return centroid, values, vectors, weights


def _variance_across(normal: FloatArray, covariance: FloatArray) -> FloatArray:
    variance = np.einsum("i,nij,j->n", normal, covariance, normal)
    if not (np.isfinite(variance) & (variance > 0.0)).all():
        raise InputError("plane: a point's covariance is not positive; leave it out or give none")
    return np.asarray(variance)


def _not_gross(points: Points, covariance: FloatArray) -> BoolArray:
    """Return which points are no gross outliers, (N,).

    Outliers tilt the plane that they would be judged by: they are judged by one that most points share.
    """
    centroid, _, vectors, _ = _principal(points, covariance)
    sigma = np.sqrt(_variance_across(vectors[:, 0], covariance))
    floor = ROUNDING * float(np.linalg.norm(centroid))
    for _ in range(RANSAC_ROUNDS):
        off = np.abs((points - centroid) @ vectors[:, 0])
        near = 2.0 * TO_SIGMA * float(np.median(off)) + floor
        common = plane_inliers(points, near, iterations=RANSAC_ITERATIONS)
        centroid, _, vectors, _ = _principal(points[common], covariance[common])
    off = np.abs((points - centroid) @ vectors[:, 0])
    scatter = TO_SIGMA * float(np.median(off / sigma))
    return np.asarray(off <= GROSS * scatter * sigma + floor)


def _plane(
    points: Points,
    centroid: FloatArray,
    values: FloatArray,
    vectors: FloatArray,
    weights: FloatArray,
    used: BoolArray,
) -> Plane:
    n = len(points)
    normal = vectors[:, 0] if vectors[:, 0] @ centroid < 0.0 else -vectors[:, 0]
    residuals = (points - centroid) @ normal
    tilts = (points - centroid) @ vectors[:, 1:] / values[1:] * weights[:, None]
    # Residual variance of a point is taken as inverse to its weight, scaled to what was observed.
    unit_variance = float(np.sum(weights * residuals**2) * n / (n - 3))
    spread = unit_variance * np.einsum("ni,n,nj->ij", tilts, 1.0 / (weights * n), tilts)
    return Plane(
        normal,
        float(normal @ centroid),
        centroid,
        float(np.sqrt(np.mean(residuals**2))),
        float(np.abs(residuals).max()),
        n,
        vectors[:, 1:] @ spread @ vectors[:, 1:].T,
        used,
    )


def face_angle(normal_a: FloatArray, normal_b: FloatArray) -> float:
    """Return the angle between two faces, radians, as a protractor laid across them shows it.

    It is pi minus the angle between the normals that face the camera.
    """
    return float(np.pi - angle_between(normal_a, normal_b))


def angle_jacobian(normal_a: FloatArray, normal_b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return d face angle / d normal of `a` and of `b`, (3,) each; zero where the planes are parallel."""
    sine = float(np.linalg.norm(np.cross(normal_a, normal_b)))
    if sine < 1e-12:
        return np.zeros(3), np.zeros(3)
    cosine = float(normal_a @ normal_b)
    return (normal_b - cosine * normal_a) / sine, (normal_a - cosine * normal_b) / sine


def normal_errors(normals: Normals, plane: Plane) -> NormalErrors:
    """Return statistics of the angles between normals (N, 3) and the plane's; raises DegenerateError for none."""
    array = as_array(normals, (None, 3), "normals")
    if len(array) == 0:
        raise DegenerateError("normal errors: no normals to judge")
    errors = np.rad2deg(angle_between(array, plane.normal))
    lower, median, upper = np.quantile(errors, [0.25, 0.5, 0.75])
    return NormalErrors(
        float(errors.mean()), float(median), float(lower), float(upper), float(errors.max()), len(array)
    )
