"""Surface normals from affinities, with their predicted error.

Source: L. Hajder, "Affine Correspondences in Stereo Vision: Theory, Practice, and Limitations", and D. Barath, J.
Molnar, L. Hajder, "Optimal Surface Normal from Affine Transformation" (VISAPP 2015), the paper's optimal normal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.affine.components import blocks, finite
from rigkit.affine.surface import linear_gauge
from rigkit.core.arrays import Affines, BoolArray, FloatArray, Normals, as_floats
from rigkit.core.errors import InputError
from rigkit.geometry.rotation import angle_between

MIN_PARALLAX = 1e-9
"""Smallest |h| / |J2| (about the angle between the two viewing rays, rad) that is not rounding."""


@dataclass(frozen=True, eq=False, slots=True)
class NormalEstimate:
    """Normals of N points with their predicted error.

    Attributes
    ----------
    normals : (N, 3) unit, facing camera 1, in the frame of the Jacobians; NaN where invalid.
    valid : (N,) bool.
    sigma_rad : (N,) predicted rms angular error; NaN where unknown. For small errors it is the root of the trace of
        the normal's covariance. It is bounded: about a radian where the normal is hardly determined.
    """

    normals: Normals
    valid: BoolArray
    sigma_rad: FloatArray


def normals_from_affines(J1: FloatArray, J2: FloatArray, A21: Affines) -> tuple[Normals, BoolArray]:
    """Return the unit normals (N, 3), facing camera 1, whose affinities are nearest to A21, and which are valid.

    Parameters
    ----------
    J1, J2 : (N, 2, 3) d pixel / d point of both images in the frame of the normals (`pair_projection_jacobians`).
    A21 : (N, 2, 2) affinities, NaN where unknown.

    Notes
    -----
    With A(n) = G - h y^T, n ~ J1^T y + d, the minimum of |A(n) - A|_F is y = (G - A)^T h / (h . h). Invalid (NaN)
    without parallax, h = 0 (a point at the epipole, or coincident cameras).

    Raises InputError for arrays of other shapes or types.
    """
    J1, J2, A21 = _matching(J1, J2, A21)
    out = np.empty((len(A21), 3))
    for block in blocks(len(A21)):
        out[block] = _optimal(_planar(J1[block]), _planar(J2[block]), _planar(A21[block]))
    valid = finite(out)
    out[~valid] = np.nan
    return out, valid


def _matching(J1: FloatArray, J2: FloatArray, A21: Affines) -> tuple[FloatArray, FloatArray, Affines]:
    """Return the three as float64; raises InputError where they are not of the same N points."""
    J1, J2, A21 = as_floats(J1, (2, 3), "J1"), as_floats(J2, (2, 3), "J2"), as_floats(A21, (2, 2), "A21")
    n = len(J1)
    if J1.shape != (n, 2, 3) or J2.shape != (n, 2, 3) or A21.shape != (n, 2, 2):
        raise InputError(
            f"normals: J1 and J2 of shape (N, 2, 3) and A21 of (N, 2, 2) are needed, got {J1.shape}, {J2.shape} and "
            f"{A21.shape}"
        )
    return J1, J2, A21


def estimate_normals(
    J1: FloatArray,
    J2: FloatArray,
    A21: Affines,
    *,
    covariance: FloatArray | None = None,
    geometry: FloatArray | None = None,
) -> NormalEstimate:
    """Return the optimal normals with their predicted error.

    Parameters
    ----------
    J1, J2, A21 : as in `normals_from_affines`.
    covariance : (N, 4, 4) of vec(A21), from `Affinities.covariance`; None: the error is unknown.
    geometry : (N, 3, 3) covariance due to corners and pose, rad^2, from `geometry_covariance`.

    Notes
    -----
    dy = -dA^T h / (h . h): the error is the affinity's error along the epipolar line over |h| = |d pixel2 / d range|.
    It grows without bound for small baselines, far planes and points near the epipole.
    """
    normals, valid = normals_from_affines(J1, J2, A21)
    if covariance is None:
        return NormalEstimate(normals, valid, np.full(len(A21), np.nan))
    h = linear_gauge(J1, J2).h
    with np.errstate(divide="ignore", invalid="ignore"):
        along = h / np.sum(h * h, axis=-1, keepdims=True)
    spread_y = np.einsum("ni,nijkl,nk->njl", along, covariance.reshape(-1, 2, 2, 2, 2), along)
    square = _rms_angle(J1, normals, spread_y) ** 2
    if geometry is not None:
        square = square + np.trace(geometry, axis1=-2, axis2=-1)
    return NormalEstimate(normals, valid, np.sqrt(square))


def _rms_angle(J1: FloatArray, normals: Normals, spread_y: FloatArray) -> FloatArray:
    """Return the rms angle (N,) between the normals and those at four sigma points of y.

    The sigma points y +- sqrt(2) L e_i have weight 1/4: exact to first order, and bounded for large errors.
    """
    ray = np.cross(J1[:, 0], J1[:, 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        gauge = normals / np.sum(normals * ray, axis=-1, keepdims=True)
        first = np.sqrt(spread_y[:, 0, 0])
        cross = np.where(first > 0.0, spread_y[:, 0, 1] / np.where(first > 0.0, first, 1.0), 0.0)
        second = np.sqrt(np.maximum(spread_y[:, 1, 1] - cross * cross, 0.0))
    total = np.zeros(len(normals))
    for a, b in ((first, cross), (np.zeros_like(first), second)):
        step = np.sqrt(2.0) * (J1[:, 0] * a[:, None] + J1[:, 1] * b[:, None])
        total += angle_between(gauge, gauge + step) ** 2 + angle_between(gauge, gauge - step) ** 2
    return np.asarray(np.sqrt(total / 4.0))


def _optimal(J1: FloatArray, J2: FloatArray, A21: Affines) -> Normals:
    """Return -unit(J1^T y + d), NaN without parallax. In this gauge n . d = 1, so that -n faces camera 1."""
    G, h, d = linear_gauge(J1, J2)
    hx, hy = h[:, 0], h[:, 1]
    j = J2.reshape(len(J2), 6)
    size = sum(j[:, k] * j[:, k] for k in range(6))
    with np.errstate(divide="ignore", invalid="ignore"):
        square = hx * hx + hy * hy
        inverse = 1.0 / np.where(square > MIN_PARALLAX**2 * size, square, np.nan)
        px, py = hx * inverse, hy * inverse
        y0 = (G[:, 0, 0] - A21[:, 0, 0]) * px + (G[:, 1, 0] - A21[:, 1, 0]) * py
        y1 = (G[:, 0, 1] - A21[:, 0, 1]) * px + (G[:, 1, 1] - A21[:, 1, 1]) * py
    out = np.empty((len(y0), 3))
    for i in range(3):
        out[:, i] = -(J1[:, 0, i] * y0 + J1[:, 1, i] * y1 + d[:, i])
    out /= np.sqrt(out[:, 0] ** 2 + out[:, 1] ** 2 + out[:, 2] ** 2)[:, None]
    return out


def _planar(array: FloatArray) -> FloatArray:
    """Return the array with its first axis contiguous in memory, so that single components are contiguous."""
    return np.moveaxis(np.ascontiguousarray(np.moveaxis(array, 0, -1)), -1, 0)
